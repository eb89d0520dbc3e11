"""The dark-field panels: found where they are, refused apart from the bright field."""
from collections.abc import Callable
from dataclasses import replace
import json
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
import pytest

from ps_calibration.calibrate import Calibration, calibrate, head_calibration
from ps_calibration.cli.ps_calibrate import dark_field_as_json
from ps_calibration.dark_field import PARAMETERS, calibrate_dark_field, fit_panel
from ps_calibration.dark_field_report import dark_field_section
from ps_calibration.plate_light import free_light, light_of
from ps_calibration.report import Evidence
from ps_calibration.ring_pictures import light_only, locate, stated_tilt
from ps_calibration.ring_target import RingTarget
from ps_calibration.synthetic import DF_TILT, Bench, dark_errors, render_stack, solid_of
from ps_calibration.uncertainty import dark_figures
from ps_head_driver.calibration_file import apply, read_calibration, write_calibration
from ps_head_driver.head_model import DIRECTIONS, HeadModel
from ps_head_driver.kinematics import BrightFieldKinematics
from ps_head_driver.stack import Stack
from ps_head_driver.stack_folder import read_stack, write_stack

SCALE, TILT = 0.3, 0.5236
E, N, W, S = 6, 7, 8, 9                 # dark-field frames of synthetic.render_stack


@pytest.fixture(scope='module')
def dark_stack(bench: Bench, nominal: HeadModel, target: RingTarget) -> Stack:
    counts = BrightFieldKinematics(nominal).motor_counts(TILT)
    return render_stack(bench, nominal, solid_of(target), counts, SCALE, dark_field=True)


@pytest.fixture(scope='module')
def result(dark_stack: Stack, target: RingTarget, nominal: HeadModel) -> Calibration:
    return calibrate([dark_stack], target, nominal)


def of_dark_field(stack: Stack, result: Calibration, target: RingTarget,
                  nominal: HeadModel) -> Calibration:
    """The calibration with other pictures of the dark field."""
    capture = light_only(stack)
    dots_px, _ = locate([capture], target, result.camera)
    return replace(result, dark=calibrate_dark_field(
        [stack], [capture], result.fit, dots_px, nominal, target, result.camera))


def test_panels_are_found_where_they_are(
        result: Calibration, bench: Bench, nominal: HeadModel) -> None:
    assert (result.dark.verdict, result.dark.reason) == ('OK', '')
    before = dark_errors(nominal, bench)
    after = dark_errors(result.dark.corrected(nominal), bench)
    assert before.direction_deg.max() > 1.0
    assert after.direction_deg.max() < 0.15
    assert before.strength.max() > 0.03
    assert abs(after.strength - after.strength.mean()).max() < 0.004
    assert abs(after.strength.mean()) < 0.01         # against the bright field
    figures = dark_figures(result.dark, result.fit.pose, nominal, result.camera)
    for error, figure, panel in zip(after.direction_deg, figures, result.dark.panels, strict=True):
        assert error < 5 * np.degrees(figure.direction_deviation) + 0.02
        assert panel.source == 'shadows'
        assert panel.seen.all()


def test_where_no_shadow_is_seen_the_fall_off_over_the_plate_tells(
        result: Calibration, bench: Bench, target: RingTarget, nominal: HeadModel) -> None:
    dark, fit, pose = result.dark, result.fit, result.fit.pose
    free = [free_light(pose.panel_to_target(panel), dark.light.points)
            for panel in dark.poses(nominal)]
    lit = np.stack([light_of(pose.panel_to_target(panel), dark.light.points, target)
                    for panel in dark.poses(nominal)]) > 0.999 * np.stack(free)
    unshaded = replace(dark.light, values=np.where(lit, dark.light.values, np.nan))
    panels = tuple(fit_panel(i, unshaded, dark.tilt, 0.0, fit, nominal, target, result.camera)
                   for i in range(4))
    assert {panel.source for panel in panels} == {'plate'}
    errors = dark_errors(replace(dark, panels=panels).corrected(nominal), bench)
    assert errors.direction_deg.max() < 0.6 < dark_errors(nominal, bench).direction_deg.min()
    for alone, whole in zip(panels, dark.panels, strict=True):
        assert np.all(alone.deviation > whole.deviation)


