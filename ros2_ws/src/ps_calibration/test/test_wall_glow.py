"""Light by way of the wall, against light followed ray by ray."""
from collections.abc import Callable
import math

import numpy as np
from numpy.typing import NDArray
import pytest

from ps_calibration.ring_target import RingTarget
from ps_calibration.wall_glow import wall_glow
from ps_head_driver.kinematics import PanelPose

PANEL = PanelPose(center=np.array([0.095, 0.005, 0.1]), axis=np.array([-0.69, 0.02, -0.7236]),
                  right=np.array([0.0, 1.0, 0.0276]), size=(0.06, 0.03), lobe_exponent=1.0,
                  intensity=1.0)
STEP = 1e-4              # m, of rays


def _in_wall(target: RingTarget, p: NDArray) -> NDArray:
    radius, azimuth = np.hypot(p[:, 0], p[:, 1]), np.arctan2(p[:, 1], p[:, 0])
    inside = ((radius > target.inner_radius) & (radius < target.outer_radius) & (p[:, 1] > 0)
              & (p[:, 2] < target.height))
    for slit in target.slits.azimuths:
        inside &= ~((abs(radius * np.sin(azimuth - slit)) < target.slits.width / 2)
                    & (np.cos(azimuth - slit) > 0))
    return inside


def _followed(target: RingTarget, origin: NDArray, way: NDArray) -> tuple[NDArray, NDArray]:
    """Where rays end, (N, 3), and on what: 0 nothing, 1 the wall, 2 the plate."""
    ends, on = origin + 0 * way, np.zeros(len(way), int)
    here, free = origin + STEP * way, np.ones(len(way), bool)
    for _ in range(int(0.03 / STEP)):
        hit = free & _in_wall(target, here)
        down = free & ~hit & (here[:, 2] < 0)
        on[hit], on[down] = 1, 2
        ends[hit | down] = here[hit | down]
        free &= ~(hit | down) & (here[:, 2] < target.height)
        if not free.any():
            break
        here = here + STEP * way
    return ends, on


def _lit(target: RingTarget, points: NDArray, normals: NDArray, draw: Callable) -> NDArray:
    """Irradiance of points by one random emitter of the panel each."""
    up = np.cross(PANEL.axis, PANEL.right)
    u, v = (draw(len(points)) - 0.5) * PANEL.size[0], (draw(len(points)) - 0.5) * PANEL.size[1]
    ray = PANEL.center + u[:, None] * PANEL.right + v[:, None] * up - points
    square = np.sum(ray**2, axis=1)
    way = ray / np.sqrt(square)[:, None]
    seen = _followed(target, points + 2 * STEP * normals, way)[1] != 1
    return (np.sum(way * normals, axis=1).clip(0) * (-way @ PANEL.axis).clip(0) / square * seen
            * PANEL.size[0] * PANEL.size[1])


def _scattered(normals: NDArray, draw: Callable) -> NDArray:
    """Directions from matt surfaces."""
    count = len(normals)
    z = 2 * draw(count) - 1
    turn = 2 * math.pi * draw(count)
    flat = np.sqrt(1 - z**2)
    way = normals + np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)
    return np.asarray(way / np.linalg.norm(way, axis=1, keepdims=True))


@pytest.mark.parametrize('point', [(0.0135, 0.004), (-0.0085, 0.004), (0.006, 0.0137)],
                         ids=['lit side', 'inside', 'beside a slit'])
def test_it_is_what_rays_bring(point: tuple[float, float], target: RingTarget) -> None:
    draw, count = np.random.default_rng(5).random, 15000
    up = np.tile([0.0, 0.0, 1.0], (count, 1))
    origin = np.tile([*point, 1e-9], (count, 1))
    ends, on = _followed(target, origin, _scattered(up, draw))
    wall = ends[on == 1]
    radius = np.hypot(wall[:, 0], wall[:, 1])
    gaps = np.stack([abs(radius - target.outer_radius), abs(radius - target.inner_radius)])
    sign = np.where(gaps[0] < gaps[1], 1.0, -1.0)
    normals = np.stack([sign * wall[:, 0] / radius, sign * wall[:, 1] / radius,
                        np.zeros(len(wall))], axis=1)
    direct = _lit(target, wall, normals, draw)
    below, on_what = _followed(target, wall + 2 * STEP * normals, _scattered(normals, draw))
    plate = below[on_what == 2] * [1, 1, 0]
    by_plate = target.base.reflectance * _lit(
        target, plate, np.tile([0.0, 0.0, 1.0], (len(plate), 1)), draw).sum()
    expected = target.wall_reflectance * (direct.sum() + by_plate) / count
    found = wall_glow(np.array([point]), [PANEL], target)[0, 0]
    # what is missing here came back from the wall twice
    assert found == pytest.approx(expected, rel=0.1)


def test_a_black_wall_has_none(target: RingTarget) -> None:
    black = target.model_copy(update={'wall_reflectance': 0.0})
    assert not wall_glow(np.array([[0.0135, 0.004]]), [PANEL], black).any()
