"""Scenes of known form, lit by brute force: a sum over the emitters of each panel, so that nothing
is shared with the light model under test.
"""
from collections.abc import Callable
import math
import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
import pytest

from ps_head_driver.head_model import CameraGeometry
from ps_head_driver.stack import Light, Panel, Stack

Form = Callable[[NDArray, NDArray], NDArray]


@pytest.fixture(scope='session')
def data() -> Path:
    """The folder of real data; skips where it is missing."""
    root = Path(__file__).resolve().parents[4]
    folder = Path(os.environ.get('PS_DATA', root.parent / 'shared' / 'data'))
    if not folder.is_dir():
        pytest.skip(f'{folder}: no data (set PS_DATA)')
    return folder


@pytest.fixture(scope='session')
def camera() -> CameraGeometry:
    return CameraGeometry(width_px=160, height_px=128, fx=960, fy=960, cx=79.5, cy=63.5,
                          camera_standoff=0.3)


@pytest.fixture(scope='session')
def ring() -> list[Light]:
    """The nominal head's bright-field panels at 40 degrees of tilt."""
    lights, tilt = [], math.radians(40)
    radius, z = 0.04 + 0.07 * math.cos(tilt), 0.15 - 0.07 * math.sin(tilt)
    for panel, azimuth in zip(Panel, (0, 90, 180, 270), strict=False):
        c, s = math.cos(math.radians(azimuth)), math.sin(math.radians(azimuth))
        lights.append(Light(
            panel=panel, position=(radius * c, radius * s, z), right=(-s, c, 0.0),
            axis=(-math.sin(tilt) * c, -math.sin(tilt) * s, -math.cos(tilt)), size=(0.06, 0.03)))
    return lights


def emitter_sum(light: Light, points: NDArray, normals: NDArray, across: int = 10) -> NDArray:
    """Irradiance on surface elements: one small cos emitter after the other."""
    position, right, axis = (np.array(v) for v in (light.position, light.right, light.axis))
    up = np.cross(axis, right)
    steps = (np.arange(across) + 0.5) / across - 0.5
    total = np.zeros(points.shape[:-1])
    for a in steps:
        for b in steps:
            ray = position + a * light.size[0] * right + b * light.size[1] * up - points
            distance = np.linalg.norm(ray, axis=-1)
            ray = ray / distance[..., None]
            total += (np.clip(np.sum(ray * normals, axis=-1), 0, None)
                      * np.clip(-ray @ axis, 0, None) / distance ** 2)
    return total * light.size[0] * light.size[1] / across ** 2 * float(np.mean(light.intensity))


@pytest.fixture(scope='session')
def render(camera: CameraGeometry, ring: list[Light]) -> Callable:
    def make(form: Form, camera: CameraGeometry = camera, lights: list[Light] = ring,
             albedo: float | NDArray = 1.0) -> tuple[Stack, NDArray, NDArray]:
        """Stack (float32, brightest pixel 0.8), true normals and heights of z = form(x, y)."""
        from ps_head_driver.camera_model import pixel_rays
        pixels = np.stack(np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px)),
                          axis=-1)
        rays = pixel_rays(camera, pixels)[..., :2]
        z = np.zeros(rays.shape[:2])
        for _ in range(40):     # fixed point: the ray meets the surface
            depth = camera.camera_standoff - z
            z = form(rays[..., 0] * depth, rays[..., 1] * depth)
        x, y = (rays[..., a] * (camera.camera_standoff - z) for a in (0, 1))
        e = 1e-7
        normal = np.stack([-(form(x + e, y) - form(x - e, y)) / (2 * e),
                           -(form(x, y + e) - form(x, y - e)) / (2 * e), np.ones_like(x)], axis=-1)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        points = np.stack([x, y, z], axis=-1)
        frames = [albedo * emitter_sum(light, points, normal) for light in lights]
        gain = 0.8 / max(frame.max() for frame in frames)
        return (Stack([(gain * f).astype(np.float32) for f in frames], lights, camera),
                normal, z)
    return make
