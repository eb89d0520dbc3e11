"""Derivatives of what the pictures should show, against finite differences."""
import numpy as np

from ps_calibration.ring_problem import PER_PANEL, RingProblem
from ps_calibration.ring_target import RingTarget
from ps_calibration.shares import Shares
from ps_calibration.target_pose import TargetPose
from ps_head_driver.camera_model import project
from ps_head_driver.head_model import HeadModel

_POSE = TargetPose(np.array([1e-3, -5e-4, 1e-3, 0.1, 0.01, -0.005]))


def _problem(nominal: HeadModel, target: RingTarget) -> RingProblem:
    """Two motor positions, each with the same places near the wall."""
    plate = np.random.default_rng(4).uniform(-0.014, 0.014, (300, 3)) * [1, 1, 0]
    plate = plate[target.distance(*plate.T[:2]) > 8e-4]
    # lens distortion has to be seen through
    camera = nominal.camera.model_copy(update={'distortion': (-0.1, 0.02, 1e-3, -1e-3, 0.0)})
    pixels = project(camera, _POSE.to_head(plate))
    shares = [Shares(tilt, pixels, np.full((4, len(plate)), 0.25), np.full(len(plate), 1e-3),
                     len(plate)) for tilt in (0.5, 0.4)]
    dots = project(camera, _POSE.to_head(target.dots))
    return RingProblem(nominal, target, camera, shares, dots)


def test_derivatives_are_those_of_the_prediction(nominal: HeadModel, target: RingTarget) -> None:
    problem = _problem(nominal, target)
    x = problem.start(np.full((4, PER_PANEL), 1e-3), _POSE, [0.5, 0.402])
    problem.learn_blur(x)
    assert any(abs(blur).max() > 1e-5 for blur in problem.blurs)
    for position in range(2):
        predicted, rates = problem.predicted_and_rates(x, position)
        assert np.allclose(predicted, problem.predicted(x)[position], rtol=0, atol=1e-12)
        for k in range(problem.size):
            step = 1e-6 * np.eye(problem.size)[k]
            expected = (problem.predicted(x + step)[position]
                        - problem.predicted(x - step)[position]) / 2e-6
            error = abs(rates[k] - expected) / max(abs(expected).max(), 1e-3)
            assert np.quantile(error, 0.97) < 2e-3, k


def test_the_equations_are_those_of_their_cost(nominal: HeadModel, target: RingTarget) -> None:
    problem = _problem(nominal, target)
    x = problem.start(np.full((4, PER_PANEL), 1e-3), _POSE, [0.5, 0.402])
    here = problem.equations(x)
    for k in range(problem.size):
        step = 1e-7 * np.eye(problem.size)[k]
        ends = [problem.equations(x + way * step).cost for way in (1, -1)]
        assert abs((ends[0] - ends[1]) / 4e-7 - here.gradient[k]) < 1e-2 * max(
            abs(here.gradient[k]), 0.01 * np.sqrt(here.cost * here.matrix[k, k])), k
