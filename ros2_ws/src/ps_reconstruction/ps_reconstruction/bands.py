"""Work spread over the cores in bands of image rows.

The compiled kernels release the GIL and know nothing of threads; the bands and their order do not
depend on the number of cores, so results are bit-identical everywhere. The calling thread does its
share of the work, so calls may come from several threads or from within a band.
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
    return ThreadPoolExecutor(max(1, core_count() - 1), thread_name_prefix='ps_band')


def for_bands(rows: int, band: int, work: Callable[[int, int], Result]) -> list[Result]:
    """Call ``work(first, last)`` for consecutive bands of at most ``band`` rows.

    :returns: what the calls returned, top band first. The first exception is raised again.
    """
    edges = [(first, min(first + band, rows)) for first in range(0, rows, band)]
    results: dict[int, Result] = {}
    waiting = iter(range(len(edges)))     # its next() is atomic: the threads share it

    def take() -> None:
        for number in waiting:
            results[number] = work(*edges[number])

    helpers = [_pool().submit(take) for _ in range(min(core_count(), len(edges)) - 1)]
    try:
        take()
    finally:
        # one that the pool has not begun yet is not needed any more
        for helper in helpers:
            if not helper.cancel():
                helper.result()
    return [results[number] for number in range(len(edges))]