def test_file_json_and_report_carry_the_dark_field(
        dark_stack: Stack, result: Calibration, target: RingTarget, nominal: HeadModel,
        bench: Bench, tmp_path: Path) -> None:
    write_calibration(head_calibration(result, nominal, target), tmp_path / 'calibration.yaml')
    made = read_calibration(tmp_path / 'calibration.yaml')
    assert made.dark_field.verdict == 'OK'
    assert {panel.source for panel in made.dark_field.panels.values()} == {'shadows'}
    assert all(0 < deviation < 0.05 for panel in made.dark_field.panels.values()
               for deviation in panel.deviation)
    np.testing.assert_allclose(dark_errors(apply(nominal, made), bench).direction_deg, dark_errors(
        result.dark.corrected(nominal), bench).direction_deg, atol=1e-6)
    evidence = Evidence(result, [dark_stack], ['x'], target, nominal, made.created, made)
    found = json.loads(json.dumps(dark_field_as_json(evidence, [tmp_path]), allow_nan=False))
    assert [light['panel'] for light in found['lights']] == list(DIRECTIONS)
    assert set(found['lights'][0]['parameters']) == set(PARAMETERS)
    section = dark_field_section(result, [dark_stack], nominal, target)
    assert section['tilt'] == '74.5'
    assert len(section['pictures']) == len(section['shadows']) == len(section['lights']) == 4


def test_pictures_survive_a_stack_folder(dark_stack: Stack, tmp_path: Path) -> None:
    write_stack(dark_stack, tmp_path / 'pictures')
    again = read_stack(tmp_path / 'pictures')[0]
    assert [light.mode for light in again.lights] == [light.mode for light in dark_stack.lights]
    assert stated_tilt(again.lights[E]) == DF_TILT


def test_without_pictures_the_dark_field_stays_nominal(
        dark_stack: Stack, result: Calibration, target: RingTarget, nominal: HeadModel) -> None:
    result = of_dark_field(dark_stack.subset([0, 1, 2, 3, 4, 5]), result, target, nominal)
    assert (result.verdict, result.dark.verdict) == ('OK', 'NONE')
    assert 'no pictures' in result.dark.reason
    made = head_calibration(result, nominal, target)
    assert apply(nominal, made).dark_field == nominal.dark_field
    assert made.verdict_reason == ''


def _exchanged(first: int, second: int) -> Callable[[list[NDArray]], None]:
    def change(images: list[NDArray]) -> None:
        images[first], images[second] = images[second], images[first]
    return change


def _dead(images: list[NDArray]) -> None:
    images[N] = images[5]


def _saturated(images: list[NDArray]) -> None:
    images[W] = np.clip(6.0 * images[W], 0, 255).astype(np.uint8)


def _moved(images: list[NDArray]) -> None:
    move = np.array([[1.0, 0.0, 1.5], [0.0, 1.0, 0.0]])
    images[S] = cv2.warpAffine(images[S], move, images[S].shape[::-1],
                               borderMode=cv2.BORDER_REPLICATE)


@pytest.mark.parametrize(('change', 'failed', 'words'), [
    (_dead, 'N', 'dark-field panel N: it gives no light'),
    (_exchanged(E, W), 'EW', 'shows the light of panel W'),
    (_saturated, 'W', 'dark-field panel W: its picture is saturated'),
    (_moved, 'S', 'dark-field panel S: the target moved'),
    (lambda images: images.__setitem__(slice(6, 10), [images[5]] * 4), 'ENWS', 'no light'),
], ids=['dead', 'swapped', 'saturated', 'moved', 'all dark'])
def test_a_bad_panel_stays_nominal_and_the_rest_is_calibrated(
        change: Callable[[list[NDArray]], None], failed: str, words: str, dark_stack: Stack,
        result: Calibration, bench: Bench, target: RingTarget, nominal: HeadModel) -> None:
    images = list(dark_stack.images)
    change(images)
    result = of_dark_field(replace(dark_stack, images=images), result, target, nominal)
    assert result.verdict == 'OK'
    dark = result.dark
    assert dark.verdict == ('FAILED' if len(failed) == 4 else 'POOR')
    assert words in dark.reason
    assert words in head_calibration(result, nominal, target).verdict_reason
    errors = dark_errors(dark.corrected(nominal), bench).direction_deg
    made = head_calibration(result, nominal, target)
    for name, panel, error in zip(DIRECTIONS, dark.panels, errors, strict=True):
        assert panel.calibrated == (name not in failed)
        assert (f'DF_{name}' in made.panels) == panel.calibrated
        assert panel.calibrated == (error < 0.2)
