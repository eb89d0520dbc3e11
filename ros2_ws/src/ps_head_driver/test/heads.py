"""Heads for tests: the nominal one and random ones around it."""
import numpy as np

from ps_head_driver.errors import PsError
from ps_head_driver.head_model import DIRECTIONS, HeadModel, load_head, nominal_head_path
from ps_head_driver.kinematics import BrightFieldKinematics

NOMINAL = load_head(nominal_head_path())


def random_head(rng: np.random.Generator, tolerance: float = 1.0) -> HeadModel:
    """A head of other dimensions that can be assembled, its panels a little off."""
    while True:
        head = _any_head(rng, tolerance)
        try:
            BrightFieldKinematics(head)
        except PsError:
            continue
        return head


def _any_head(rng: np.random.Generator, tolerance: float) -> HeadModel:
    data = NOMINAL.model_dump()
    field = data['bright_field']
    for section, keys in ((field['hinge'], 'rz'), (field['arm'], ('along',))):
        for key in keys:
            section[key] *= rng.uniform(0.95, 1.05)
    field['arm']['out'] = rng.uniform(-0.005, 0.005)
    field['rod_length'] *= rng.uniform(0.97, 1.05)
    field['crank']['radius'] *= rng.uniform(0.9, 1.0)
    field['slider']['z_at_m0'] += field['hinge']['z'] - 0.15 + rng.uniform(-1e-3, 1e-3)
    field['slider']['r'] = field['hinge']['r'] + rng.uniform(-1e-3, 1e-3)
    for name in DIRECTIONS:
        field['panels'][name].update(
            tilt_offset=tolerance * rng.uniform(-0.03, 0.03),
            twist=tolerance * rng.uniform(-0.03, 0.03),
            shift=tuple(tolerance * rng.uniform(-2e-3, 2e-3, 3)))
    return HeadModel.model_validate(data)
