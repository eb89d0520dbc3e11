"""The plate of the target as a light meter: what a panel of unknown place gives it.

Once the bright field is calibrated, the plate is a known reflector: a picture under another panel
over the sum of the pictures under E, N, W, S, times the light that these are known to give, is the
light of that panel. Reflectance, texture and vignetting cancel out.
"""
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
import math

import numpy as np
from numpy.typing import NDArray

from ps_calibration.ring_target import RingTarget
from ps_calibration.shadow_model import plate_irradiance
from ps_calibration.shares import plate_blocks
from ps_calibration.target_pose import TargetPose
from ps_calibration.wall_glow import wall_glow
from ps_head_driver.camera_model import plane_points
from ps_head_driver.head_model import CameraGeometry
from ps_head_driver.kinematics import PanelPose

_BLOCK = 3.2e-4          # m on the plate, edge of the blocks of pixels
_PART, _ROW = 4, 3       # one block in so many is used, on a lattice that moves so much per row
_FAINT = 0.05            # of the median light: below it noise falls no more
_DARKNESS = 1e-9
_CHI2_MEDIAN = 0.4549    # median of a squared standard normal variable


@dataclass(frozen=True)
class PlateLight:
    """Light of four panels on the plate, at N blocks of pixels.

    Its unit is that of plate_irradiance: a panel of the bright field's mean radiance gives 1.

    :param pixels: (N, 2) middles of the blocks, column and row.
    :param points: (N, 2) the same on the plate, target frame, m.
    :param corners: (4, N, 2) points of the plate over which the light has the blocks' mean.
    :param values: (4, N) float64, of panels E, N, W, S; NaN where the picture is saturated.
    :param noise: (4, N) standard deviation that the pictures' noise gives them.
    """

    pixels: NDArray
    points: NDArray
    corners: NDArray
    values: NDArray
    noise: NDArray


def light_of(panel: PanelPose, points: NDArray, target: RingTarget) -> NDArray:
    """Light of a panel, its intensity included, at (N, 2) points of the target's plate, (N,)."""
    return panel.intensity * plate_irradiance(points, panel, target.height, target.footprint)


def mean_light(panel: PanelPose, corners: NDArray, target: RingTarget) -> NDArray:
    """What it gives the blocks of PlateLight on average, (N,)."""
    return np.asarray(np.mean([light_of(panel, corner, target) for corner in corners], axis=0))


def free_light(panel: PanelPose, points: NDArray) -> NDArray:
    """Light of a panel on a plate without the ring, (N,)."""
    return panel.intensity * plate_irradiance(points, panel, 0.0, np.zeros((4, 2)))


def measure_plate_light(pictures: Sequence[NDArray], burnt: Sequence[NDArray],
                        bright: NDArray, panels: Sequence[PanelPose], pose: TargetPose,
                        target: RingTarget, camera: CameraGeometry,
                        glow: float = 0.0) -> PlateLight:
    """Divide pictures by what is known of the plate.

    :param pictures: four, (H, W) float, room light subtracted.
    :param burnt: four, (H, W) bool, where they are saturated.
    :param bright: sum of the pictures under E, N, W, S of the bright field, equal exposure.
    :param panels: these four as calibrated, ps_head_plane, with a mean intensity of 1.
    :param glow: of the wall, see RingFit.
    """
    blocks = plate_blocks([*pictures, bright, *(b.astype(np.float32) for b in burnt)], pose,
                          target, camera, _BLOCK)
    rows, columns = np.indices(blocks.distance.shape)
    used = np.isfinite(blocks.distance) & ((columns + _ROW * rows) % _PART == 0)
    pixels = blocks.pixels[:, used].T
    corners = np.stack([
        _on_plate(pixels + blocks.side / math.sqrt(12) * np.array(sides), pose, camera)
        for sides in product((-1, 1), repeat=2)])
    points, seen = _on_plate(pixels, pose, camera), [pose.panel_to_target(p) for p in panels]
    known = (sum(mean_light(panel, corners, target) for panel in seen)
             + glow * wall_glow(points, seen, target).sum(axis=0))
    with np.errstate(divide='ignore', invalid='ignore'):
        ratios = blocks.means[:4] / blocks.means[4]
    values = ratios[:, used] * known
    noise = np.stack([_noise(ratio, used) for ratio in ratios]) * known
    values[blocks.means[5:][:, used] > 0] = math.nan
    return PlateLight(pixels, points, corners, values, noise)


def _on_plate(pixels: NDArray, pose: TargetPose, camera: CameraGeometry) -> NDArray:
    return pose.to_target(plane_points(camera, pixels, pose.plane))[:, :2]


def _noise(ratio: NDArray, used: NDArray) -> NDArray:
    """Standard deviation of a picture's blocks, as their neighbours show it, (N,).

    Shot noise: the variance is proportional to the light.
    """
    level = np.maximum(ratio, max(_FAINT * float(np.median(ratio[used])), _DARKNESS))
    change = np.diff(ratio, 2, axis=1)
    seen = used[:, 1:-1] & np.isfinite(change)
    gain = np.median(change[seen]**2 / (6 * level[:, 1:-1][seen])) / _CHI2_MEDIAN
    return np.asarray(np.sqrt(gain * level[used]))
