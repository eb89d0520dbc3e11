"""The robot program of examples/, as a customer would run it: twelve positions, fake head."""
import json
from pathlib import Path
import subprocess
import sys
from urllib.parse import unquote, urlparse

import pytest

pytest.importorskip('ps_interfaces.msg', reason='needs the built workspace (make setup)')

from ps_inspection.runner import Cell

pytestmark = [pytest.mark.graph, pytest.mark.usefixtures('ros_domain')]
PROGRAM = Path(__file__).resolve().parents[1] / 'examples' / 'robot_cell.py'
MOVE_TIME = 0.5


def test_twelve_positions(tmp_path: Path):
    (tmp_path / 'small.yaml').write_text('/**:\n  ros__parameters:\n    scale: 0.25\n')
    arguments = {
        'fake_hardware': 'true', 'scene': 'weld', 'params_file': str(tmp_path / 'small.yaml'),
        'output_folder': str(tmp_path / 'files')}
    with Cell(arguments, log_folder=tmp_path / 'logs') as cell:
        done = subprocess.run(
            [sys.executable, PROGRAM, '--move-time', str(MOVE_TIME), '--json',
             tmp_path / 'rows.json'], capture_output=True, text=True, timeout=180, check=False)
        cell.check()
    print(done.stdout)
    assert done.returncode == 0, done.stdout + done.stderr
    assert 'the robot stands still for' in done.stdout
    rows = json.loads((tmp_path / 'rows.json').read_text())
    assert len(rows) == 12
    assert len({row['stack_id'] for row in rows}) == 12
    for row in rows:
        assert row['success']
        assert row['valid'] > 0.9
        for uri in row['files']:
            path = Path(unquote(urlparse(uri).path))
            assert path.is_file()
            assert path.parent.name == row['stack_id']
    # four exposures of 20 ms and the way there and back; the rendering is not waited for
    still = sorted(row['still'] for row in rows)
    assert still[len(still) // 2] < 1.0
