"""The solver of the fits against scipy's."""
import numpy as np
from numpy.typing import NDArray
import pytest
from scipy.optimize import least_squares

from ps_calibration.gauss_newton import NormalEquations, minimise

_TIMES = np.linspace(0, 3, 400)
_NOISE = 0.01
_START = np.array([0.5, 3.0, 200.0, 0.0])


def _residuals(x: NDArray) -> NDArray:
    """Of a decay with an offset; the parameters differ in size, the last one does nothing."""
    random = np.random.default_rng(5)
    measured = 2 * np.exp(-_TIMES) + 0.3 + random.normal(0, _NOISE, _TIMES.size)
    return np.asarray(x[0] * np.exp(-x[1] * _TIMES) + 1e-3 * x[2] - measured) / _NOISE


def _equations(x: NDArray) -> NormalEquations:
    decay = np.exp(-x[1] * _TIMES)
    rates = np.stack([decay, -x[0] * _TIMES * decay, np.full(_TIMES.size, 1e-3),
                      np.zeros(_TIMES.size)]) / _NOISE
    # in two parts
    return (NormalEquations.of(_residuals(x)[:150], rates[:, :150])
            + NormalEquations.of(_residuals(x)[150:], rates[:, 150:]))


def test_the_minimum_is_found_with_its_covariance() -> None:
    expected = least_squares(_residuals, _START, x_scale=[1, 1, 1000, 1])
    found, equations = minimise(_equations, _START)
    deviation = np.sqrt(np.diag(equations.covariance()))
    truth = np.array([2.0, 1.0, 300.0])
    assert np.all(abs(found - expected.x)[:3] < 0.05 * deviation[:3])
    assert np.all(abs(found[:3] - truth) < 4 * deviation[:3])
    jacobian = expected.jac[:, :3]
    assert equations.covariance()[:3, :3] == pytest.approx(
        np.linalg.inv(jacobian.T @ jacobian), rel=1e-2)
    assert found[3] == deviation[3] == 0
    assert equations.cost == pytest.approx(2 * expected.cost, rel=1e-6)


def test_parameters_that_are_not_free_stay() -> None:
    found, equations = minimise(_equations, _START, free=2)
    assert found[2:] == pytest.approx(_START[2:], abs=0)
    best = least_squares(lambda x: _residuals(np.array([*x, *_START[2:]])), _START[:2])
    assert found[:2] == pytest.approx(best.x, rel=1e-3)
    # and the equations tell where they would go
    whole, _ = minimise(_equations, found)
    assert np.sign(equations.step()[2]) == np.sign(whole[2] - found[2])
