"""Reading hostile sessions under watch: what raises, what is changed outside the folder, memory.

Used by test_session_fuzz.py (some) and bench/bench_session_fuzz.py (many).
"""
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
import os
from pathlib import Path
import resource
import shutil
import sys
import tempfile
from typing import Any

from matplotlib import colormaps  # noqa: F401   makes its configuration folder when imported
import numba
import numpy as np
from session_mutator import Mutator

from ps_head_driver.conversions import message_to_stack
from ps_head_driver.errors import PsError
from ps_inspection.session_export import export_session
from ps_inspection.session_reconstruct import reconstruct_session
from ps_inspection.session_recovery import recover
from ps_inspection.session_report import write_report
from ps_reconstruction.pipeline import reconstruct, warm_up
from ps_reconstruction.session_reader import Session

MEMORY_LIMIT = 8 << 30      # so that runaway memory ends a process and not the machine


def use(folder: Path, out: Path, seed: int) -> None:
    """Do with a session what the commands do; the slower, the more rarely.

    :raises Exception: whatever is not a PsError has no business here.
    """
    with suppress(PsError):
        session = Session(folder)
        session.info()
        for message in session.stacks():
            with suppress(PsError):
                stack = message_to_stack(message)
                if seed % 14 == 0:
                    reconstruct(stack)
        if seed % 10 == 0:
            export_session(session, out / 'export')
        if seed % 100 == 0:
            reconstruct_session(session, out / 'again')
            write_report(session, out / 'report.html')
        if seed % 4 == 1:
            recover(session)
            assert Session(folder).info().complete
            assert not recover(Session(folder)).changed


_watched: list[tuple[Path, list[str]]] = []
# the compiler's cache is no change outside: a kernel is compiled for every type of its inputs
_CACHE = [Path(os.path.realpath(folder)) for folder in (numba.config.CACHE_DIR,) if folder]
# audit event: places of paths among its arguments, and of the file descriptors of their folders
_CHANGES = {'os.mkdir': {0: 2}, 'os.rename': {0: 2, 1: 3}, 'os.remove': {0: 1}, 'os.rmdir': {0: 1},
            'os.symlink': {1: 2}, 'os.link': {1: 3}, 'os.truncate': {0: None}}


def _audit(event: str, arguments: tuple[Any, ...]) -> None:
    if not _watched:
        return
    if event == 'open':
        flags = arguments[2] if isinstance(arguments[2], int) else 0
        if not flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
            return
        paths = [arguments[0]] if isinstance(arguments[0], str | bytes | os.PathLike) else []
    elif event in _CHANGES:
        paths = []
        for place, folder in _CHANGES[event].items():
            # the entry itself is changed, not what a link leads to
            head, name = os.path.split(os.fsdecode(arguments[place]))
            if folder is not None and arguments[folder] != -1:
                head = os.path.join(f'/proc/self/fd/{arguments[folder]}', head)
            paths.append(os.path.join(os.path.realpath(head), name))
    else:
        return
    inside, found = _watched[-1]
    for path in paths:
        real = Path(os.path.realpath(path) if event == 'open' else path)
        if not any(map(real.is_relative_to, (inside, *_CACHE))) and (
                '__pycache__' not in real.parts):
            found.append(f'{event} {real}')


@contextmanager
def changes_outside(folder: Path) -> Iterator[list[str]]:
    """What this process changes in the file system outside a folder: filled while in the block."""
    if not getattr(sys, '_ps_audited', False):
        sys.addaudithook(_audit)        # cannot be removed
        sys._ps_audited = True          # type: ignore[attr-defined]
    _watched.append((Path(os.path.realpath(folder)), []))
    try:
        yield _watched[-1][1]
    finally:
        _watched.pop()


def attack(mutator: Mutator, seed: int, folder: Path) -> tuple[str, list[str]]:
    """Make the input of a seed, use it, and clean up.

    :returns: kind of the mutation, and what went wrong: an exception, changes outside the folder.
    """
    inside = folder / 'inside'
    shutil.rmtree(inside, ignore_errors=True)
    inside.mkdir(parents=True)
    kind = mutator.write(seed, inside / 'in')
    wrong = []
    with changes_outside(inside) as outside, np.errstate(all='ignore'):
        try:
            use(inside / 'in', inside / 'out', seed)
        except Exception as error:
            wrong.append(f'{type(error).__name__}: {error}'[:300])
    return kind, wrong + outside


def batch(source: str, first: int, count: int) -> tuple[Counter[str], list[str], float, float]:
    """Inputs by kind, what went wrong, peak memory and memory before, MB; in a process."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_LIMIT, MEMORY_LIMIT))
    mutator = Mutator(Path(source))
    with tempfile.TemporaryDirectory(prefix='ps_fuzz_', dir=Path(source).parent) as folder:
        # the compiler's cache is no change outside, nor the attack's memory; colour compiles other
        # kernels than grey pictures, as small ones do than large ones
        warm_up()
        for message in Session(Path(source)).stacks():
            reconstruct(message_to_stack(message))
        attack(mutator, 0, Path(folder))
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
        kinds: Counter[str] = Counter()
        wrong = []
        for seed in range(first, first + count):
            kind, found = attack(mutator, seed, Path(folder))
            kinds[kind] += 1
            wrong += [f'seed {seed}, {kind}: {text}' for text in found]
    return kinds, wrong, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3, before
