"""Frames and sign conventions: the only place where a sign is flipped.

ps_head_plane: x right, y up, z towards the camera.
Optical frame (REP 103): x right, y down, z into the scene.
Height z(x, y) is along ps_head_plane +z; slopes are p = dz/dx, q = dz/dy in ps_head_plane axes.
"""
import numpy as np
from numpy.typing import NDArray

LINK_FRAME = 'ps_head_link'
CAMERA_FRAME = 'ps_head_camera_link'
OPTICAL_FRAME = 'ps_head_camera_optical_frame'
PLANE_FRAME = 'ps_head_plane'


def plane_to_optical(vectors: NDArray) -> NDArray:
    """Turn directions from ps_head_plane axes into optical axes.

    :param vectors: (..., 3), any float dtype.
    :returns: (..., 3), same dtype. The rotation is its own inverse (half a turn about x).
    """
    turned = np.array(vectors)
    for axis in (1, 2):      # a product with a vector of three would be ten times slower
        np.negative(turned[..., axis], out=turned[..., axis])
    return turned


optical_to_plane = plane_to_optical


def slope_to_normal(slope: NDArray) -> NDArray:
    """Unit normals in ps_head_plane axes (n_z > 0) from slopes.

    :param slope: (..., 2), p = dz/dx and q = dz/dy.
    :returns: (..., 3), n = (-p, -q, 1) / sqrt(1 + p^2 + q^2).
    """
    normal = np.concatenate([-slope, np.ones_like(slope[..., :1])], axis=-1)
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def normal_to_slope(normal: NDArray) -> NDArray:
    """Slopes from normals in ps_head_plane axes.

    :param normal: (..., 3), any length, n_z > 0.
    :returns: (..., 2); NaN where n_z <= 0 (the surface is seen edge-on or from behind).
    """
    n_z = normal[..., 2:3]
    return -normal[..., :2] / np.where(n_z > 0, n_z, np.nan)
