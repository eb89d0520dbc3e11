"""Soft shadows of the model against brute force and against the light model."""
from dataclasses import replace
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ps_calibration.ring_target import RingTarget
from ps_calibration.shadow_model import light_and_rates, plate_irradiance
from ps_head_driver.head_model import HeadModel
from ps_head_driver.kinematics import BrightFieldKinematics, PanelPose
from ps_head_driver.light_model import light_vectors
from ps_head_driver.stack import Light


@pytest.fixture
def panel(nominal: HeadModel) -> PanelPose:
    return BrightFieldKinematics(nominal).panel_pose('N', math.radians(30))


def test_without_a_wall_it_is_the_light_model(panel: PanelPose, target: RingTarget) -> None:
    points = np.random.default_rng(1).uniform(-0.02, 0.02, (50, 2))
    expected = light_vectors(
        Light(position=tuple(panel.center), axis=tuple(panel.axis), right=tuple(panel.right),
              size=panel.size), np.concatenate([points, np.zeros((50, 1))], axis=1))[:, 2]
    assert plate_irradiance(points, panel, 0.0, target.footprint) == pytest.approx(
        expected, rel=1e-5)


def test_shadow_equals_brute_force(panel: PanelPose, target: RingTarget) -> None:
    """Every emitter's line is followed through the wall in small steps."""
    random = np.random.default_rng(2)
    points = random.uniform(-0.015, 0.015, (200, 2))
    points = points[target.distance(*points.T) > 0.0005]
    u, v = np.meshgrid((np.arange(30) + 0.5) / 30 - 0.5, (np.arange(18) + 0.5) / 18 - 0.5)
    up = np.cross(panel.axis, panel.right)
    emitters = (panel.center + u.reshape(-1, 1) * panel.size[0] * panel.right
                + v.reshape(-1, 1) * panel.size[1] * up)
    (inner, outer), (half_slit, _) = target.footprint[:2]
    slits = target.footprint[4:]
    expected = []
    for point in points:
        ray = emitters - [*point, 0]
        steps = np.linspace(0, 1, 120)[:, None, None] * target.height / ray[:, 2:]
        x, y = np.moveaxis(point + steps * ray[:, :2], -1, 0)
        wall = (np.hypot(x, y) > inner) & (np.hypot(x, y) < outer) & (y > 0)
        for slit in slits:
            wall &= (abs(slit[0] * y - slit[1] * x) > half_slit) | (x * slit[0] + y * slit[1] < 0)
        distance = np.linalg.norm(ray, axis=1)
        light = -(ray @ panel.axis) * ray[:, 2] / distance**4
        expected.append(np.sum(light * ~wall.any(axis=0)) * np.prod(panel.size) / len(emitters))
    found = plate_irradiance(points, panel, target.height, target.footprint)
    error = (found - expected) / np.max(expected)
    shaded = plate_irradiance(points, panel, 0.0, target.footprint) > 1.05 * found
    assert shaded.sum() > 15
    assert np.abs(error).max() < 0.03
    assert abs(error[shaded].mean()) < 0.003


@pytest.mark.parametrize('lobe', [1.0, 2.5])
def test_derivatives_are_those_of_the_light(
        panel: PanelPose, target: RingTarget, lobe: float) -> None:
    points = np.random.default_rng(3).uniform(-0.016, 0.016, (400, 2))
    points = points[target.distance(*points.T) > 0.0006]
    # no direction may be special
    tilted = Rotation.from_rotvec([0.01, 0.02, 0.03])
    panel = replace(panel, lobe_exponent=lobe, axis=tilted.apply(panel.axis),
                    right=tilted.apply(panel.right))

    def light(moved: PanelPose, shift: np.ndarray | float = 0.0, rise: float = 0.0) -> np.ndarray:
        return plate_irradiance(points + shift, moved, target.height + rise, target.footprint)

    found, rates = light_and_rates(points, panel, target.height, target.footprint)
    assert found == pytest.approx(light(panel), rel=1e-12)
    for k in range(9):
        step = (1e-4 if 3 <= k < 6 else 1e-5 if k < 3 else 1e-7) * np.eye(3)[k % 3]
        ends = []
        for way in (step, -step):
            turn = Rotation.from_rotvec(way)
            ends.append(
                light(replace(panel, center=panel.center + way)) if k < 3
                else light(replace(panel, axis=turn.apply(panel.axis),
                                   right=turn.apply(panel.right))) if k < 6
                else light(panel, shift=way[:2]) if k < 8 else light(panel, rise=way[2]))
        expected = (ends[0] - ends[1]) / (2 * step.sum())
        # a few points where the quadrature changes its parts may be off
        error = np.abs(rates[:, k] - expected) / np.abs(expected).max()
        assert np.quantile(error, 0.97) < 2e-3
        assert error.max() < 0.1
