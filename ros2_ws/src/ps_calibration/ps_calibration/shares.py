"""What the pictures of one motor position say about the light: each one's share in their sum.

The reflectance of the plate, vignetting and texture cancel out; the panel-blurred shadows and the
fall-off over the plate remain.
"""
from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

import numpy as np
from numpy.typing import NDArray

from ps_calibration.ring_target import RingTarget
from ps_calibration.target_pose import TargetPose
from ps_head_driver.camera_model import plane_points
from ps_head_driver.head_model import CameraGeometry

# what is expected of the models of soft shadows near the wall and of the smooth rest
_MODEL_NEAR, _MODEL_FAR = 5e-4, 5e-5
_CLEAR = 0.0006          # m; the camera looks past the wall's edge, and a block has a width
_BLOCK = 1.6e-4          # m on the plate, edge of the blocks of pixels
_REACH = 0.006           # m; no shadow is longer
_FAR = 6                 # beyond, so many x so many blocks are averaged


@dataclass(frozen=True)
class Shares:
    """What one motor position's pictures say about the light.

    :param tilt: nominal, rad.
    :param pixels: (N, 2) float64, column and row of the middles of the blocks.
    :param values: (4, N) float64, share of E, N, W, S in their sum.
    :param noise: (N,) float64, standard deviation expected of them.
    :param near: how many of them, the first ones, are near the wall.
    :param block_px: edge of the blocks near the wall.
    """

    tilt: float
    pixels: NDArray
    values: NDArray
    noise: NDArray
    near: int = 0
    block_px: int = 1

    def thinned(self, part: int) -> 'Shares':
        """One block in ``part``."""
        return Shares(self.tilt, self.pixels[::part], self.values[:, ::part], self.noise[::part],
                      math.ceil(self.near / part), self.block_px)

    def reweighed(self, residuals: NDArray) -> 'Shares':
        """The same with more noise expected, near the wall or elsewhere, where more was found.

        :param residuals: (4, M) of a fit to these shares, thinned.
        """
        thin = self.thinned(round(self.values.shape[1] / residuals.shape[1]))
        found = abs(residuals / thin.noise)
        noise = self.noise.copy()
        for mine, its in ((slice(self.near), slice(thin.near)),
                          (slice(self.near, None), slice(thin.near, None))):
            if found[:, its].size:
                noise[mine] *= max(1.4826 * float(np.median(found[:, its])), 1.0)
        return replace(self, noise=noise)


@dataclass(frozen=True)
class PlateBlocks:
    """Pictures averaged over square blocks of pixels.

    :param means: (K, R, C) float64, of the K pictures.
    :param pixels: (2, R, C), column and row of the blocks' middles.
    :param distance: (R, C) from the wall, m; NaN where something else than the plate is seen.
    :param side: of the blocks, px.
    """

    means: NDArray
    pixels: NDArray
    distance: NDArray
    side: int


def plate_blocks(pictures: Sequence[NDArray], pose: TargetPose, target: RingTarget,
                 camera: CameraGeometry, length: float = _BLOCK) -> PlateBlocks:
    """Average pictures over blocks, and find those where only the plate is seen.

    :param pictures: (H, W) float each.
    :param length: of the blocks on the plate, m; at least a pixel.
    """
    side = max(1, round(length * camera.fx / camera.camera_standoff))
    rows, columns = (n // side for n in pictures[0].shape)
    means = np.stack([
        p[:rows * side, :columns * side].reshape(rows, side, columns, side).mean(axis=(1, 3))
        for p in pictures])
    v, u = np.mgrid[:rows, :columns] * side + (side - 1) / 2
    x, y, _ = np.moveaxis(pose.to_target(
        plane_points(camera, np.stack([u, v], axis=-1), pose.plane)), -1, 0)
    half = np.array(target.base.size) / 2 - _CLEAR
    total = means.sum(axis=0)
    distance = target.distance(x, y)
    keep = (distance > _CLEAR) & (np.hypot(x, y) > _CLEAR) & (
        abs(x) < half[0]) & (abs(y) < half[1]) & (total > 0.1 * np.median(total))
    for dot in target.fiducials.centres:
        keep &= np.hypot(x - dot[0], y - dot[1]) > target.fiducials.radius + _CLEAR / 2
    return PlateBlocks(means, np.stack([u, v]), np.where(keep, distance, math.nan), side)


def measure_shares(pictures: Sequence[NDArray], tilt: float, pose: TargetPose,
                   target: RingTarget, camera: CameraGeometry) -> Shares:
    """Average the pictures of one motor position over blocks where only the plate is seen.

    :param pictures: E, N, W, S, (H, W) float, room light subtracted, equal exposure.
    :param tilt: nominal, rad.
    """
    blocks = plate_blocks(pictures, pose, target, camera)
    distance = blocks.distance
    grid = np.concatenate([blocks.means, blocks.pixels])
    parts = []
    for size, here in ((1, distance < _REACH), (_FAR, distance >= _REACH)):
        whole = _merge(here[None], size)[0] == 1
        parts.append(_merge(grid, size)[:, whole])
    merged = np.concatenate(parts, axis=1)
    values = merged[:4] / merged[:4].sum(axis=0)
    return Shares(tilt, merged[4:].T.copy(), values,
                  _noise([part[:4] / part[:4].sum(axis=0) for part in parts]), parts[0].shape[1],
                  blocks.side)


def _merge(grid: NDArray, size: int) -> NDArray:
    """Means of size x size neighbours, (K, H, W) to (K, H // size, W // size)."""
    rows, columns = (n // size for n in grid.shape[1:])
    return np.asarray(grid[:, :rows * size, :columns * size].reshape(
        -1, rows, size, columns, size).mean(axis=(2, 4), dtype=np.float64))


def _noise(parts: Sequence[NDArray]) -> NDArray:
    """Standard deviation of each share: its pixels' noise and the model's own errors, (N,).

    The noise is seen in the differences of neighbours far from the wall.
    """
    far = parts[1]
    change = np.diff(far, 2, axis=1)[:, np.abs(np.diff(far, 2, axis=1)).max(axis=0) < 0.05]
    pixel = 1.4826 * float(np.median(abs(change))) / math.sqrt(6) if change.size else 0.0
    return np.concatenate([
        np.full(parts[0].shape[1], math.hypot(pixel * _FAR, _MODEL_NEAR)),
        np.full(far.shape[1], math.hypot(pixel, _MODEL_FAR))])
