"""The whole calibration on rendered pictures, and what it refuses."""
from dataclasses import replace
import json
import math
from pathlib import Path
import sys

import numpy as np
import pytest

from ps_calibration.calibrate import calibrate
from ps_calibration.cli import ps_calibrate
from ps_calibration.ring_fit import corrected
from ps_calibration.ring_pictures import common_camera, light_only, nominal_tilt, unrounded
from ps_calibration.ring_target import RingTarget
from ps_calibration.synthetic import Bench, errors_of, render_stack, solid_of
from ps_calibration.synthetic_dirt import glints, shiny_wall, specks
from ps_calibration.synthetic_faults import FAULTS, Fault, Rendered
from ps_head_driver.calibration_file import apply, read_calibration
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.fake.renderer import Sensor
from ps_head_driver.head_model import DIRECTIONS, HeadModel
from ps_head_driver.kinematics import BrightFieldKinematics
from ps_head_driver.stack import Plane, Stack, angular_error_deg
from ps_head_driver.stack_folder import write_stack

SCALE, TILT = 0.4, math.radians(30)     # of the stack of conftest.py


def test_command_calibrates_a_random_head(
        stack: Stack, bench: Bench, nominal: HeadModel, tmp_path, monkeypatch) -> None:
    write_stack(stack, tmp_path / 'pictures')
    monkeypatch.setattr(sys, 'argv', [
        'ps_calibrate', str(tmp_path / 'pictures'), '--json', str(tmp_path / 'result.json'),
        '--out', str(tmp_path / 'calibration.yaml')])
    ps_calibrate.main()
    result = json.loads((tmp_path / 'result.json').read_text())
    assert result['verdict'] == 'OK', result['reason']
    calibration = read_calibration(tmp_path / 'calibration.yaml')
    found = apply(nominal, calibration)
    tilt = float(BrightFieldKinematics(nominal).tilt(stack.lights[0].motor_counts))
    plane = Plane(calibration.plane_normal, calibration.plane_offset)
    errors = errors_of(found, plane, bench, tilt)
    before = errors_of(nominal, Plane(), bench, tilt)
    assert errors.direction_deg.max() < 0.05 < before.direction_deg.max()
    assert errors.level_deg < 0.03 < before.level_deg
    assert np.abs(errors.intensity).max() < 0.005 < np.abs(before.intensity).max()
    lights = result['folders'][0]['lights']
    assert [light['panel'] for light in lights] == ['E', 'N', 'W', 'S']
    assert np.mean([light['intensity'] for light in lights]) == pytest.approx(1)
    assert result['z_scale'] == pytest.approx(1, abs=0.01)


def test_pictures_without_noise_give_the_axes_although_their_pixels_are_averaged(
        bench: Bench, nominal: HeadModel, target: RingTarget) -> None:
    """The axes are what a wrong idea of the pictures' blur spoils: 0.1 degrees, all alike."""
    counts = BrightFieldKinematics(nominal).motor_counts(TILT)
    pictures = render_stack(bench, nominal, solid_of(target), counts, SCALE,
                            sensor=Sensor(bit_depth=16, noise=False, vignetting=0.1))
    result = calibrate([pictures], target, nominal)
    assert result.verdict == 'OK'
    assert result.fit is not None
    # the renderer looks along one ray a pixel: 2 x 2 of them have 3/4 of the variance of a block,
    # and more of its effect where an edge is sharper than a block
    assert result.fit.softness == pytest.approx(0.82, abs=0.08)
    truth = BrightFieldKinematics(bench.head)
    for found, name in zip(result.panels(nominal)[0], DIRECTIONS, strict=True):
        true = truth.panel_pose(name, truth.tilt(counts))  # type: ignore[arg-type]
        assert angular_error_deg(found.axis, true.axis) < 0.06
        assert np.linalg.norm(found.center - true.center) < 7e-5
    assert result.z_scale == pytest.approx(1, abs=3 * result.z_scale_deviation)


def test_a_dirty_scratched_and_shiny_target_will_do(
        stack: Stack, bench: Bench, nominal: HeadModel, target: RingTarget) -> None:
    """More of it: tests/bench/bench_calibration_dirt.py."""
    pictures = shiny_wall(glints(specks(stack, 50), 4), bench, target, 0.05)
    result = calibrate([pictures], target, nominal)
    assert result.verdict == 'OK', result.reason
    assert result.fit is not None
    errors = errors_of(corrected(nominal, result.fit.panels), result.fit.pose.plane, bench,
                       result.fit.tilts[0])
    assert errors.direction_deg.max() < 0.15
    assert np.abs(errors.intensity).max() < 0.006
    assert result.z_scale == pytest.approx(1, abs=0.005)


