"""Names in requests reach the files of their folder and no others."""
from pathlib import Path

import pytest

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.paths import confined, leads_out


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    inside = tmp_path / 'files'
    (inside / 'deep').mkdir(parents=True)
    (tmp_path / 'secret').write_text('x')
    (tmp_path / 'files_of_others').mkdir()
    (inside / 'out').symlink_to(tmp_path / 'secret')
    (inside / 'up').symlink_to('..')
    (inside / 'loop').symlink_to('loop')
    (inside / 'dangling').symlink_to('/nowhere/at/all')
    (inside / 'fine').symlink_to('deep')
    return inside


@pytest.mark.parametrize('name', [
    'a.yaml', 'deep/a.yaml', 'deep/../a.yaml', './a.yaml', '~a.yaml', 'fine/a.yaml', '..a'])
def test_names_inside_are_taken(folder, name):
    assert confined(folder, name, 'file', ErrorCode.CALIBRATION_BAD_REQUEST) == folder / name


def test_absolute_name_inside_is_taken(folder):
    name = str(folder / 'deep' / 'a.yaml')
    assert str(confined(folder, name, 'file', ErrorCode.CALIBRATION_BAD_REQUEST)) == name


@pytest.mark.parametrize('name', [
    '', '..', '../secret', 'deep/../../secret', '/etc/passwd', '../files_of_others/x', 'out',
    'up/x', 'up/secret', 'dangling', 'a\0b', 'fine/../../secret'])
def test_names_that_lead_out_are_refused(folder, name):
    with pytest.raises(PsError, match='target_file: ') as error:
        confined(folder, name, 'target_file', ErrorCode.CALIBRATION_BAD_REQUEST)
    assert error.value.code == ErrorCode.CALIBRATION_BAD_REQUEST


def test_folder_may_itself_be_a_link(folder, tmp_path):
    (tmp_path / 'alias').symlink_to(folder)
    assert not leads_out(tmp_path / 'alias', 'a.yaml')
    assert leads_out(tmp_path / 'alias', 'out')


def test_loop_of_links_is_no_crash(folder):
    assert not leads_out(folder, 'loop')      # it leads nowhere: opening it fails
