"""Listing calibration files: the good ones by age, the others with the reason."""
from datetime import UTC, datetime
import json
from pathlib import Path
import sys

import pytest

from ps_calibration.catalogue import list_calibrations
from ps_calibration.cli import ps_calibrate
from ps_head_driver.calibration_file import HeadCalibration, write_calibration
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.head_model import HeadModel


@pytest.fixture
def folder(tmp_path: Path, nominal: HeadModel) -> Path:
    for day in (3, 7, 5):
        write_calibration(HeadCalibration(
            calibration_id=f'PS-7-{day}', created=datetime(2026, 11, day, tzinfo=UTC),
            head_serial='PS-7', camera=nominal.camera, verdict='OK', target_name='half-ring-24'),
            tmp_path / f'{day}.yaml')
    edited = (tmp_path / '5.yaml').read_text().replace('PS-7-5', 'PS-7-6')
    (tmp_path / 'edited.yaml').write_text(edited)
    (tmp_path / 'cut.yaml').write_text(edited[:200])
    (tmp_path / 'notes.yaml').write_text('lamp: new\n')
    return tmp_path


def test_newest_first_and_refused_last(folder: Path) -> None:
    entries = list_calibrations(folder)
    assert [entry.path.name for entry in entries] == [
        '7.yaml', '5.yaml', '3.yaml', 'cut.yaml', 'edited.yaml', 'notes.yaml']
    assert entries[0].text == ('7.yaml  OK  PS-7-7  2026-11-07 00:00  head PS-7  '
                               'target half-ring-24')
    assert 'hash does not match' in entries[4].text
    assert entries[5].text == ('notes.yaml  refused: not a calibration file '
                               '(format: ps_head_calibration is missing)')
    with pytest.raises(PsError) as refused:
        list_calibrations(folder / 'nowhere')
    assert refused.value.code is ErrorCode.CALIBRATION_FILE_NOT_FOUND


def test_command_lists(folder: Path, monkeypatch: pytest.MonkeyPatch,
                       capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    result = tmp_path / 'list.json'
    monkeypatch.setattr(sys, 'argv', [
        'ps_calibrate', '--list', str(folder), '--json', str(result)])
    ps_calibrate.main()
    assert capsys.readouterr().out.splitlines()[0].startswith('7.yaml  OK')
    listed = json.loads(result.read_text())
    assert [bool(entry['refused']) for entry in listed] == 3 * [False] + 3 * [True]
    assert listed[0]['calibration']['calibration_id'] == 'PS-7-7'


def test_folders_or_list_not_both(monkeypatch: pytest.MonkeyPatch) -> None:
    for arguments in ([], ['pictures', '--list', 'files']):
        monkeypatch.setattr(sys, 'argv', ['ps_calibrate', *arguments])
        with pytest.raises(SystemExit) as stopped:
            ps_calibrate.main()
        assert stopped.value.code == 2
