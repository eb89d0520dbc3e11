"""Hostile sessions: malformed, cut, foreign and lying files, and what they do to the reader.

Every input is a real session changed by one of a dozen mutations (tests/session_mutator.py). It is
read and decoded, and by turns reconstructed, exported, reported and recovered. The number of
inputs is 3000, or the environment variable PS_BENCH_INPUTS; PS_BENCH_PROCESSES of them work.
"""
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
import os
from pathlib import Path
import sys
import tempfile
import time

from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).parents[1]))

BATCH = 500
PROCESSES = int(os.environ.get('PS_BENCH_PROCESSES', len(os.sched_getaffinity(0))))


def main() -> None:
    """Print the table."""
    from session_attack import batch
    from session_mutator import small_session
    from sessions import record, rendered
    console = Console()
    inputs = int(os.environ.get('PS_BENCH_INPUTS', '3000'))
    kinds: Counter[str] = Counter()
    wrong: list[str] = []
    dead, peak, before = 0, 0.0, float('inf')
    begin = time.monotonic()
    # in memory where possible: it is not the disk that is tried
    shared = Path('/dev/shm')
    with tempfile.TemporaryDirectory(dir=shared if shared.is_dir() else None) as folder:
        source = str(small_session(Path(folder) / 'source', record, rendered(scale=0.025)))
        with ProcessPoolExecutor(PROCESSES, get_context('spawn')) as pool:
            futures = {
                pool.submit(batch, source, first, min(BATCH, inputs - first)): first
                for first in range(0, inputs, BATCH)}
            for future in as_completed(futures):
                try:
                    done, found, most, least = future.result()
                except BrokenProcessPool:
                    dead += 1
                    console.print(f'a process died; seeds {futures[future]} and following')
                    continue
                kinds += done
                wrong += found
                for line in found[:5]:
                    console.print(line, markup=False)
                peak, before = max(peak, most), min(before, least)
                console.print(f'{kinds.total()} of {inputs}, {len(wrong)} wrong', end='\r')
    outside = [line for line in wrong if ': open ' in line or ': os.' in line]
    table = Table('inputs', 'exceptions', 'processes that died', 'changes outside the folder',
                  'memory before, MB', 'peak, MB', 'inputs/s')
    table.add_row(str(kinds.total()), str(len(wrong) - len(outside)), str(dead),
                  str(len(outside)), f'{before:.0f}', f'{peak:.0f}',
                  f'{kinds.total() / (time.monotonic() - begin):.0f}')
    console.print(table)
    console.print(', '.join(f'{kind} {count}' for kind, count in sorted(kinds.items())))


if __name__ == '__main__':
    main()
