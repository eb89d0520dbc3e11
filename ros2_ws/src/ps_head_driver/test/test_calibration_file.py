"""Calibration files: round trip, atomic writing, and refusal of anything that is not one."""
from datetime import UTC, datetime
import os

import pytest
import yaml

from ps_head_driver.calibration_file import (
    HeadCalibration,
    MotorCorrection,
    PanelCorrection,
    apply,
    content_hash,
    new_calibration_id,
    read_calibration,
    write_calibration,
)
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.head_model import load_head, nominal_head_path
from ps_head_driver.kinematics import BrightFieldKinematics
from ps_head_driver.stack import Light, Mode, Panel


@pytest.fixture
def calibration():
    created = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)
    head = load_head(nominal_head_path())
    return HeadCalibration(
        calibration_id=new_calibration_id('PS-7', created), created=created, head_serial='PS-7',
        camera=head.camera, plane_normal=(0.01, 0.0, (1 - 1e-4) ** 0.5), plane_offset=2e-4,
        panels={'BF_E': PanelCorrection(shift=(1e-3, 0, -2e-3), tilt_offset=0.01, intensity=1.02),
                'DF_S': PanelCorrection(twist=-0.02)},
        backlash_counts=80, motor=MotorCorrection(offset_counts=150.0, scale=1.002),
        z_scale=1.001, verdict='OK', target_name='half-ring-24')


def test_round_trip(tmp_path, calibration):
    path = tmp_path / 'new' / 'cal.yaml'
    write_calibration(calibration, path)
    assert read_calibration(path) == calibration
    assert os.listdir(path.parent) == ['cal.yaml']


def test_corrections_reach_the_head(calibration):
    head = load_head(nominal_head_path())
    fixed = apply(head, calibration)
    east = fixed.bright_field.panels['E']
    assert east.shift == (1e-3, 0, -2e-3)
    assert east.tilt_offset == 0.01
    assert east.intensity == 1.02
    assert fixed.dark_field.panels['S'].twist == -0.02
    assert fixed.bright_field.panels['N'] == head.bright_field.panels['N']
    assert apply(head, None) is head
    # counts mean what the corrected slider makes of them
    found, nominal = (BrightFieldKinematics(each) for each in (fixed, head))
    assert found.tilt(20000) == pytest.approx(nominal.tilt(20000 * 1.002 + 150 * 1.002))
    # and after a motion down, what its play makes of them
    above = BrightFieldKinematics(apply(head, calibration, 'down'))
    assert above.tilt(20000) == pytest.approx(found.tilt(20000 + 80))


def test_a_stack_is_calibrated_if_all_its_panels_are(calibration):
    east, south = Light(Panel.E), Light(Panel.S, Mode.DARK_FIELD)
    assert calibration.covers([east, south, Light(Panel.ALL), Light(Panel.NONE)])
    assert not calibration.covers([east, Light(Panel.S)])
    assert not calibration.covers([Light(Panel.E, Mode.DARK_FIELD), south])


def refused(path, code):
    with pytest.raises(PsError, match=path.name) as error:
        read_calibration(path)
    assert error.value.code == code
    return error.value.message


def test_edited_file_is_refused(tmp_path, calibration):
    path = tmp_path / 'cal.yaml'
    write_calibration(calibration, path)
    path.write_text(path.read_text().replace('intensity: 1.02', 'intensity: 1.03'))
    assert 'hash' in refused(path, ErrorCode.CALIBRATION_FILE_INVALID)


@pytest.mark.parametrize('keep', [0.1, 0.5, 0.9, 0.99])
def test_truncated_file_is_refused(tmp_path, calibration, keep):
    path = tmp_path / 'cal.yaml'
    write_calibration(calibration, path)
    text = path.read_text()
    path.write_text(text[:int(len(text) * keep)])
    refused(path, ErrorCode.CALIBRATION_FILE_INVALID)


def test_other_version_is_refused(tmp_path, calibration):
    path = tmp_path / 'cal.yaml'
    write_calibration(calibration, path)
    content = yaml.safe_load(path.read_text())
    path.write_text(yaml.safe_dump({**content, 'version': 99}))
    assert 'version 99' in refused(path, ErrorCode.CALIBRATION_FILE_VERSION)


def test_a_file_of_version_1_has_a_motor_as_designed(tmp_path, calibration):
    path = tmp_path / 'cal.yaml'
    write_calibration(calibration, path)
    content = yaml.safe_load(path.read_text())
    content = {key: value for key, value in content.items() if key not in ('motor', 'hash')}
    content['version'] = 1
    path.write_text(yaml.safe_dump({**content, 'hash': content_hash(content)}))
    assert read_calibration(path) == calibration.model_copy(update={'motor': MotorCorrection()})


@pytest.mark.parametrize('content', ['', 'hello: world', '[1, 2]', '!!python/object:os.system x'])
def test_foreign_file_is_refused(tmp_path, content):
    path = tmp_path / 'cal.yaml'
    path.write_text(content)
    refused(path, ErrorCode.CALIBRATION_FILE_INVALID)


def test_missing_file_is_refused(tmp_path):
    refused(tmp_path / 'cal.yaml', ErrorCode.CALIBRATION_FILE_NOT_FOUND)


def test_failed_write_keeps_the_old_file(tmp_path, calibration, monkeypatch):
    path = tmp_path / 'cal.yaml'
    write_calibration(calibration, path)
    before = path.read_bytes()

    def full(*_):
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr(os, 'fsync', full)
    with pytest.raises(PsError, match='No space left') as error:
        write_calibration(calibration.model_copy(update={'z_scale': 1.5}), path)
    assert error.value.code == ErrorCode.CALIBRATION_WRITE_FAILED
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ['cal.yaml']
