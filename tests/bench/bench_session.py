"""Writing sessions: speed against a plain write of the same bytes, and kills at random moments.

The number of kills is 100, or the environment variable PS_BENCH_KILLS.
"""
from functools import partial
import importlib.util
import os
from pathlib import Path
import random
import sys
import tempfile
import time

import numpy as np
from rich.console import Console
from rich.table import Table

from ps_inspection.session_writer import SessionWriter, WriterOptions
from ps_reconstruction.session_format import Topic

STACK = Topic('/ps_head/stack', 'ps_interfaces/msg/PhotometricStack', definition='string data\n')
STACK_BYTES = {'4 x 1280x1024 mono8': 4 * 1280 * 1024, '4 x 2448x2048 mono8': 4 * 2448 * 2048}
TOTAL_BYTES = 400_000_000
ROUNDS = 3


def picture_bytes(size: int) -> bytes:
    """What a picture with shot noise compresses like: 4 of 8 bits are noise."""
    noise = np.random.default_rng(0).normal(120, 6, size)
    return noise.astype(np.uint8).tobytes()


def plain(path: Path, data: bytes, count: int, sync: bool) -> float:
    """Seconds for count plain writes, each acknowledged like a stack."""
    begin = time.perf_counter()
    with path.open('wb', buffering=0) as stream:
        for _ in range(count):
            stream.write(data)
            if sync:
                os.fdatasync(stream.fileno())
    return time.perf_counter() - begin


def session(folder: Path, data: bytes, count: int, sync: bool, compression: str) -> float:
    """Seconds until the last of count stacks is acknowledged."""
    acknowledged = []
    begin = time.perf_counter()
    writer = SessionWriter(folder, [STACK], WriterOptions(
        compression, queue_bytes=len(data) * count, sync=sync, min_free_bytes=0))
    for i in range(count):
        assert writer.write(STACK.name, data, i, i,
                            lambda: acknowledged.append(time.perf_counter()))
    writer.close()
    assert len(acknowledged) == count
    return acknowledged[-1] - begin


def speed(console: Console) -> None:
    """Print MB/s of every way of writing, the best of ROUNDS."""
    table = Table('stack', 'written', 'sync', 'MB/s', 'of plain')
    for name, size in STACK_BYTES.items():
        data = picture_bytes(size)
        count = max(2, TOTAL_BYTES // size)
        for sync in (False, True):
            ways = {'plain': partial(plain, data=data, count=count, sync=sync)} | {
                f'session, {name}': partial(
                    session, data=data, count=count, sync=sync, compression=name)
                for name in ('none', 'lz4', 'zstd')}
            rates = dict.fromkeys(ways, 0.0)
            for _ in range(ROUNDS):
                for way, write in ways.items():
                    with tempfile.TemporaryDirectory() as folder:
                        rate = size * count / write(Path(folder) / 'x') / 1e6
                        rates[way] = max(rates[way], rate)
            for way, rate in rates.items():
                table.add_row(name, way, 'yes' if sync else 'no', f'{rate:.0f}',
                              f'{rate / rates["plain"]:.2f}')
    console.print(table)


def kills(console: Console, count: int) -> None:
    """Kill a recording process at random moments and recover its session."""
    test = (Path(__file__).parents[2]
            / 'ros2_ws/src/ps_inspection/test/test_session_files.py')
    spec = importlib.util.spec_from_file_location(test.stem, test)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[test.stem] = module
    spec.loader.exec_module(module)
    lost = acknowledged = recovered = 0
    chance = random.Random(1)
    for i in range(count):
        with tempfile.TemporaryDirectory() as folder:
            result = module.kill_and_recover(Path(folder) / f'kill{i}', chance)
        lost += len(result[0])
        acknowledged += result[1]
        recovered += result[2]
    console.print(f'{count} kills at random moments: {acknowledged} messages of 0.5 MB '
                  f'acknowledged, {lost} of them lost, {recovered} recovered; '
                  f'{count} of {count} files recovered')


def main() -> None:
    """Print both tables."""
    console = Console()
    speed(console)
    kills(console, int(os.environ.get('PS_BENCH_KILLS', '100')))


if __name__ == '__main__':
    main()
