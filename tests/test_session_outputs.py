"""Sessions to stack folders and reconstructions: here, in processes, and on a Dask cluster."""
from collections.abc import Iterator
from contextlib import contextmanager
import csv
from dataclasses import replace
import importlib.util
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

pytest.importorskip('rclpy')

from sessions import record, rendered

from ps_head_driver.errors import PsError
from ps_head_driver.stack import Stack
from ps_head_driver.stack_folder import read_stack
from ps_inspection.session_export import export_session
from ps_inspection.session_reconstruct import Workers, reconstruct_session
from ps_reconstruction.pipeline import Options, Reconstruction, reconstruct
from ps_reconstruction.session_reader import Session

IMAGES = ('normal', 'slope', 'albedo', 'height', 'curvature', 'shape', 'confidence', 'mask')
SMALL = 0.06


def index(folder: Path) -> list[dict[str, str]]:
    with (folder / 'index.csv').open(newline='') as stream:
        return list(csv.DictReader(stream))


def numbered(count: int, scale: float = SMALL) -> list[Stack]:
    stack = rendered(scale=scale)
    return [replace(stack, stack_id=f'stack {i}', images=[image + np.uint8(i) for image
                                                          in stack.images])
            for i in range(count)]


def assert_same(folder: Path, expected: Reconstruction) -> None:
    found = np.load(folder / 'result.npz')
    for name in IMAGES:
        np.testing.assert_array_equal(found[name], getattr(expected, name), err_msg=name)


# ---------------------------------------------------------------------------- export

def test_exported_stacks_give_the_same_reconstruction_to_the_bit(tmp_path: Path) -> None:
    plain = rendered()
    rng = np.random.default_rng(3)
    gains = rng.uniform(0.9, 1.1, (4, 20, 30)).astype(np.float32)
    everything = replace(
        plain, stack_id='with all', ambient=np.full_like(plain.images[0], 3),
        mask=rng.random(plain.shape) > 0.1, flat_id='flat',
        gain_maps=list(gains / gains.max()),        # as capture_flat makes them
        calibration_id='cal-1')
    deep = replace(plain, stack_id='16 bit', images=[
        image.astype(np.uint16) * 200 for image in plain.images])
    session = Session(record(tmp_path / 's', [plain, everything, deep]))
    outcome = export_session(session, tmp_path / 'out')
    assert (outcome.done, outcome.failed) == (3, {})
    rows = index(tmp_path / 'out')
    for row, stack in zip(rows, (plain, everything, deep), strict=True):
        folder = tmp_path / 'out' / row['folder']
        again, _ = read_stack(folder)
        ours, theirs = reconstruct(stack), reconstruct(again)
        for name in IMAGES:
            np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name),
                                          err_msg=f'{stack.stack_id}: {name}')
        assert ours.roughness == theirs.roughness
        assert row['files'].split() == sorted(
            str(file.relative_to(folder)) for file in folder.rglob('*') if file.is_file())
    first = rows[0]
    assert first['part_id'] == 'part 7'
    assert [float(first[f'pose_{name}']) for name in ('x', 'y', 'z', 'qy')] == [0.1, 0.2, 0.3, 1.0]
    assert first['pose_frame'] == 'base'
    assert float(first['convergence_radius_m']) == 0.06
    assert rows[1]['calibration_id'] == 'cal-1'


def test_names_in_a_session_cannot_leave_the_folder(tmp_path: Path) -> None:
    evil = [replace(rendered(scale=SMALL), stack_id=name, part_id=name, session_id=name,
                    flat_id=name)
            for name in ('../../escape', '/etc/passwd', '..', 'a\x00b', '\n', 'x' * 5000, '')]
    session = Session(record(tmp_path / 's', evil))
    before = {path for path in tmp_path.rglob('*') if 's' not in path.parts}
    for work, out in ((export_session, 'export'), (reconstruct_session, 'again')):
        outcome = work(session, tmp_path / out)
        assert outcome.done + len(outcome.failed) == len(evil)
        assert outcome.done >= len(evil) - 1
        for path in (tmp_path / out).iterdir():
            assert path.resolve().parent == (tmp_path / out).resolve()
    assert {path.name for path in tmp_path.iterdir()} == {'s', 'export', 'again'}
    assert before <= set(tmp_path.rglob('*'))


