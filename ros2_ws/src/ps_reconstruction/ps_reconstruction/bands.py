"""Work spread over the cores in bands of image rows.

The compiled kernels release the GIL and know nothing of threads; the bands and their order do not
depend on the number of cores, so results are bit-identical everywhere.
"""
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
import functools
import os
from typing import TypeVar

Result = TypeVar('Result')


def core_count() -> int:
    """Cores this process may use; PS_THREADS in the environment overrides it."""
    wanted = os.environ.get('PS_THREADS', '')
    if wanted.isdigit() and int(wanted) > 0:
        return int(wanted)
    affinity = getattr(os, 'sched_getaffinity', None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


@functools.cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(core_count(), thread_name_prefix='ps_band')


def for_bands(rows: int, band: int, work: Callable[[int, int], Result]) -> list[Result]:
    """Call ``work(first, last)`` for consecutive bands of at most ``band`` rows.

    :returns: what the calls returned, top band first. The first exception is raised again.
    """
    edges = [(first, min(first + band, rows)) for first in range(0, rows, band)]
    if core_count() == 1 or len(edges) == 1:
        return [work(*edge) for edge in edges]
    return list(_pool().map(lambda edge: work(*edge), edges))
