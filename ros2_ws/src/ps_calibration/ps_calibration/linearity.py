"""Whether grey values are proportional to light, from the pictures of a calibration alone.

The picture with all panels must be the sum of the single ones, in the shadows, too. A camera with
gamma gives the power g of the light instead. For g near 1, with p_i the share of picture i in the
common one,

    sum_i w_i p_i = 1 + (g - 1) sum_i p_i ln p_i,

whatever the weights w_i, which stand for exposures and for panels that give less when all are on.
Where light comes from few panels the last term is another than where it comes from all, so one
regression over the picture tells g.
"""
from collections.abc import Sequence
import math

import numpy as np
from numpy.typing import NDArray

_BLOCK_PX = 8
_SMOOTH = 0.05           # deviation in a block, of a well-lit plate: no edge of a dot or the wall
_LIT = 0.1               # of a well-lit plate: darker blocks tell little
_SHADED, _SHADOWS = 0.05, 0.003   # share of a panel in its shadow; part of the blocks there
_ROUNDS = 6


def response_exponent(singles: Sequence[NDArray], together: NDArray) -> tuple[float, float]:
    """Exponent of the camera's response, 1 for a linear one, and its standard deviation.

    :param singles: E, N, W, S, (H, W) float, room light subtracted.
    :param together: the same with all panels, at any exposure.
    :returns: NaN and infinity if the pictures do not tell.
    """
    means, deviations = _blocks(np.stack([*singles, together]))
    level = np.quantile(means[:4], 0.9)
    use = ((deviations[:4] < _SMOOTH * level).all(axis=0)
           & (means[4] > _LIT * np.quantile(means[4], 0.9)) & (means[:4] > 0).any(axis=0))
    if use.sum() < 100 or level <= 0:
        return math.nan, math.inf
    parts, whole = means[:4, use].clip(1e-6 * level), means[4, use]
    if np.mean(parts.min(axis=0) < _SHADED * parts.sum(axis=0)) < _SHADOWS:
        return math.nan, math.inf      # without shadows, fall-off looks like a bent response
    exponent = deviation = 1.0
    for _ in range(_ROUNDS):
        shares = parts ** (1 / exponent) / whole ** (1 / exponent)
        shares /= shares.sum(axis=0).mean()
        bend = -np.sum(shares * np.log(shares), axis=0)
        columns = np.concatenate([shares, bend[None]]).T
        keep = np.ones(len(columns), bool)
        for _ in range(3):       # without dirt
            found = np.linalg.lstsq(columns[keep], np.ones(keep.sum()), rcond=None)[0]
            off = abs(columns @ found - 1)
            spread = 1.4826 * float(np.median(off))
            keep = off <= 4 * max(spread, 1e-9)
        deviation = spread * exponent * math.sqrt(
            np.linalg.inv(columns[keep].T @ columns[keep])[4, 4])
        exponent = float(np.clip(exponent * (1 + np.clip(found[4], -0.4, 0.4)), 0.1, 10))
    return exponent, deviation


def _blocks(pictures: NDArray) -> tuple[NDArray, NDArray]:
    """Means and standard deviations of blocks, (K, R, C) each."""
    rows, columns = (n // _BLOCK_PX for n in pictures.shape[1:])
    blocks = pictures[:, :rows * _BLOCK_PX, :columns * _BLOCK_PX].reshape(
        -1, rows, _BLOCK_PX, columns, _BLOCK_PX)
    return blocks.mean(axis=(2, 4), dtype=np.float64), blocks.std(axis=(2, 4))
