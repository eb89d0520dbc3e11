"""The whole calibration on rendered pictures, and what it refuses."""
from collections.abc import Callable
from dataclasses import replace
import json
import math
import sys

import numpy as np
from numpy.typing import NDArray
import pytest

from ps_calibration.calibrate import calibrate
from ps_calibration.cli import ps_calibrate
from ps_calibration.ring_pictures import common_camera, light_only, nominal_tilt
from ps_calibration.ring_target import RingTarget
from ps_calibration.synthetic import Bench, errors_of, render_stack, solid_of, with_images
from ps_head_driver.calibration_file import apply, read_calibration
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.head_model import HeadModel
from ps_head_driver.kinematics import BrightFieldKinematics
from ps_head_driver.stack import Plane, Stack
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
    assert errors.direction_deg.max() < 0.1 < before.direction_deg.max()
    assert errors.level_deg < 0.03 < before.level_deg
    assert np.abs(errors.intensity).max() < 0.01
    lights = result['folders'][0]['lights']
    assert [light['panel'] for light in lights] == ['E', 'N', 'W', 'S']
    assert np.mean([light['intensity'] for light in lights]) == pytest.approx(1)
    assert result['z_scale'] == pytest.approx(1, abs=0.03)


def _dead(images: list[NDArray]) -> list[NDArray]:
    return [images[0], images[5], *images[2:]]


def _swapped(images: list[NDArray]) -> list[NDArray]:
    return [images[1], images[0], *images[2:]]


def _saturated(images: list[NDArray]) -> list[NDArray]:
    return [np.clip(images[0].astype(int) * 3, 0, 255).astype(np.uint8), *images[1:]]


def _dark(images: list[NDArray]) -> list[NDArray]:
    return [image // 20 for image in images]


def _moved(images: list[NDArray]) -> list[NDArray]:
    return [*images[:3], np.roll(images[3], 2, axis=1), *images[4:]]


def _something_else(images: list[NDArray]) -> list[NDArray]:
    return [*(np.full_like(image, 100) for image in images[:4]),
            np.full_like(images[4], 100), np.zeros_like(images[5])]


@pytest.mark.parametrize(('spoil', 'reason'), [
    (_dead, 'panel N gives no light'),
    (_swapped, 'picture of panel E shows the light of panel N'),
    (_saturated, 'frame E is saturated'),
    (_dark, 'too dark'),
    (_moved, 'px in frame S'),
    (_something_else, 'not found'),
])
def test_spoilt_pictures_never_pass(
        stack: Stack, target: RingTarget, nominal: HeadModel,
        spoil: Callable[[list[NDArray]], list[NDArray]], reason: str) -> None:
    result = calibrate([with_images(stack, spoil(stack.images))], target, nominal)
    assert result.verdict == 'FAILED'
    assert reason in result.reason


def test_a_blocked_slit_is_named(
        stack: Stack, bench: Bench, target: RingTarget, nominal: HeadModel) -> None:
    slits = target.slits.azimuths
    pictures = render_stack(bench, nominal, solid_of(target, slits=slits[:2] + slits[3:]),
                            stack.lights[0].motor_counts, SCALE)
    result = calibrate([pictures], target, nominal)
    assert result.verdict == 'FAILED'
    assert 'slit at 90 degrees' in result.reason


def test_twelve_bit_pictures_without_camera_and_counts_are_understood(
        stack: Stack, nominal: HeadModel) -> None:
    bare = Stack(images=[image.astype(np.uint16) * 16 for image in stack.images],
                 lights=[replace(light, motor_counts=0) for light in stack.lights])
    captures = light_only(bare)
    assert max(image.max() for image in captures) > 1000
    assert common_camera([bare], nominal).width_px == stack.shape[1]
    assert nominal_tilt(bare, BrightFieldKinematics(nominal)) == pytest.approx(TILT, abs=1e-3)


def test_missing_frames_are_named(
        stack: Stack, target: RingTarget, nominal: HeadModel) -> None:
    with pytest.raises(PsError, match='frame ALL is missing') as refused:
        calibrate([stack.subset([0, 1, 2, 3, 5])], target, nominal)
    assert refused.value.code is ErrorCode.CALIBRATION_BAD_REQUEST
