"""Least squares of many residuals and few parameters: damped Gauss-Newton (Levenberg-Marquardt).

Only sums over the residuals are kept, added up part by part. scipy's solvers want all residuals
and their derivatives at once, and decompose them anew in every step.
"""
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_NEAR = 1e-3             # squared way to the minimum, in standard deviations: near enough
_EVALUATIONS = 20
_DAMPING = 1e-4          # to start with, relative to the diagonal
_EASIER, _HARDER = 0.1, 10.0


@dataclass(frozen=True)
class NormalEquations:
    """Sums over residuals r, relative to their noise, with derivatives J by P parameters.

    :param cost: r^T r.
    :param gradient: (P,) J^T r.
    :param matrix: (P, P) J^T J.
    """

    cost: float
    gradient: NDArray
    matrix: NDArray

    @classmethod
    def of(cls, residuals: NDArray, rates: NDArray) -> 'NormalEquations':
        """From residuals (...) and their derivatives (P, ...)."""
        r, rows = residuals.ravel(), rates.reshape(len(rates), -1)
        return cls(float(r @ r), rows @ r, rows @ rows.T)

    def __add__(self, other: 'NormalEquations') -> 'NormalEquations':
        return NormalEquations(self.cost + other.cost, self.gradient + other.gradient,
                               self.matrix + other.matrix)

    def first(self, parameters: int | None) -> 'NormalEquations':
        """Of the first parameters, the others fixed."""
        return NormalEquations(self.cost, self.gradient[:parameters],
                               self.matrix[:parameters, :parameters])

    @property
    def sizes(self) -> NDArray:
        """Standard deviation of each parameter if it were the only one, (P,)."""
        return np.asarray(1 / np.sqrt(np.diag(self.matrix).clip(min=1e-300)))

    def correlation(self) -> NDArray:
        """The matrix with every parameter in units of its size, (P, P)."""
        return self.matrix * np.outer(self.sizes, self.sizes)

    def covariance(self) -> NDArray:
        """Of the parameters, (P, P); 0 for one that nothing depends on."""
        return np.asarray(np.linalg.pinv(self.correlation(), hermitian=True)
                          * np.outer(self.sizes, self.sizes))

    def step(self, damping: float = 0.0) -> NDArray:
        """Way to the minimum, (P,)."""
        damped = self.correlation() + damping * np.eye(len(self.gradient))
        return np.asarray(-np.linalg.pinv(damped, hermitian=True) @ (self.gradient * self.sizes)
                          * self.sizes)


def minimise(equations: Callable[[NDArray], NormalEquations], x: NDArray,
             free: int | None = None) -> tuple[NDArray, NormalEquations]:
    """Least squares from a start: where it ends, and the equations there.

    :param equations: of all parameters.
    :param x: (P,) to start from.
    :param free: how many parameters, the first ones, are free; all without.
    """
    here, damping = equations(x), _DAMPING
    for _ in range(_EVALUATIONS - 1):
        part = here.first(free)
        way = part.step(damping)
        if way @ part.matrix @ way < _NEAR:
            break
        moved = x.copy()
        moved[:len(way)] += way
        there = equations(moved)
        if there.cost < here.cost:
            x, here, damping = moved, there, damping * _EASIER
        else:
            damping *= _HARDER
    return x, here
