"""Each panel's own shadow, measured and fitted, seen squarely from above (paper, Fig. 2b)."""
from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from ps_calibration.ring_fit import RingFit, corrected, predicted_shares
from ps_calibration.ring_target import RingTarget
from ps_calibration.shares import Shares
from ps_head_driver.camera_model import project
from ps_head_driver.head_model import CameraGeometry, HeadModel

_PITCH = 1.2e-4          # m on the plate
_AROUND = 0.007          # m shown around the wall
_CLEAR = 0.0003          # m from the wall, where the camera may see its side


@dataclass(frozen=True)
class ShadowMaps:
    """Part of each panel that reaches a point of the plate: 1 is free, 0 in full shadow.

    :param x: (w,) and
    :param y: (h,) of the points in the target frame, m.
    :param measured: (4, h, w) float, NaN under the wall and off the plate.
    :param fitted: (4, h, w), the same of the fit.
    """

    x: NDArray
    y: NDArray
    measured: NDArray
    fitted: NDArray


@dataclass(frozen=True)
class EdgeProfile:
    """One panel's light along a line across its shadow.

    :param distance: (n,) from the wall's middle, along the light, m.
    :param measured: (n,) as in ShadowMaps; NaN under the wall.
    :param fitted: (n,).
    :param ends: of the line in the target frame, (2, 2), m.
    """

    distance: NDArray
    measured: NDArray
    fitted: NDArray
    ends: NDArray


def shadow_maps(pictures: Sequence[NDArray], fit: RingFit, position: int, head: HeadModel,
                target: RingTarget, camera: CameraGeometry) -> ShadowMaps:
    """Take what the four panels have in common out of their pictures.

    A picture's share in the sum of the four knows no reflectance; over the share that the fit
    gives a plate without wall, it is the part of the panel that is seen.

    :param pictures: E, N, W, S of one motor position, (H, W) float, room light subtracted.
    :param head: as designed.
    """
    azimuths = np.linspace(*target.arc, 60)
    rim = target.outer_radius * np.stack([np.cos(azimuths), np.sin(azimuths)], axis=1)
    half = np.array(target.base.size) / 2
    low = np.maximum(rim.min(axis=0) - _AROUND, -half)
    high = np.minimum(rim.max(axis=0) + _AROUND, half)
    x, y = (np.arange(low[k], high[k], _PITCH) for k in range(2))
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    measured, fitted = _visibility(grid.reshape(-1, 2), pictures, fit, position, head, target,
                                   camera)
    shape = (4, len(y), len(x))
    return ShadowMaps(x, y, measured.reshape(shape), fitted.reshape(shape))


def edge_profile(panel: int, pictures: Sequence[NDArray], fit: RingFit, position: int,
                 head: HeadModel, target: RingTarget, camera: CameraGeometry) -> EdgeProfile:
    """The light of one panel along a line across the wall, between two slits.

    :param panel: 0 to 3 for E, N, W, S.
    """
    light = panel * math.pi / 2
    marks = np.array([target.arc[0], *sorted(target.slits.azimuths), target.arc[1]])
    middles, widths = (marks[1:] + marks[:-1]) / 2, np.diff(marks)
    # a wide piece of wall that stands across the light
    azimuth = middles[np.argmax(widths * abs(np.cos(middles - light)))]
    middle = (target.inner_radius + target.outer_radius) / 2 * np.array(
        [math.cos(azimuth), math.sin(azimuth)])
    away = -np.array([math.cos(light), math.sin(light)])
    distance = np.arange(-0.003, 0.009, _PITCH / 2)
    points = middle + distance[:, None] * away
    measured, fitted = _visibility(points, pictures, fit, position, head, target, camera)
    return EdgeProfile(distance, measured[panel], fitted[panel], points[[0, -1]])


def _visibility(points: NDArray, pictures: Sequence[NDArray], fit: RingFit, position: int,
                head: HeadModel, target: RingTarget,
                camera: CameraGeometry) -> tuple[NDArray, NDArray]:
    """Measured and fitted part of the panels seen from points (N, 2) of the plate, (4, N) each."""
    measured, fitted = np.full((2, 4, len(points)), math.nan)
    clear = target.distance(*points.T) >= _CLEAR
    points = points[clear]
    pixels = project(camera, fit.pose.to_head(
        np.concatenate([points, np.zeros((len(points), 1))], axis=1)))
    seen = np.stack([map_coordinates(picture, pixels.T[::-1], order=1, cval=math.nan)
                     for picture in pictures])
    found = corrected(head, fit.panels)
    here = Shares(fit.tilts[position], pixels, seen, np.ones(len(points)))
    shaded, free = (predicted_shares(found, with_wall(target, height), camera, here, fit.pose)
                    for height in (fit.height, 0.0))
    # a panel that is not shaded has the share it would have without the wall, times this
    gain = (shaded / free).max(axis=0)
    measured[:, clear] = seen / seen.sum(axis=0) / free / gain
    fitted[:, clear] = shaded / free / gain
    return measured, fitted


def with_wall(target: RingTarget, height: float) -> RingTarget:
    """The target with another wall, unchecked: 0 for none."""
    return target.model_copy(update={'height': height})