# ---------------------------------------------------------------------------- reconstruct

def test_empty_gain_maps_are_named() -> None:
    stack = replace(rendered(scale=SMALL), gain_maps=[np.zeros((0, 4), np.float32)] * 4)
    with pytest.raises(PsError, match='gain_maps'):
        reconstruct(stack)


def test_bad_stacks_are_reported_and_skipped(tmp_path: Path) -> None:
    good = numbered(2)
    dark = replace(good[0], stack_id='one light', images=good[0].images[:1],
                   lights=good[0].lights[:1])
    loud = replace(good[0], stack_id='loud', lights=[replace(light, gain=1e5)
                                                     for light in good[0].lights])
    session = Session(record(
        tmp_path / 's', [good[0], b'\0\1\0\0rubbish', dark, good[1], loud]))
    lines: list[str] = []
    outcome = reconstruct_session(session, tmp_path / 'out', progress=lines.append)
    assert outcome.done == 2
    assert list(outcome.failed) == ['000001_stack', '000002_one_light', '000004_loud']
    assert outcome.failed['000004_loud'].startswith('lights: ')
    assert [line.split()[0] for line in lines] == [f'{i}/5' for i in range(1, 6)]
    rows = index(tmp_path / 'out')
    assert [row['stack_id'] for row in rows] == ['stack 0', '', '', 'stack 1', '']
    assert all(bool(row['error']) == (row['folder'] in outcome.failed) for row in rows)
    assert_same(tmp_path / 'out' / '000003_stack_1', reconstruct(good[1]))


def test_recorded_parameters_are_used(tmp_path: Path) -> None:
    stack = rendered(scale=SMALL)
    recorded = {'parameters/reconstruction': {
        'method': 'ls', 'height_rounds': '0', 'smoothness': '2.5', 'near_field': 'True',
        'l_filter': 'nonsense', 'outputs': 'height', 'form': 'plane'}}
    session = Session(record(tmp_path / 's', [stack], recorded))
    outcome = reconstruct_session(session, tmp_path / 'out')
    assert outcome.problems == ['recorded parameter l_filter is not usable; 0.0008 is used']
    expected = reconstruct(stack, Options(height_rounds=0, smoothness=2.5, form='plane'))
    assert_same(tmp_path / 'out' / '000000_boss', expected)
    about = json.loads((tmp_path / 'out' / '000000_boss' / 'stack.json').read_text())
    assert about['sa'] == expected.roughness.sa
    other = {'parameters/reconstruction': {'method': 'stv'}}
    session = Session(record(tmp_path / 'stv', [stack], other))
    reconstruct_session(session, tmp_path / 'ls', 'ls')
    assert index(tmp_path / 'ls')[0]['method'] == 'ls'


def test_an_interrupted_run_goes_on_in_processes(tmp_path: Path) -> None:
    stacks = numbered(4)
    session = Session(record(tmp_path / 's', stacks))

    def interrupt(line: str) -> None:
        if line.startswith('2/'):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reconstruct_session(session, tmp_path / 'out', progress=interrupt)
    (tmp_path / 'out' / '.000002_stack_2.abc.part').mkdir()     # as a killed worker leaves it
    outcome = reconstruct_session(session, tmp_path / 'out', workers=Workers(2))
    assert (outcome.done, outcome.skipped, outcome.failed) == (2, 2, {})
    assert [row['stack_id'] for row in index(tmp_path / 'out')] == [s.stack_id for s in stacks]
    assert sorted(path.name for path in (tmp_path / 'out').iterdir()) == [
        '.session', *(f'00000{i}_stack_{i}' for i in range(4)), 'index.csv']
    for i, stack in enumerate(stacks):
        assert_same(tmp_path / 'out' / f'00000{i}_stack_{i}', reconstruct(stack))
    with pytest.raises(PsError, match='holds the output of'):
        reconstruct_session(Session(record(tmp_path / 'other', stacks[:1])), tmp_path / 'out')


