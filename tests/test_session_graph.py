"""The session recorder as a process: real messages over DDS, recorded, killed, read back."""
from collections.abc import Callable, Iterator
import csv
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import time
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import String

from ps_head_driver.conversions import message_to_stack, stack_to_message
from ps_head_driver.errors import ErrorCode
from ps_head_driver.ros_support import LATCHED, RELIABLE
from ps_head_driver.stack import Light, Panel, Stack
from ps_inspection.graph import NODES
from ps_inspection.runner import Cell
from ps_inspection.session_recovery import recover
from ps_interfaces.msg import AcquisitionDone, HeadCalibration, PhotometricStack
from ps_interfaces.srv import StartSession, StopSession
from ps_reconstruction.session_reader import Scan, Session

pytestmark = pytest.mark.graph
RECORDER = [node for node in NODES if node.executable == 'session_recorder']


class Peer:
    """What the rest of the cell would send and hear."""

    def __init__(self, cell: Cell, folder: Path) -> None:
        self.cell, self.folder = cell, folder
        self.context = Context()
        self.context.init()
        self.node = Node('peer', namespace='ps_head', context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.stack = self.node.create_publisher(PhotometricStack, 'stack', RELIABLE)
        self.done = self.node.create_publisher(AcquisitionDone, 'acquisition_done', RELIABLE)
        self.calibration = self.node.create_publisher(HeadCalibration, 'calibration', LATCHED)
        self.active: list[str] = []
        self.recorded: list[str] = []
        self.diagnostics: list[Any] = []
        self.node.create_subscription(
            String, 'session/active', lambda m: self.active.append(m.data), LATCHED)
        self.node.create_subscription(
            String, 'session/recorded', lambda m: self.recorded.append(m.data), 100)
        self.node.create_subscription(
            DiagnosticArray, '/diagnostics', lambda m: self.diagnostics.extend(m.status), 10)
        self.start_client = self.node.create_client(StartSession, 'session/start')
        self.stop_client = self.node.create_client(StopSession, 'session/stop')
        self.until(lambda: self.stack.get_subscription_count() and self.active
                   and self.start_client.service_is_ready()
                   and self.stop_client.service_is_ready())

    def until(self, condition: Callable[[], Any], seconds: float = 15.0) -> None:
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, 'timed out'
            self.executor.spin_once(timeout_sec=0.05)

    def call(self, client: Any, request: Any) -> Any:
        future = client.call_async(request)
        self.until(future.done)
        return future.result()

    def start(self, name: str, **fields: str) -> StartSession.Response:
        return self.call(self.start_client, StartSession.Request(name=name, **fields))

    def stop(self) -> StopSession.Response:
        return self.call(self.stop_client, StopSession.Request())

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()


def make_stack(stack_id: str, side: int = 64) -> Stack:
    noise = np.random.default_rng(len(stack_id)).integers(0, 256, (side, side), np.uint8)
    return Stack(images=[noise, noise.T.copy()],
                 lights=[Light(panel=Panel.E, name='BF_E'), Light(panel=Panel.N, name='BF_N')],
                 stack_id=stack_id, part_id='p')


@pytest.fixture
def peer(tmp_path: Path, ros_domain: int) -> Iterator[Peer]:
    with Cell({'session_folder': str(tmp_path / 'sessions')}, nodes=RECORDER,
              log_folder=tmp_path / 'logs') as cell:
        peer = Peer(cell, tmp_path / 'sessions')
        yield peer
        peer.close()


def test_recorded_stacks_are_read_back(peer: Peer) -> None:
    peer.calibration.publish(HeadCalibration(calibration_id='before the session'))
    time.sleep(0.3)
    started = peer.start('first', part_id='bracket', notes='a note')
    assert started.success, started.message
    assert started.uri == str(peer.folder / 'first')
    peer.until(lambda: peer.active[-1] == 'first')
    ids = [f'stack {i}' for i in range(5)]
    for stack_id in ids:
        peer.stack.publish(stack_to_message(make_stack(stack_id)))
    peer.until(lambda: peer.recorded == ids)
    # what is acknowledged is in the file now, with the session still open
    assert [s.stack_id for s in Session(peer.folder / 'first').stacks()] == ids
    stopped = peer.stop()
    assert stopped.success, stopped.message
    assert stopped.stacks == 5
    peer.until(lambda: peer.active[-1] == '')

    scan = Scan()
    stacks = [message_to_stack(message) for message in Session(peer.folder / 'first').stacks(scan)]
    assert scan.complete
    assert not scan.problems
    for stack_id, stack in zip(ids, stacks, strict=True):
        np.testing.assert_array_equal(stack.images, make_stack(stack_id).images)
        assert [light.name for light in stack.lights] == ['BF_E', 'BF_N']
    info = Session(peer.folder / 'first').info()
    assert info.counts['/ps_head/calibration'] == 1
    assert scan.metadata['session']['part_id'] == 'bracket'
    assert scan.metadata['session']['notes'] == 'a note'
    assert scan.metadata['session']['software']
    assert scan.metadata['parameters/session_recorder']['compression'] == 'none'

    anyreader = pytest.importorskip('rosbags.highlevel')
    with anyreader.AnyReader([peer.folder / 'first']) as reader:   # checks definitions by hash
        assert reader.message_count == stopped.messages
        found = [reader.deserialize(data, c.msgtype).stack_id
                 for c, _, data in reader.messages() if c.topic == '/ps_head/stack']
    assert found == ids


def test_stop_waits_for_a_stack_on_its_way(peer: Peer) -> None:
    assert peer.start('late').success
    peer.done.publish(AcquisitionDone(stack_id='on its way', success=True))
    time.sleep(0.3)
    future = peer.stop_client.call_async(StopSession.Request())
    end = time.monotonic() + 0.5
    while time.monotonic() < end:
        peer.executor.spin_once(timeout_sec=0.05)
    assert not future.done()
    peer.stack.publish(stack_to_message(make_stack('on its way')))
    peer.until(future.done)
    assert future.result().success
    assert future.result().stacks == 1


def test_wrong_requests_are_answered(peer: Peer) -> None:
    answer = peer.stop()
    assert (answer.success, answer.error_code) == (False, ErrorCode.SESSION_NOT_RECORDING)
    answer = peer.start('../escape')
    assert (answer.success, answer.error_code) == (False, ErrorCode.SESSION_BAD_REQUEST)
    assert peer.start('one').success
    answer = peer.start('two')
    assert (answer.success, answer.error_code) == (False, ErrorCode.SESSION_ALREADY_RECORDING)
    assert peer.stop().success
    answer = peer.start('one')
    assert (answer.success, answer.error_code) == (False, ErrorCode.SESSION_BAD_REQUEST)
    assert peer.start('').success
    assert peer.stop().success
    assert sorted(p.name[:8] for p in peer.folder.iterdir()) == ['one', 'session_']


def test_a_lost_folder_is_an_error_and_the_next_session_works(peer: Peer) -> None:
    assert peer.start('gone').success
    for entry in (peer.folder / 'gone').iterdir():
        entry.unlink()
    (peer.folder / 'gone').rmdir()
    peer.stack.publish(stack_to_message(make_stack('lost')))
    peer.until(lambda: peer.active[-1] == '' and len(peer.active) > 2)
    peer.until(lambda: any(s.level == b'\x02' and 'removed' in s.message
                           for s in peer.diagnostics))
    answer = peer.stop()
    assert (answer.success, answer.error_code) == (False, ErrorCode.SESSION_WRITE_FAILED)
    assert peer.recorded == []
    assert peer.start('next').success
    peer.stack.publish(stack_to_message(make_stack('kept')))
    peer.until(lambda: peer.recorded == ['kept'])
    assert peer.stop().success


def test_killed_recorder_loses_no_acknowledged_stack(peer: Peer) -> None:
    assert peer.start('killed').success
    for i in range(8):
        peer.stack.publish(stack_to_message(make_stack(f'{i}', side=512)))
    peer.until(lambda: len(peer.recorded) >= 4)
    os.kill(peer.cell.processes[0].process.pid, signal.SIGKILL)
    peer.cell.processes[0].process.wait()
    result = recover(Session(peer.folder / 'killed'))
    assert result.changed
    found = [stack.stack_id for stack in Session(peer.folder / 'killed').stacks()]
    assert found[:len(peer.recorded)] == peer.recorded


def test_terminated_recorder_closes_its_session(peer: Peer) -> None:
    assert peer.start('ended').success
    peer.stack.publish(stack_to_message(make_stack('x')))
    peer.until(lambda: peer.recorded == ['x'])
    process = peer.cell.processes[0].process
    process.send_signal(signal.SIGTERM)
    assert process.wait(10) == 0
    assert Session(peer.folder / 'ended').info().complete


def run_session_command(*words: object) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, '-m', 'ps_inspection.cli.ps_session', *map(str, words)],
                          capture_output=True, text=True, timeout=60, check=False)


