"""The ring's own height, from its shadows and by reconstruction (paper, Fig. 2c): a check."""
from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from ps_calibration.before_after import relit
from ps_calibration.ring_fit import RingFit, corrected, predicted_shares
from ps_calibration.ring_target import RingTarget
from ps_calibration.shadow_maps import with_wall
from ps_calibration.shares import Shares
from ps_head_driver.calibration_file import HeadCalibration
from ps_head_driver.camera_model import plane_points
from ps_head_driver.head_model import CameraGeometry, HeadModel
from ps_head_driver.stack import Stack
from ps_reconstruction.pipeline import Options, reconstruct

_RISE = 1e-4             # m, of the wall for a finite difference
_WAY = 1e-4              # m, steps towards the wall
_REACH = 0.008           # m; no shadow is longer
_FAR = 0.004             # m from the wall where the plate is only a plate


@dataclass(frozen=True)
class WallHeight:
    """Height of the wall that its shadows tell, for pieces of its arc.

    :param azimuth: (K,) middles of the pieces, rad.
    :param height: (K,) m; NaN where no shadow tells.
    :param deviation: (K,) of it, noise only, m.
    """

    azimuth: NDArray
    height: NDArray
    deviation: NDArray


def wall_height(fit: RingFit, head: HeadModel, target: RingTarget, camera: CameraGeometry,
                shares: Sequence[Shares], pieces: int = 18) -> WallHeight:
    """What is left of the shadows, expressed as a height of the wall along its arc.

    :param fit: with the height of the target file.
    :param shares: that were fitted.
    """
    found = corrected(head, fit.panels)
    edges = np.linspace(*target.arc, pieces + 1)
    products, squares = np.zeros(pieces), np.zeros(pieces)
    for position, (share, residual) in enumerate(zip(shares, fit.residuals, strict=True)):
        here = Shares(fit.tilts[position], share.pixels, share.values, share.noise)
        low, high = (predicted_shares(found, with_wall(target, fit.height + rise), camera,
                                      here, fit.pose) for rise in (0.0, _RISE))
        change = (high - low) / _RISE
        points = fit.pose.to_target(plane_points(camera, share.pixels, fit.pose.plane))[:, :2]
        # the panel whose shadow it is loses the most when the wall rises
        shaded = change.argmin(axis=0)
        for panel in range(4):
            mine = np.flatnonzero((shaded == panel) & (change[panel] < 0))
            piece = np.digitize(_casting_azimuth(points[mine], panel * math.pi / 2, target),
                                edges) - 1
            inside = (piece >= 0) & (piece < pieces)
            mine, piece = mine[inside], piece[inside]
            weighed = change[:, mine] / share.noise[mine]**2
            np.add.at(products, piece, np.sum(weighed * residual[:, mine], axis=0))
            np.add.at(squares, piece, np.sum(weighed * change[:, mine], axis=0))
    with np.errstate(invalid='ignore', divide='ignore'):
        return WallHeight((edges[1:] + edges[:-1]) / 2, fit.height + products / squares,
                          fit.scatter / np.sqrt(squares))


def _casting_azimuth(points: NDArray, light: float, target: RingTarget) -> NDArray:
    """Azimuth of the wall that stands first between points (N, 2) and a light, NaN for none."""
    azimuth = np.full(len(points), math.nan)
    for way in np.arange(0.0, _REACH, _WAY)[::-1]:
        x, y = points[:, 0] + way * math.cos(light), points[:, 1] + way * math.sin(light)
        hit = target.distance(x, y) == 0
        azimuth[hit] = np.arctan2(y[hit], x[hit])
    return azimuth


@dataclass(frozen=True)
class HeightMap:
    """Reconstructed height of the pictures of the ring, 1 at the wall's known height.

    A wall that stands upright has no slope that a picture could show: what the map says of the
    wall is a picture for people, what it says of the plate is a measurement.

    :param height: (H, W), relative to the wall's known height; 0 is the plate's middle.
    :param wall: median over the wall's upper face.
    :param flatness: RMS over the plate away from wall and dots, relative.
    """

    height: NDArray
    wall: float
    flatness: float


def height_map(stack: Stack, fit: RingFit, head: HeadModel, target: RingTarget,
               calibration: HeadCalibration | None) -> HeightMap:
    """Reconstruct the ring itself.

    :param stack: with the frames E, N, W, S.
    :param head: as designed.
    :param calibration: None reconstructs with the lights as designed.
    """
    lit = relit(stack, head, calibration)
    height = reconstruct(lit, Options(careful=True), {'height'}).height
    camera = lit.camera
    assert height is not None
    assert camera is not None
    rows, columns = np.mgrid[:lit.shape[0], :lit.shape[1]]
    pixels = np.stack([columns, rows], axis=-1)

    def target_points(level: float) -> NDArray:
        """Where the pixels look, at a height above the plate."""
        return fit.pose.to_target(plane_points(camera, pixels, fit.pose.plane, level))

    x, y, _ = np.moveaxis(target_points(0.0), -1, 0)
    plate = (target.distance(x, y) > _FAR) & (abs(x) < target.base.size[0] / 2) & (
        abs(y) < target.base.size[1] / 2)
    for dot in target.fiducials.centres:
        plate &= np.hypot(x - dot[0], y - dot[1]) > 1.5 * target.fiducials.radius
    upper = target.distance(*np.moveaxis(target_points(target.height), -1, 0)[:2]) == 0
    relative = (height - np.nanmedian(height[plate])) / target.height
    return HeightMap(relative, float(np.nanmedian(relative[upper])),
                     float(np.sqrt(np.nanmean(relative[plate]**2))))
