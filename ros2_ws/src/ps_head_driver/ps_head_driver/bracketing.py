"""Exposure bracketing: several frames of one light become one with a wider range.

Merged, not kept as equations of their own: every pixel then has one value a light, whatever solves
for the normals later, and a highlight that burns out in one exposure is simply left out there.
"""
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

# share of full scale from which on a value is not trusted to be linear
_SATURATED = 0.98
FULL_SCALE = 65535


def merge(images: Sequence[NDArray], exposures: Sequence[float]) -> NDArray:
    """Linear sum of what every exposure saw without saturation, per unit exposure.

    That is the best estimate where shot noise rules. Full scale of the result is full scale of the
    shortest exposure, so it stands for a frame of that exposure with more bits.

    :param images: (H, W) or (H, W, 3), uint8 or uint16, all alike, linear.
    :param exposures: of each image, relative or in s.
    :returns: uint16 of the same shape; FULL_SCALE where even the shortest exposure is saturated.
    """
    limit = np.iinfo(images[0].dtype).max
    total = np.zeros(images[0].shape, np.float32)
    time = np.zeros(images[0].shape, np.float32)
    for image, exposure in zip(images, exposures, strict=True):
        usable = image < _SATURATED * limit
        total += np.where(usable, image, 0)
        time += usable * np.float32(exposure)
    scale = np.float32(FULL_SCALE / limit * min(exposures))
    with np.errstate(invalid='ignore'):
        merged = np.rint(total / time * scale)
    return np.where(time > 0, merged, FULL_SCALE).astype(np.uint16)
