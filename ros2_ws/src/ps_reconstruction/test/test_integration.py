from functools import partial
from pathlib import Path

import numpy as np
import pytest

from ps_head_driver.frames import slope_to_normal
from ps_head_driver.head_model import CameraGeometry
from ps_reconstruction.integration import (
    Rays,
    gradients,
    height_from_normals,
    parallel_rays,
    poisson,
    remove_plane,
)
from ps_reconstruction.near_field import camera_rays
from ps_reconstruction.problem import grid_size
from ps_reconstruction.weighted_integration import integrate


def waves(shape: tuple[int, int], pitch: float) -> tuple[np.ndarray, np.ndarray]:
    """A smooth form and its normals, parallel projection."""
    y, x = np.mgrid[:shape[0], :shape[1]].astype(np.float64) * pitch
    a, b, k = 30e-6, 20e-6, 2 * np.pi / 3e-3
    z = a * np.sin(k * x) + b * np.cos(k * y)
    slope = np.stack([a * k * np.cos(k * x), b * k * np.sin(k * y)], axis=-1)   # y counts down
    return z, slope_to_normal(slope).astype(np.float32)


@pytest.mark.parametrize('solver', [None, partial(integrate, steepness=0.0, tolerance=1e-6)])
def test_height_in_metres(solver: object) -> None:
    z, normal = waves((120, 150), 40e-6)
    height = height_from_normals(normal, parallel_rays((120, 150), 40e-6), solver=solver)  # type: ignore[arg-type]
    np.testing.assert_allclose(height, z - np.median(z), atol=1e-6)
    assert abs(float(np.median(height))) < 1e-7


@pytest.mark.parametrize(('p', 'q'), [(0.2, 0.0), (0.0, 0.2), (-0.1, 0.15)])
def test_tilted_plate_has_the_right_signs(p: float, q: float, camera: CameraGeometry) -> None:
    shape = (camera.height_px, camera.width_px)
    slope = np.broadcast_to((p, q), (*shape, 2))
    normal = slope_to_normal(slope.astype(np.float64)).astype(np.float32)
    height = height_from_normals(normal, camera_rays(camera, shape, 8))
    # exact: z = p x + q y under perspective, x = x_n (D - z)
    v, u = np.mgrid[:shape[0], :shape[1]]
    x, y = (u - camera.cx) / camera.fx, -(v - camera.cy) / camera.fy
    z = camera.camera_standoff * (p * x + q * y) / (1 + p * x + q * y)
    np.testing.assert_allclose(height - height.mean(), z - z.mean(), atol=2e-5)
    assert np.ptp(z) > 5e-3


def test_reference_plane_is_subtracted(camera: CameraGeometry) -> None:
    """A part lying on a tilted plane has height zero above it."""
    shape = (camera.height_px, camera.width_px)
    normal = np.array([-0.1, 0.05, 1.0])
    normal /= np.linalg.norm(normal)
    field = np.broadcast_to(normal, (*shape, 3)).astype(np.float32)
    height = height_from_normals(
        field, camera_rays(camera, shape, 8), tuple(normal), 0.002)    # type: ignore[arg-type]
    assert np.abs(height).max() < 2e-5


def test_distorted_lens_keeps_a_plate_flat(camera: CameraGeometry) -> None:
    bent = camera.model_copy(update={'distortion': (-0.3, 0.1, 1e-3, -1e-3, 0.0)})
    shape = (camera.height_px, camera.width_px)
    normal = slope_to_normal(np.broadcast_to((0.1, 0.0), (*shape, 2)).astype(np.float64))
    rays = camera_rays(bent, shape, 4)
    height = height_from_normals(normal.astype(np.float32), rays)
    from ps_head_driver.camera_model import pixel_rays
    pixels = np.stack(np.meshgrid(np.arange(shape[1]), np.arange(shape[0])), axis=-1)
    x = pixel_rays(bent, pixels)[..., 0]
    z = camera.camera_standoff * 0.1 * x / (1 + 0.1 * x)
    np.testing.assert_allclose(height - height.mean(), z - z.mean(), atol=2e-5)