def record_three(peer: Peer, name: str) -> Path:
    peer.calibration.publish(HeadCalibration(calibration_id='played'))
    time.sleep(0.3)
    assert peer.start(name).success
    for stack_id in 'abc':
        peer.stack.publish(stack_to_message(make_stack(stack_id)))
        peer.until(lambda stack_id=stack_id: stack_id in peer.recorded)
        time.sleep(0.2)
    assert peer.stop().success
    return peer.folder / name


def test_session_is_played_into_the_graph(peer: Peer) -> None:
    folder = record_three(peer, 'source')
    stacks: list[PhotometricStack] = []
    calibrations: list[str] = []
    peer.node.create_subscription(PhotometricStack, '/other/stack', stacks.append, RELIABLE)
    peer.node.create_subscription(
        HeadCalibration, '/other/calibration', lambda m: calibrations.append(m.calibration_id),
        LATCHED)
    # from the second stack on; the calibration before it comes all the same
    times = [message.log_time for message in Session(folder).messages()
             if message.topic.name != '/diagnostics']
    second = [message.log_time for message in Session(folder).stack_messages()][1]
    start = (second - times[0]) * 1e-9 - 0.05
    command = subprocess.Popen(
        [sys.executable, '-m', 'ps_inspection.cli.ps_session', 'play', str(folder),
         '--namespace', 'other', '--start', str(start), '--rate', '2'], stdout=subprocess.PIPE)
    try:
        peer.until(lambda: command.poll() is not None, 30)
    finally:
        command.kill()
        command.communicate()
    assert command.returncode == 0
    peer.until(lambda: len(stacks) == 2 and calibrations)
    assert [stack.stack_id for stack in stacks] == ['b', 'c']
    assert calibrations == ['played']
    # as texts: a NaN is not equal to itself, and the padding in serialized data is arbitrary
    original = [repr(stack) for stack in Session(folder).stacks()]
    assert [repr(stack) for stack in stacks] == original[1:]