# ---------------------------------------------------------------------------- Dask

needs_dask = pytest.mark.skipif(importlib.util.find_spec('distributed') is None,
                                reason='needs Dask (pip install distributed)')


@contextmanager
def cluster(folder: Path, workers: int) -> Iterator[tuple[str, list[subprocess.Popen]]]:
    """A Dask scheduler and worker processes on loopback; yields its address and the workers."""
    file = folder / 'scheduler.json'

    def start(*words: object) -> subprocess.Popen:
        log = (folder / f'dask_{len(processes)}.log').open('wb')
        with log:
            return subprocess.Popen(
                [sys.executable, '-m', 'distributed.cli.dask_' + str(words[0]),
                 *map(str, words[1:])], stdout=log, stderr=subprocess.STDOUT)

    processes: list[subprocess.Popen] = []
    try:
        processes.append(start('scheduler', '--host', '127.0.0.1', '--port', 0,
                               '--scheduler-file', file, '--no-dashboard'))
        end = time.monotonic() + 60
        while not file.exists() or not file.read_text().endswith('}'):
            assert time.monotonic() < end, (folder / 'dask_0.log').read_text()
            time.sleep(0.1)
        address = json.loads(file.read_text())['address']
        for _ in range(workers):
            processes.append(start('worker', address, '--host', '127.0.0.1', '--nthreads', 1,
                                   '--no-nanny', '--no-dashboard', '--local-directory', folder))
        yield address, processes[1:]
    finally:
        for process in processes:
            process.kill()
            process.wait()


@needs_dask
@pytest.mark.graph
def test_a_cluster_that_loses_a_worker_does_every_stack_once(tmp_path: Path) -> None:
    stacks = numbered(16, scale=0.2)
    session, out = record(tmp_path / 's', stacks), tmp_path / 'out'
    done = lambda: len(list(out.glob('0*'))) if out.is_dir() else 0    # noqa: E731
    with cluster(tmp_path, 2) as (address, workers):
        command = subprocess.Popen(
            [sys.executable, '-m', 'ps_inspection.cli.ps_session', 'reconstruct', str(session),
             '--out', str(out), '--scheduler', address, '--json', str(tmp_path / 'report.json')],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        try:
            end = time.monotonic() + 120
            while done() < 2:
                assert time.monotonic() < end
                assert command.poll() is None, command.communicate()
                time.sleep(0.01)
            os.kill(workers[0].pid, signal.SIGKILL)
            at_kill = done()
            _, errors = command.communicate(timeout=120)
        finally:
            command.kill()
            command.wait()
        assert command.returncode == 0, errors
    assert at_kill < len(stacks)
    report = json.loads((tmp_path / 'report.json').read_text())
    assert (report['done'], report['skipped'], report['failed']) == (len(stacks), 0, {})
    rows = index(out)
    assert [row['stack_id'] for row in rows] == [stack.stack_id for stack in stacks]
    for row, stack in list(zip(rows, stacks, strict=True))[::5]:
        assert_same(out / row['folder'], reconstruct(stack))


@needs_dask
def test_no_scheduler_is_said_in_one_line(tmp_path: Path) -> None:
    session = Session(record(tmp_path / 's', numbered(1)))
    with pytest.raises(PsError, match='no Dask scheduler at tcp:'):
        reconstruct_session(session, tmp_path / 'out',
                            workers=Workers(scheduler='tcp://127.0.0.1:9'))
