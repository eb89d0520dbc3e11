"""Flat fields: pictures of a matt board under each light, at reduced resolution."""
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.stack import Light, exposure

# positions within these count as the same illumination
TOLERANCE_COUNTS = 40
TOLERANCE_TILT = 2e-3     # rad


@dataclass(frozen=True)
class FlatField:
    """The lights it was taken with and one gain map per unit intensity for each."""

    flat_id: str
    lights: Sequence[Light]
    gain_maps: Sequence[NDArray]

    def for_lights(self, lights: Sequence[Light]) -> list[NDArray]:
        """Gain maps in the order of the lights, for the intensities that they have now.

        :returns: an empty list if one light is not covered.
        """
        maps = []
        for light in lights:
            found = [gain * np.float32(np.mean(light.intensity))
                     for own, gain in zip(self.lights, self.gain_maps, strict=True)
                     if (own.mode, own.panel) == (light.mode, light.panel)
                     and abs(own.motor_counts - light.motor_counts) <= TOLERANCE_COUNTS
                     and abs(own.tilt - light.tilt) <= TOLERANCE_TILT]
            if not found:
                return []
            maps.append(found[0])
        return maps


def make_flat_field(flat_id: str, lights: Sequence[Light], rounds: Sequence[Sequence[NDArray]],
                    ambient: NDArray | None, height: int) -> FlatField:
    """Flat field from several pictures of each light.

    :param rounds: of each round the pictures in the order of the lights.
    :param ambient: all panels off, or None.
    :param height: rows of the maps, px.
    :raises PsError: SEQUENCER_BAD_REQUEST if a light is not one panel.
    """
    if not all(light.is_equation for light in lights):
        raise PsError(ErrorCode.SEQUENCER_BAD_REQUEST,
                      'a flat field needs a recipe of single panels')
    gains = [gain_map([images[i] for images in rounds], ambient, height)
             / np.float32(exposure(light) * np.mean(light.intensity))
             for i, light in enumerate(lights)]
    peak = max(float(gain.max()) for gain in gains)
    return FlatField(flat_id, lights, [gain / np.float32(peak) for gain in gains])


def gain_map(images: Sequence[NDArray], ambient: NDArray | None, height: int) -> NDArray:
    """Mean of several flat-field pictures at reduced resolution.

    :param images: (H, W) or (H, W, 3), of one light.
    :param ambient: all panels off, or None.
    :param height: rows of the result; the width follows.
    :returns: (height, width) float32, in the unit of the pictures, at least 1/1000 of its maximum.
    """
    mean: Any = np.mean(images, axis=0, dtype=np.float32)
    if ambient is not None:
        mean = mean - ambient.astype(np.float32)
    if mean.ndim == 3:
        mean = mean.mean(axis=2)
    height = min(height, mean.shape[0])
    width = max(1, round(mean.shape[1] * height / mean.shape[0]))
    small = cv2.resize(mean, (width, height), interpolation=cv2.INTER_AREA)
    return np.maximum(small, small.max() * 1e-3).astype(np.float32)
