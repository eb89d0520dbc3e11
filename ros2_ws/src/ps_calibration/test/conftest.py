"""A rendered calibration, made once."""
import math

import pytest

from ps_calibration.ring_target import RingTarget, default_target_path, load_target
from ps_calibration.synthetic import Bench, random_bench, render_stack, solid_of
from ps_head_driver.head_model import HeadModel, load_head, nominal_head_path
from ps_head_driver.kinematics import BrightFieldKinematics
from ps_head_driver.stack import Stack

TILT = math.radians(30)
SCALE = 0.4


@pytest.fixture(scope='session')
def nominal() -> HeadModel:
    return load_head(nominal_head_path())


@pytest.fixture(scope='session')
def target() -> RingTarget:
    return load_target(default_target_path())


@pytest.fixture(scope='session')
def bench(nominal: HeadModel) -> Bench:
    return random_bench(nominal, 3)


@pytest.fixture(scope='session')
def stack(bench: Bench, nominal: HeadModel, target: RingTarget) -> Stack:
    counts = BrightFieldKinematics(nominal).motor_counts(TILT)
    return render_stack(bench, nominal, solid_of(target), counts, SCALE)
