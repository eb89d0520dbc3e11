"""Pinhole camera with plumb_bob distortion: pixels to rays and points in ps_head_plane, and back.

The undistorted pixel (u, v) looks along ((u - cx)/fx, (v - cy)/fy, 1) in the optical frame; the
camera centre is (0, 0, camera_standoff) in ps_head_plane. Pixel centres are at whole numbers.
"""
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ps_head_driver.frames import optical_to_plane, plane_to_optical
from ps_head_driver.head_model import CameraGeometry
from ps_head_driver.stack import Plane

# the distortion of an inspection lens is small: this many steps converge to 1e-12
_UNDISTORT_STEPS = 25


def scaled_camera(camera: CameraGeometry, width_px: int, height_px: int) -> CameraGeometry:
    """The same view sampled with another number of pixels."""
    sx, sy = width_px / camera.width_px, height_px / camera.height_px
    return camera.model_copy(update={
        'width_px': width_px, 'height_px': height_px, 'fx': camera.fx * sx, 'fy': camera.fy * sy,
        'cx': (camera.cx + 0.5) * sx - 0.5, 'cy': (camera.cy + 0.5) * sy - 0.5})


def camera_center(camera: CameraGeometry) -> NDArray:
    """(3,) float64, ps_head_plane, m."""
    return np.array([0.0, 0.0, camera.camera_standoff])


def distort(camera: CameraGeometry, xy: NDArray) -> NDArray:
    """Ideal to distorted normalised image coordinates, (..., 2) float64 (plumb_bob)."""
    k1, k2, p1, p2, k3 = camera.distortion
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack([x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                     y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], axis=-1)


def undistort(camera: CameraGeometry, xy: NDArray) -> NDArray:
    """Inverse of :func:`distort`, by fixed-point iteration."""
    if not any(camera.distortion):
        return xy
    ideal = xy.copy()
    for _ in range(_UNDISTORT_STEPS):
        ideal += xy - distort(camera, ideal)
    return ideal


def pixel_rays(camera: CameraGeometry, pixels: ArrayLike) -> NDArray:
    """Viewing rays of pixels.

    :param pixels: (..., 2), column u and row v.
    :returns: (..., 3) float64, ps_head_plane, scaled to z = -1.
    """
    uv = np.asarray(pixels, np.float64)
    xy = (uv - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    xy = undistort(camera, xy)
    return optical_to_plane(np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1))


def project(camera: CameraGeometry, points: ArrayLike) -> NDArray:
    """Pixels of points.

    :param points: (..., 3), ps_head_plane, m, below the camera.
    :returns: (..., 2) float64, column and row.
    """
    optical = plane_to_optical(np.asarray(points, np.float64) - camera_center(camera))
    xy = distort(camera, optical[..., :2] / optical[..., 2:])
    return xy * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def plane_points(camera: CameraGeometry, pixels: ArrayLike, plane: Plane,
                 height: ArrayLike = 0.0) -> NDArray:
    """Where the rays of pixels meet the plane, or a surface near it.

    :param pixels: (..., 2).
    :param height: of the surface above the plane along ps_head_plane z at each pixel, m;
        broadcasts.
    :returns: (..., 3) float64, ps_head_plane, m.
    """
    return ray_points(camera, pixel_rays(camera, pixels), plane, height)


def ray_points(camera: CameraGeometry, rays: NDArray, plane: Plane,
               height: ArrayLike = 0.0) -> NDArray:
    """The same as plane_points from rays (..., 3), as from pixel_rays: to find these only once."""
    center = camera_center(camera)
    normal = np.asarray(plane.normal, np.float64)
    # the surface is the plane lifted along z by the height: normal . x = offset + normal_z height
    level = plane.offset + normal[2] * np.asarray(height, np.float64)
    distance = (level - center @ normal) / (rays @ normal)
    return center + distance[..., None] * rays


def pixel_grid(shape: tuple[int, int], step_px: float) -> tuple[NDArray, NDArray]:
    """Evenly spaced nodes that reach from the first to the last pixel.

    :param shape: (height, width) of the picture.
    :param step_px: largest spacing.
    :returns: rows (gh,) and columns (gw,) of the nodes, float64, at least two of each.
    """
    def nodes(count: int) -> NDArray:
        return np.linspace(0, count - 1, max(2, int(np.ceil((count - 1) / step_px)) + 1))
    return nodes(shape[0]), nodes(shape[1])