def test_invalid_pixels_stay_invalid_and_do_not_spread() -> None:
    z, normal = waves((80, 90), 40e-6)
    hole = np.zeros(z.shape, bool)
    hole[30:40, 50:60] = True
    normal[hole] = np.nan
    rays = parallel_rays(z.shape, 40e-6)
    height = height_from_normals(
        normal, rays, solver=partial(integrate, steepness=0.0, tolerance=1e-6))
    assert np.array_equal(np.isnan(height), hole)
    z = z - np.median(z[~hole])
    np.testing.assert_allclose(height[~hole], z[~hole], atol=2e-6)
    assert np.isfinite(poisson(*gradients(normal, rays))).all()


def test_step_does_not_bend_its_surroundings() -> None:
    """Normals cannot see a vertical step; the careful solver leaves both sides flat."""
    shape, pitch = (60, 80), 40e-6
    slope = np.zeros((*shape, 2))
    slope[:, 39:41, 0] = 4.0                # what little of the wall the camera saw
    normal = slope_to_normal(slope).astype(np.float32)
    rays = parallel_rays(shape, pitch)
    careful = height_from_normals(normal, rays, solver=partial(integrate, pitch=pitch))
    for side in (careful[:, :38], careful[:, 42:]):
        assert np.ptp(side) < 0.2 * pitch


def test_flat_confidence_changes_nothing() -> None:
    z, normal = waves((50, 60), 40e-6)
    du, dv = gradients(normal, parallel_rays(z.shape, 40e-6))
    one = integrate(du, dv, steepness=0)
    two = integrate(du, dv, np.full(z.shape, 255, np.uint8), steepness=0)
    np.testing.assert_array_equal(one, two)


def test_untrusted_slopes_do_no_harm() -> None:
    z, normal = waves((60, 60), 40e-6)
    du, dv = gradients(normal, parallel_rays(z.shape, 40e-6))
    confidence = np.full(z.shape, 255, np.uint8)
    du[20:25, 20:25] += 1e-4
    confidence[20:25, 20:25] = 1
    blind = integrate(du, dv, steepness=0)
    careful = integrate(du, dv, confidence, steepness=0)
    outside = confidence > 1

    def error(w: np.ndarray) -> float:
        difference = (w - z)[outside]
        return float(np.abs(difference - difference.mean()).mean())

    assert error(careful) < 0.2 * error(blind)


def test_remove_plane_ignores_a_bump() -> None:
    y, x = np.mgrid[:60, :80]
    bump = np.where((x - 20) ** 2 + (y - 30) ** 2 < 100, 1e-3, 0)
    flat = remove_plane((1e-5 * x - 2e-5 * y + bump).astype(np.float32))
    assert np.abs(flat[bump == 0]).max() < 3e-5


@pytest.mark.parametrize(('name', 'limit_mm'), [('cat', 0.6), ('cow', 0.4), ('pot2', 0.4)])
def test_diligent_depth(data: Path, name: str, limit_mm: float) -> None:
    """Depth from true normals over a mask, perspective, no scale given."""
    file = data / 'diligent_depth' / f'{name}.npz'
    if not file.is_file():
        pytest.skip(f'{file} is missing')
    truth = np.load(file)
    mask, depth, k = truth['mask'] > 0, truth['depth_mm'], truth['K']
    normal = truth['normal'].astype(np.float32)
    normal[~mask] = np.nan
    step = 32
    gh, gw = grid_size(mask.shape, step)
    u, v = np.meshgrid(np.arange(gw) * step, np.arange(gh) * step)
    nodes = np.stack([(u - k[0, 2]) / k[0, 0], -(v - k[1, 2]) / k[1, 1]], axis=-1)
    height = height_from_normals(normal, Rays(nodes, step, 1.5),
                                 solver=partial(integrate, steepness=0))
    found = (1.5 - height) * 1e3
    known = mask & np.isfinite(found) & np.isfinite(depth)
    assert known.sum() > 0.99 * mask.sum()
    found *= np.median(depth[known] / found[known])
    assert np.abs(found - depth)[known].mean() < limit_mm
