"""The runner: nodes as processes, readiness, failures by name, and nothing left behind."""
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

import pytest

pytest.importorskip('rclpy')

from ps_inspection.graph import NODES
from ps_inspection.runner import Cell, CellError

pytestmark = [pytest.mark.graph, pytest.mark.usefixtures('ros_domain')]
RECORDER = [node for node in NODES if node.executable == 'session_recorder']
PS_CELL = [sys.executable, '-m', 'ps_inspection.cli.ps_cell']


def alive(pid: int) -> bool:
    try:
        state = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state != 'Z'


def wait_until(condition: object, seconds: float = 10.0) -> bool:
    end = time.monotonic() + seconds
    while not condition():      # type: ignore[operator]
        if time.monotonic() > end:
            return False
        time.sleep(0.05)
    return True


def recorder_cell(tmp_path: Path, **options: object) -> Cell:
    return Cell({'session_folder': str(tmp_path)}, nodes=RECORDER, log_folder=tmp_path / 'logs',
                **options)      # type: ignore[arg-type]


def test_stop_leaves_no_process(tmp_path: Path) -> None:
    with recorder_cell(tmp_path) as cell:
        pids = [node.process.pid for node in cell.processes]
        assert all(map(alive, pids))
        assert all(node.ready_s is not None for node in cell.processes)
        cell.check()
    assert not any(map(alive, pids))


def test_node_that_cannot_start_is_named_with_its_reason(tmp_path: Path) -> None:
    wrong = tmp_path / 'wrong.yaml'
    wrong.write_text('/**:\n  ros__parameters:\n    compression: gzip\n')
    cell = Cell({'params_file': str(wrong)}, nodes=RECORDER, log_folder=tmp_path / 'logs')
    with pytest.raises(CellError, match=r'session_recorder ended with exit code 1(.|\n)*gzip'):
        cell.start()
    assert cell.processes == []


def test_node_that_dies_is_named(tmp_path: Path) -> None:
    with recorder_cell(tmp_path) as cell:
        os.kill(cell.processes[0].process.pid, signal.SIGKILL)
        cell.processes[0].process.wait(5)
        with pytest.raises(CellError, match='session_recorder killed by SIGKILL'):
            cell.check()


def test_node_that_is_not_ready_in_time_is_named(tmp_path: Path) -> None:
    with pytest.raises(CellError, match='session_recorder is not ready'):
        recorder_cell(tmp_path, ready_timeout=0.05).start()


def test_node_that_does_not_stop_is_killed(tmp_path: Path) -> None:
    cell = recorder_cell(tmp_path, grace=0.5)
    cell.start()
    pid = cell.processes[0].process.pid
    os.kill(pid, signal.SIGSTOP)
    assert cell.stop() == ['session_recorder']
    assert not alive(pid)


KILLED = """
import os, sys
from pathlib import Path
from ps_inspection.graph import NODES
from ps_inspection.runner import Cell
cell = Cell(nodes=[n for n in NODES if n.executable == 'session_recorder'],
            log_folder=Path(sys.argv[1]))
cell.start()
print(cell.processes[0].process.pid, flush=True)
os.kill(os.getpid(), 9)
"""


def test_nodes_end_when_their_runner_is_killed(tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, '-c', KILLED, str(tmp_path)], capture_output=True,
                          timeout=60, check=False)
    pid = int(done.stdout)
    assert done.returncode == -signal.SIGKILL
    assert wait_until(lambda: not alive(pid))


def test_wrong_usage_is_exit_code_2() -> None:
    for words in (['camera'], ['nonsense:=1'], ['camera:=usb'], ['--nonsense']):
        done = subprocess.run([*PS_CELL, *words], capture_output=True, timeout=60, check=False)
        assert done.returncode == 2, words
        assert b'Traceback' not in done.stderr


def test_whole_cell_starts_and_stops_on_a_signal(tmp_path: Path) -> None:
    report = tmp_path / 'report.json'
    process = subprocess.Popen(
        [*PS_CELL, 'fake_hardware:=true', f'session_folder:={tmp_path}',
         '--log-folder', str(tmp_path / 'logs'), '--json', str(report)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        for line in process.stdout:
            if 'Ctrl-C' in line:
                break
        process.send_signal(signal.SIGTERM)
        _, errors = process.communicate(timeout=40)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 0, errors
    content = json.loads(report.read_text())
    assert [node['name'] for node in content['nodes']] == [node.executable for node in NODES]
    assert content['killed'] == []
    assert content['head_state'] in ('CONNECTED', 'HOMING', 'READY')
    assert not any(alive(node['pid']) for node in content['nodes'])
