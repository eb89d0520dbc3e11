"""Scatter of the result over calibrations from pictures that should tell the same."""
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ps_calibration.calibrate import Calibration, calibrate
from ps_calibration.ring_fit import corrected
from ps_calibration.ring_target import RingTarget
from ps_calibration.uncertainty import light_directions
from ps_head_driver.head_model import HeadModel
from ps_head_driver.stack import Stack


@dataclass(frozen=True)
class Repeatability:
    """Standard deviations over repeated calibrations.

    :param count: of calibrations that did not fail.
    :param direction: (4,) of the light of E, N, W, S at the middle of the plane, rad.
    :param intensity: (4,) relative.
    :param level: of the plane's normal, rad.
    :param z_scale: of the height scale.
    """

    count: int
    direction: NDArray
    intensity: NDArray
    level: float
    z_scale: float


def repeats(stacks: Sequence[Stack],
            approaches: Sequence[str | None] = ()) -> list[list[Stack]]:
    """Groups of two and more stacks taken at the same motor counts.

    :param approaches: from which side the motor arrived at each; the same for all if not given.
    """
    groups: dict[tuple[int, str | None], list[Stack]] = {}
    for stack, side in zip(stacks, approaches or [None] * len(stacks), strict=True):
        groups.setdefault((stack.lights[0].motor_counts, side), []).append(stack)
    return [group for group in groups.values() if len(group) > 1]


def repeatability(stacks: Sequence[Stack], target: RingTarget,
                  head: HeadModel) -> Repeatability | None:
    """Calibrate from each stack alone; None if fewer than two succeed."""
    return scatter([calibrate([stack], target, head) for stack in stacks], head)


def scatter(results: Sequence[Calibration], head: HeadModel) -> Repeatability | None:
    """Standard deviations of results that should be the same; None with fewer than two."""
    good = [result for result in results if result.fit is not None and result.verdict != 'FAILED']
    if len(good) < 2:
        return None
    directions, intensities, normals = [], [], []
    for result in good:
        assert result.fit is not None
        fit = result.fit
        directions.append(light_directions(corrected(head, fit.panels), fit.pose, result.camera,
                                           fit.tilts[0]))
        gains = np.array([panel.intensity for panel in result.panels(head)[0]])
        intensities.append(gains / gains.mean())
        normals.append(fit.pose.plane.normal)
    return Repeatability(
        len(good), _spread(np.array(directions)), np.std(intensities, axis=0, ddof=1),
        float(_spread(np.array(normals))),
        float(np.std([result.z_scale for result in good], ddof=1)))


def _spread(vectors: NDArray) -> NDArray:
    """Standard deviation of unit vectors (n, ..., 3) from their mean, rad."""
    off = vectors - vectors.mean(axis=0)
    return np.asarray(np.sqrt(np.sum(off**2, axis=(0, -1)) / (len(vectors) - 1)))
