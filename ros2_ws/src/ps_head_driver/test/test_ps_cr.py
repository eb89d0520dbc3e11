"""The command ps_cr: answers, files, and one line with the reason on failure."""
import json
from pathlib import Path
import re
import subprocess
import sys

import pytest
import yaml

from ps_head_driver.cli.ps_cr import main
from ps_head_driver.head_model import nominal_head_path


def test_inverse_writes_the_documented_keys(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    report = tmp_path / 'cr.json'
    assert main(['--cr', '0.06', '--json', str(report)]) == 0
    content = json.loads(report.read_text())
    assert set(content) == {
        'motor_counts', 'tilt_rad', 'cr_m', 'light_height_m', 'residual_m', 'branch',
        'dcr_dm_m_per_count', 'reachable_m', 'center_offset_m'}
    assert content['cr_m'] == pytest.approx(0.06, abs=abs(content['dcr_dm_m_per_count']))
    assert content['branch'] == 'UNCROSSED'
    assert content['reachable_m'] == pytest.approx([0, 0.22], abs=1e-5)
    assert f"motor counts   {content['motor_counts']}" in capsys.readouterr().out


def test_forward_undoes_inverse_on_the_branch_asked_for(tmp_path: Path) -> None:
    there, back = tmp_path / 'there.json', tmp_path / 'back.json'
    height = ['--light-height', '0.17']
    assert main(['--cr', '0.1', '--branch', 'crossed', *height, '--json', str(there)]) == 0
    found = json.loads(there.read_text())
    assert found['branch'] == 'CROSSED'
    assert main(['--motor-counts', str(found['motor_counts']), *height,
                 '--json', str(back)]) == 0
    assert json.loads(back.read_text()) == found


def test_another_head(tmp_path: Path) -> None:
    head = yaml.safe_load(nominal_head_path().read_text())
    head['bright_field']['panels']['E']['shift'] = [0.002, 0, 0]
    (tmp_path / 'head.yaml').write_text(yaml.safe_dump(head))
    report = tmp_path / 'cr.json'
    assert main(['--cr', '0.06', '--head', str(tmp_path / 'head.yaml'),
                 '--json', str(report)]) == 0
    x, y = json.loads(report.read_text())['center_offset_m']
    assert x == pytest.approx(0.001, abs=1e-4)      # half of the shift of one of two panels
    assert y == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize('suffix', ['png', 'svg'])
def test_plot(tmp_path: Path, suffix: str) -> None:
    picture = tmp_path / f'cr.{suffix}'
    assert main(['--motor-counts', '20000', '--plot', str(picture)]) == 0
    content = picture.read_bytes()
    assert (b'\x89PNG' if suffix == 'png' else b'<svg') in content[:1000]


@pytest.mark.parametrize(('arguments', 'words'), [
    (['--cr', '0.3', '--branch', 'uncrossed'], 'CR_UNREACHABLE: .*0.00 to 220.00 mm'),
    (['--cr', '-1'], 'CR_BAD_REQUEST: convergence_radius'),
    (['--cr', '0.06', '--light-height', 'nan'], 'CR_BAD_REQUEST: light_height'),
    (['--motor-counts', '63000'], 'CR_NO_INTERSECTION: .*E, N, W, S'),
    (['--motor-counts', '-1'], 'CR_OUT_OF_LIMITS: .*0 to 64000'),
    (['--cr', '0.06', '--head', 'nothing.yaml'], 'HEAD_BAD_REQUEST: nothing.yaml: No such file'),
    (['--cr', '0.06', '--json', 'no/folder/x.json'], 'x.json: No such file'),
    (['--cr', '0.06', '--plot', 'cr.foo'], "cr.foo: Format 'foo' is not supported"),
])
def test_failure_is_one_line(arguments: list[str], words: str, capsys: pytest.CaptureFixture,
                             tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 1
    printed = capsys.readouterr()
    assert printed.out == ''
    assert printed.err.count('\n') == 1
    assert re.search(words, printed.err), printed.err


def test_wrong_usage_exits_2_and_help_has_an_example() -> None:
    command = [sys.executable, '-m', 'ps_head_driver.cli.ps_cr']
    wrong = subprocess.run([*command, '--cr', '1', '--motor-counts', '2'], capture_output=True,
                           text=True, timeout=60, check=False)
    assert wrong.returncode == 2
    assert 'Traceback' not in wrong.stderr
    helped = subprocess.run([*command, '--help'], capture_output=True, text=True, timeout=60,
                            check=True)
    assert 'example: ps_cr --cr 0.06' in helped.stdout