def test_info_and_recover_commands(peer: Peer, tmp_path: Path) -> None:
    folder = record_three(peer, 'cut')
    file = folder / 'cut_0.mcap'
    file.write_bytes(file.read_bytes()[:-2000])
    (folder / 'metadata.yaml').unlink()
    report = tmp_path / 'report.json'

    done = run_session_command('info', folder, '--json', report)
    assert done.returncode == 0, done.stderr
    assert 'unfinished' in done.stdout
    content = json.loads(report.read_text())
    assert content['stacks'] == 3
    assert content['metadata']['session']['session_id'] == 'cut'
    done = run_session_command('recover', folder)
    assert done.returncode == 0, done.stderr
    assert Session(folder).info().complete
    assert 'nothing to do' in run_session_command('recover', folder).stdout


def test_export_keeps_every_stack(peer: Peer, tmp_path: Path) -> None:
    from ps_head_driver.stack_folder import read_stack
    folder = record_three(peer, 'parts')
    done = run_session_command('export', folder, '--out', tmp_path / 'out')
    assert done.returncode == 0, done.stderr
    with (tmp_path / 'out' / 'index.csv').open() as stream:
        rows = list(csv.DictReader(stream))
    assert [row['stack_id'] for row in rows] == ['a', 'b', 'c']
    for row in rows:
        stack, _ = read_stack(tmp_path / 'out' / row['folder'])
        np.testing.assert_array_equal(stack.images, make_stack(row['stack_id']).images)
    again = run_session_command('export', folder, '--out', tmp_path / 'out')
    assert '3 were there' in ' '.join(again.stdout.split())


@pytest.mark.parametrize('command', ['info', 'recover', 'play'])
def test_commands_say_in_one_line_what_is_wrong(tmp_path: Path, command: str) -> None:
    done = run_session_command(command, tmp_path / 'missing')
    assert done.returncode == 1
    assert done.stderr.strip().count('\n') == 0
    assert 'does not exist' in done.stderr
    assert run_session_command(command).returncode == 2
