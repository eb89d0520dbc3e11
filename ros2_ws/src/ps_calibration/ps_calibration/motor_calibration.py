"""Calibration of the motor: from tilts measured at several counts to a crank-slider that meets CR.

The slider's counts are corrected by an offset and a scale, and the crank by its phase; the four
panels' common tilt cannot tell more (a longer rod or crank looks the same over the range used, and
is taken up by these). Free play makes the slider stand ``backlash`` counts higher after a motion
down than after one up. What remains is the repeatability.
"""
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from ps_calibration.calibrate import Calibration
from ps_head_driver.calibration_file import MotorCorrection
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.head_model import Approach, HeadModel
from ps_head_driver.kinematics import BrightFieldKinematics
from ps_head_driver.stack import Panel, Stack

# what is plausible: offset (counts), scale, phase of the crank (rad), backlash (counts). The first
# three look much alike over a short range; wide, they would run away beyond it
_PRIOR = np.array([500.0, 0.005, 0.015, 2000.0])
_POSITIONS = 3                  # different ones, at least
_TILT_NOISE = 1e-4              # rad, of a tilt from a ring calibration: at least


@dataclass(frozen=True)
class TiltReading:
    """One measured position.

    :param motor_counts: of the encoder.
    :param tilt: common to the four panels, as a ring calibration finds it, rad.
    :param approach: last direction of motion.
    :param deviation: standard deviation of the tilt, rad.
    """

    motor_counts: int
    tilt: float
    approach: Approach = 'up'
    deviation: float = _TILT_NOISE


@dataclass(frozen=True)
class MotorCalibration:
    """What the motor does.

    :param offset_counts: to add to the counts at m0_counts.
    :param scale: true slider travel over nominal.
    :param crank_offset: to add to the crank's offset, rad.
    :param backlash_counts: the slider stands this much higher after a motion down; NaN if only
        one direction was measured.
    :param repeatability_counts: standard deviation of what is left.
    """

    offset_counts: float
    scale: float
    crank_offset: float
    backlash_counts: float
    repeatability_counts: float

    @property
    def correction(self) -> MotorCorrection:
        """What the calibration file keeps of it."""
        return MotorCorrection(offset_counts=self.offset_counts, scale=self.scale,
                               crank_offset=self.crank_offset)

    def counts_for(self, head: HeadModel, tilt: float, approach: str = 'up') -> int:
        """Motor counts to command for a tilt (rad) when arriving from one side.

        :param head: as it was before the correction.
        :raises PsError: HEAD_OUT_OF_LIMITS.
        """
        counts = float(_kinematics(head, self.correction).motor_position(tilt))
        play = self.backlash_counts if approach == 'down' and np.isfinite(
            self.backlash_counts) else 0.0
        return round(counts - play)


def visits(radii: Sequence[float]) -> list[tuple[float, Approach | None]]:
    """Where to take pictures, and from which side to arrive.

    :param radii: convergence radii, m.
    :returns: each once, from the side that is set; with enough of them for the motor's own
        calibration each from below, and again from above on the way back.
    """
    if len(set(radii)) < _POSITIONS:
        return [(radius, None) for radius in radii]
    return [*((radius, 'up') for radius in radii), *((radius, 'down') for radius in radii[::-1])]


def calibrate_motor(readings: Sequence[TiltReading], head: HeadModel) -> MotorCalibration:
    """Fit the motor's parameters.

    :param readings: at least three different counts; both approaches for the backlash.
    :raises PsError: CALIBRATION_BAD_REQUEST if the readings do not suffice or lie outside the
        motor's range.
    """
    code = ErrorCode.CALIBRATION_BAD_REQUEST
    counts = np.array([reading.motor_counts for reading in readings], np.float64)
    tilts = np.array([reading.tilt for reading in readings])
    noise = np.array([max(reading.deviation, _TILT_NOISE) for reading in readings])
    down = np.array([reading.approach == 'down' for reading in readings])
    if len(np.unique(counts)) < _POSITIONS:
        raise PsError(code, 'the motor needs pictures at three or more motor positions, '
                            f'{len(np.unique(counts))} given')
    if not np.isfinite(tilts).all():
        raise PsError(code, 'tilt: not all numbers are finite')
    both = down.any() and not down.all()
    # with one direction alone the correction holds for that one
    down &= both

    def moved(x: NDArray) -> BrightFieldKinematics:
        return _kinematics(head, MotorCorrection(offset_counts=x[0], scale=1 + x[1],
                                                 crank_offset=x[2]))

    def predicted(x: NDArray) -> NDArray:
        kinematics = moved(x)
        low, high = kinematics.limits_counts
        wanted = counts + x[3] * down
        # beyond the soft limits the tilt goes on as at the limit, in a straight line
        inside = np.clip(wanted, low, high)
        return np.asarray(kinematics.tilt(inside)
                          + kinematics.dtilt_dm(inside) * (wanted - inside))

    def residuals(x: NDArray) -> NDArray:
        return np.concatenate([(predicted(x) - tilts) / noise, x / _PRIOR])

    fit = least_squares(residuals, np.zeros(4), x_scale=[100.0, 1e-3, 1e-3, 100.0])
    kinematics = moved(fit.x)
    left = (predicted(fit.x) - tilts) / abs(kinematics.dtilt_dm(
        np.clip(counts, *kinematics.limits_counts)))
    freedom = max(len(counts) - 3 - both, 1)
    return MotorCalibration(float(fit.x[0]), 1 + float(fit.x[1]), float(fit.x[2]),
                            float(fit.x[3]) if both else float('nan'),
                            float(np.sqrt(np.sum(left**2) / freedom)))


def motor_of(result: Calibration, stacks: Sequence[Stack], head: HeadModel,
             approaches: Sequence[Approach | None] = ()) -> MotorCalibration | None:
    """The motor's own calibration from a ring calibration at several positions.

    :param stacks: that the result is from.
    :param head: as designed.
    :param approaches: last direction of motion of each; up if not known.
    :returns: None with fewer than three positions, without counts or after a failure.
    """
    if result.fit is None or result.verdict == 'FAILED':
        return None
    counts = [next(light.motor_counts for light in stack.lights if light.panel == Panel.E)
              for stack in stacks]
    if len(set(counts)) < _POSITIONS:
        return None
    sides = approaches or [None] * len(counts)
    return calibrate_motor([
        TiltReading(at, tilt, side or 'up', deviation) for at, tilt, side, deviation in zip(
            counts, result.fit.tilts, sides, result.fit.tilt_deviation, strict=True)], head)


def _kinematics(head: HeadModel, correction: MotorCorrection) -> BrightFieldKinematics:
    return BrightFieldKinematics(head.model_copy(
        update={'bright_field': correction.corrected(head.bright_field)}))
