"""The report: complete, self-contained, and honest about what it shows."""
from dataclasses import replace
from datetime import UTC, datetime
import math
from pathlib import Path
import re

import numpy as np
import pytest

from ps_calibration.before_after import compare
from ps_calibration.calibrate import Calibration, calibrate, head_calibration
from ps_calibration.repeatability import scatter
from ps_calibration.report import Evidence, report, write_report
from ps_calibration.ring_fit import corrected
from ps_calibration.ring_height import wall_height
from ps_calibration.ring_pictures import light_only
from ps_calibration.ring_target import RingTarget
from ps_calibration.shadow_maps import edge_profile, shadow_maps
from ps_calibration.synthetic import Bench, errors_of
from ps_calibration.uncertainty import light_figures
from ps_head_driver.fake.renderer import OFF, Sensor, make_renderer
from ps_head_driver.head_model import HeadModel
from ps_head_driver.kinematics import BrightFieldKinematics, lights_at
from ps_head_driver.stack import Stack


@pytest.fixture(scope='module')
def result(stack: Stack, target: RingTarget, nominal: HeadModel) -> Calibration:
    found = calibrate([stack], target, nominal)
    assert found.verdict == 'OK', found.reason
    return found


def test_shadows_and_edges_are_drawn_where_they_are(
        result: Calibration, stack: Stack, target: RingTarget, nominal: HeadModel) -> None:
    pictures = light_only(stack)[:4]
    maps = shadow_maps(pictures, result.fit, 0, nominal, target, result.camera)
    # noise aside, what is drawn as measured is what is drawn as fitted, shadows included
    assert np.nanmedian(abs(maps.measured - maps.fitted)) < 0.02
    for panel in range(4):
        assert np.nanmin(maps.fitted[panel]) < 0.01 < 0.99 < np.nanmax(maps.fitted[panel])
        profile = edge_profile(panel, pictures, result.fit, 0, nominal, target, result.camera)
        known = np.isfinite(profile.fitted)
        # full shadow behind the wall, full light farther on, and a soft edge between
        assert profile.fitted[known & (profile.distance > 0)][0] < 0.05
        assert profile.fitted[-1] == pytest.approx(1, abs=0.01)
        assert np.sum((profile.fitted[known] > 0.1) & (profile.fitted[known] < 0.9)) > 8


def test_wall_height_shows_a_chipped_wall(
        result: Calibration, target: RingTarget, nominal: HeadModel) -> None:
    fit, camera = result.fit, result.camera
    whole = wall_height(fit, nominal, target, camera, result.shares)
    assert abs(whole.height - target.height).max() < 5e-5
    # residuals as if the wall were 0.2 mm lower everywhere
    lower = replace(fit, height=target.height + 2e-4)
    found = wall_height(lower, nominal, target, camera, result.shares)
    assert np.median(found.height - whole.height) == pytest.approx(2e-4, rel=0.2)


def test_deviations_are_of_the_size_of_the_errors(
        result: Calibration, bench: Bench, nominal: HeadModel, stack: Stack) -> None:
    known = light_figures(result.fit, nominal, result.camera)
    np.testing.assert_allclose(np.linalg.norm(known.direction, axis=1), 1)
    assert known.intensity.mean() == pytest.approx(1)
    deviation = np.degrees(known.direction_deviation)
    assert (deviation > 1e-4).all()
    assert (deviation < 0.05).all()
    assert 0 < known.level_deviation < math.radians(0.05)
    found = corrected(nominal, result.fit.panels)
    tilt = float(BrightFieldKinematics(nominal).tilt(stack.lights[0].motor_counts))
    errors = errors_of(found, result.fit.pose.plane, bench, tilt)
    assert errors.direction_deg.max() < 10 * deviation.max()


def test_scatter_of_equal_results_is_nothing(
        result: Calibration, nominal: HeadModel) -> None:
    assert scatter([result], nominal) is None
    same = scatter([result, result, result], nominal)
    assert same.count == 3
    assert same.direction.max() == pytest.approx(0, abs=1e-12)


def test_report_of_a_good_calibration_shows_everything(
        result: Calibration, stack: Stack, bench: Bench, target: RingTarget, nominal: HeadModel,
        tmp_path: Path) -> None:
    calibration = head_calibration(result, nominal, target, 'PS-7')
    counts = stack.lights[0].motor_counts
    tilt = float(BrightFieldKinematics(nominal).tilt(counts))
    renderer = make_renderer('boss', bench.head, Sensor(), 0.25)
    images = [renderer.render(tilt, 1.2, list(row), OFF, frame=i)
              for i, row in enumerate(np.eye(4))]
    boss = Stack(images=images, lights=lights_at(nominal, counts, 1.2)[:4],
                 camera=renderer.camera)
    part = compare('boss', boss, renderer.truth(), nominal, calibration)
    # the quantitative result: calibrated lights set the height scale and make plates level
    before, after = part.before['ls'], part.after['ls']
    assert after.lean_deg < 0.1 < before.lean_deg
    assert after.bias_deg < 0.5 * before.bias_deg
    assert abs(after.height_scale - 1) < 0.005

    path = tmp_path / 'made' / 'report.html'
    write_report(report(Evidence(result, [stack], ['m30'], target, nominal, calibration.created,
                                 calibration, parts=[part], serial='PS-7')), path)
    page = path.read_text()
    assert not re.search(r'(?:src|href)="(?!data:)', page), 'not self-contained'
    assert page.count('<figure') == 4 + 4 + 4 + 2 + 4
    for words in ('OK', calibration.calibration_id, 'condition of the fit', 'z_scale',
                  'height scale, error', 'Separated shadows', 'm30'):
        assert words in page
    assert list(path.parent.iterdir()) == [path]


def test_report_of_a_failure_says_why_and_shows_the_pictures(
        stack: Stack, target: RingTarget, nominal: HeadModel, result: Calibration) -> None:
    failed = Calibration('FAILED', 'panel N gives no light; check its cable', result.camera)
    page = report(Evidence(failed, [stack], ['a'], target, nominal, datetime.now(UTC)))
    assert 'Panel N gives no light; check its cable.' in page
    assert page.count('<figure') == 4
