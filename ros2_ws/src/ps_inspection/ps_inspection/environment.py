"""Process environment that lets large image stacks travel fast; the one place where it is stated.

Used by the launch file, `ps_cell` and, through `python environment.py`, by env.sh. Only the
standard library, so that it runs without any package. What the user has set already is kept.
"""
from collections.abc import Mapping
import os
from pathlib import Path
import shlex

PACKAGE = 'ps_inspection'


def fastdds_profile() -> Path:
    """Path of fastdds.xml, in the source tree or in the installed share folder.

    Raises FileNotFoundError when the package was installed without it.
    """
    here = Path(__file__).resolve()
    candidates = [here.parents[1] / 'config' / 'fastdds.xml']
    candidates += [up / 'share' / PACKAGE / 'config' / 'fastdds.xml' for up in here.parents]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    raise FileNotFoundError(f'fastdds.xml is neither in the source nor in the share of {PACKAGE}')


def cell_environment(environ: Mapping[str, str] = os.environ) -> dict[str, str]:
    """Return the variables every process of the cell runs with, name to value.

    * FASTRTPS_DEFAULT_PROFILES_FILE (the name Fast DDS 2.x reads): shared memory for stacks.
    * MALLOC_MMAP_MAX_, MALLOC_TRIM_THRESHOLD_, MALLOC_ARENA_MAX (glibc): keep freed image buffers,
      for all threads, because mapping and zeroing fresh pages for every stack costs more than
      copying it.
    * OMP_WAIT_POLICY: threads of one process that wait for work leave the cores to the others.
    * OPENBLAS_NUM_THREADS: its threads wait for each other by spinning; when another process has
      the core, a product of matrices that takes 5 ms takes seconds.
    """
    defaults = {
        'FASTRTPS_DEFAULT_PROFILES_FILE': str(fastdds_profile()),
        'MALLOC_MMAP_MAX_': '0',
        'MALLOC_TRIM_THRESHOLD_': '4000000000',
        'MALLOC_ARENA_MAX': '1',
        'OMP_WAIT_POLICY': 'PASSIVE',
        'OPENBLAS_NUM_THREADS': '1',
    }
    return {name: environ.get(name) or value for name, value in defaults.items()}


if __name__ == '__main__':
    for name, value in cell_environment().items():
        print(f'export {name}={shlex.quote(value)}')