def test_a_wall_that_is_a_little_lower_than_its_file_says_is_told(
        stack: Stack, target: RingTarget, nominal: HeadModel) -> None:
    wrong = target.model_copy(update={'height': 1.012 * target.height})
    result = calibrate([stack], wrong, nominal)
    assert result.verdict == 'POOR'
    assert 'lower than the target file says' in result.reason, result.reason
    assert 1e3 * target.height == pytest.approx(
        float(result.reason.split('(fitted ')[1].split(' mm')[0]), abs=0.02)


# those that cost no fit; tests/bench/bench_calibration_verdicts.py has the rest
QUICK = ('target turned over', 'ring with other dots', 'a machined disc instead', 'panel N dead',
         'panels E and N swapped', 'pictures mirrored', 'frame E saturated', 'all frames dark',
         'a lamp switched on in frame S', 'camera with gamma', 'camera not quite linear',
         'frame W moved by 0.5 px')


@pytest.mark.parametrize('fault', [fault for fault in FAULTS if fault.name in QUICK],
                         ids=lambda fault: fault.name)
def test_wrong_pictures_never_pass(fault: Fault, stack: Stack, bench: Bench, target: RingTarget,
                                   nominal: HeadModel) -> None:
    rendered = Rendered(bench, nominal, target, stack, SCALE)
    result = calibrate([fault.make(rendered)], target, nominal)
    assert result.verdict == 'FAILED'
    assert any(word in result.reason for word in fault.words), result.reason


def test_quick_faults_are_there() -> None:
    assert set(QUICK) <= {fault.name for fault in FAULTS}


def test_a_blocked_slit_is_named(
        stack: Stack, bench: Bench, target: RingTarget, nominal: HeadModel) -> None:
    (fault,) = (fault for fault in FAULTS if fault.name == 'middle slit blocked')
    result = calibrate([fault.make(Rendered(bench, nominal, target, stack, SCALE))], target,
                       nominal)
    assert result.verdict == 'FAILED'
    assert 'slit at 90 degrees' in result.reason


def test_a_truncated_picture_fails_and_is_named(
        stack: Stack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / 'pictures'
    write_stack(stack, folder)
    picture = folder / '002.png'
    picture.write_bytes(picture.read_bytes()[:2000])
    monkeypatch.setattr(sys, 'argv', [
        'ps_calibrate', str(folder), '--json', str(tmp_path / 'result.json'),
        '--report', str(tmp_path / 'report.html'), '--out', str(tmp_path / 'calibration.yaml')])
    with pytest.raises(SystemExit) as stopped:
        ps_calibrate.main()
    assert '002.png' in str(stopped.value)
    result = json.loads((tmp_path / 'result.json').read_text())
    assert (result['verdict'], result['folders']) == ('FAILED', [])
    assert '002.png' in result['reason']
    assert '002.png' in (tmp_path / 'report.html').read_text()
    assert not (tmp_path / 'calibration.yaml').exists()


def test_twelve_bit_pictures_without_camera_and_counts_are_understood(
        stack: Stack, nominal: HeadModel) -> None:
    bare = Stack(images=[image.astype(np.uint16) * 16 for image in stack.images],
                 lights=[replace(light, motor_counts=0) for light in stack.lights])
    captures = light_only(bare)
    assert max(image.max() for image in captures) > 1000
    assert common_camera([bare], nominal).width_px == stack.shape[1]
    assert nominal_tilt(bare, BrightFieldKinematics(nominal)) == pytest.approx(TILT, abs=1e-3)


@pytest.mark.parametrize('noise', [0.25, 0.32, 0.5])
def test_rounding_does_not_move_the_mean_of_a_dark_picture(noise: float) -> None:
    random = np.random.default_rng(1)
    for level in (3.0, 3.15, 3.26, 3.5, 3.7):
        grey = np.rint(level + random.normal(0, noise, (512, 640)))
        grey[100:120, 200:220] = 0                          # a printed dot
        plain = np.ones(grey.shape, bool)
        plain[64:128, 192:256] = False
        assert unrounded(grey.astype(np.uint8))[plain].mean() == pytest.approx(level, abs=0.01)


def test_missing_frames_are_named(
        stack: Stack, target: RingTarget, nominal: HeadModel) -> None:
    with pytest.raises(PsError, match='frame ALL is missing') as refused:
        calibrate([stack.subset([0, 1, 2, 3, 5])], target, nominal)
    assert refused.value.code is ErrorCode.CALIBRATION_BAD_REQUEST
