"""Calibration of the motor, against the emulator's motor with play and a wrong crank."""
import math

import numpy as np
import pytest

from ps_calibration.motor_calibration import TiltReading, calibrate_motor, visits
from ps_head_driver.convergence_radius import CrSolver
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.fake.motor import Motor
from ps_head_driver.head_model import HeadModel
from ps_head_driver.kinematics import BrightFieldKinematics

PLAY = 300.0


def _real(nominal: HeadModel) -> HeadModel:
    """Rod, crank and slider as made, not as designed."""
    field = nominal.bright_field
    return nominal.model_copy(update={'bright_field': field.model_copy(update={
        'crank': field.crank.model_copy(update={
            'offset': field.crank.offset + 0.01, 'radius': field.crank.radius * 1.002}),
        'rod_length': field.rod_length - 1e-4})})


def _go(motor: Motor, counts: int) -> float:
    motor.move(counts)
    while motor.busy:
        assert motor.tick() in ('', 'done')
    return motor.slider


@pytest.fixture
def motor() -> Motor:
    motor = Motor(backlash=PLAY)
    motor.home()
    while motor.busy:
        motor.tick()
    return motor


def test_cr_is_met_from_either_side(nominal: HeadModel, motor: Motor) -> None:
    real, random = _real(nominal), np.random.default_rng(1)
    truth = BrightFieldKinematics(real)
    readings = []
    for approach, start in (('up', -3000), ('down', 3000)):
        for counts in (8000, 14000, 20000, 25000, 30000):
            _go(motor, counts + start)
            tilt = float(truth.tilt(_go(motor, counts))) + random.normal(0, 5e-5)
            readings.append(TiltReading(counts, tilt, approach))  # type: ignore[arg-type]
    found = calibrate_motor(readings, nominal)
    assert found.backlash_counts == pytest.approx(PLAY, abs=10)
    assert found.repeatability_counts < 20

    designed = BrightFieldKinematics(nominal)

    def diameter(tilt: float) -> float:
        """CR belongs to the tilt, whatever motor brings the panels there."""
        return float(CrSolver(nominal).evaluate(np.array([designed.motor_position(tilt)]))[0][0])

    before, after = [], []
    for wanted in np.radians([12, 20, 28, 33]):
        for approach, start in (('up', -3000), ('down', 3000)):
            for errors, counts in (
                    (before, designed.motor_counts(float(wanted))),
                    (after, found.counts_for(nominal, float(wanted), approach))):
                _go(motor, counts + start)
                errors.append(abs(diameter(float(truth.tilt(_go(motor, counts))))
                                  - diameter(float(wanted))))
    assert max(after) < 2e-4 < max(before)


def test_one_sided_readings_leave_the_backlash_open(nominal: HeadModel) -> None:
    kinematics = BrightFieldKinematics(nominal)
    found = calibrate_motor([TiltReading(m, float(kinematics.tilt(m)))
                             for m in (10000, 20000, 30000)], nominal)
    assert math.isnan(found.backlash_counts)
    assert found.scale == pytest.approx(1, abs=1e-6)


def test_enough_radii_are_visited_from_both_sides() -> None:
    assert visits([0.04, 0.06, 0.06]) == [(0.04, None), (0.06, None), (0.06, None)]
    assert visits([0.04, 0.06, 0.09]) == [
        (0.04, 'up'), (0.06, 'up'), (0.09, 'up'), (0.09, 'down'), (0.06, 'down'), (0.04, 'down')]


def test_too_few_positions_are_refused(nominal: HeadModel) -> None:
    with pytest.raises(PsError, match='three or more') as refused:
        calibrate_motor([TiltReading(10000, 0.3), TiltReading(10000, 0.3)], nominal)
    assert refused.value.code is ErrorCode.CALIBRATION_BAD_REQUEST
