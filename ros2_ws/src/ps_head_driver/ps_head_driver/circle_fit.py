"""Least-squares circles through a few points: algebraic start, geometric refinement."""
import math

import numba as nb
import numpy as np
from numpy.typing import NDArray

_MOST_STEPS = 100
# radius over the spread of the points beyond which they are a line
_STRAIGHT = 1e3
# beyond this it may be the wrong one of several minima, and these centres are tried as well
_FLAT = 5.0
_STARTS = ((0.0, 0.0), (0.7, 0.0), (-0.7, 0.0), (0.0, 0.7), (0.0, -0.7))


def fit_circles(points: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Circles with the smallest sum of squared distances to their points.

    :param points: (n, k, 2) float64, k >= 3.
    :returns: centres (n, 2), radii (n,), rms distances (n,); points on a line have no circle:
        they get a huge one, or a poor fit.
    """
    fits = _fit_all(np.ascontiguousarray(points, np.float64))
    return fits[:, :2], fits[:, 2], fits[:, 3]


@nb.njit(cache=True)
def _fit_all(points):  # type: ignore[no-untyped-def]
    """Centre x and y, radius and rms distance of every circle, (n, 4)."""
    fits = np.empty((len(points), 4))
    x, y = np.empty(points.shape[1]), np.empty(points.shape[1])
    for i in range(len(points)):
        fits[i, 0], fits[i, 1], fits[i, 2], fits[i, 3] = fit_circle(points[i], x, y)
    return fits


@nb.njit(cache=True)
def fit_circle(points, x, y):  # type: ignore[no-untyped-def]
    """Centre x and y, radius and rms distance of one circle, for compiled code.

    :param points: (k, 2).
    :param x, y: scratch arrays (k,).
    """
    count = len(points)
    x0 = y0 = spread = 0.0
    for i in range(count):
        x0 += points[i, 0] / count
        y0 += points[i, 1] / count
    for i in range(count):
        x[i], y[i] = points[i, 0] - x0, points[i, 1] - y0
        spread += (x[i] * x[i] + y[i] * y[i]) / count
    size = math.sqrt(spread)
    if size == 0:
        return x0, y0, 0.0, 0.0
    for i in range(count):      # so that any size of circle is well conditioned
        x[i] /= size
        y[i] /= size
    start_a, start_b = _algebraic(x, y)
    a, b, radius, cost = _descend(x, y, start_a, start_b)
    if radius > _FLAT:       # a small circle may fit the points better than this huge one
        for start in _STARTS:
            other = _descend(x, y, start[0], start[1])
            if other[3] < cost:
                a, b, radius, cost = other
    return x0 + size * a, y0 + size * b, size * radius, size * math.sqrt(cost / count)


@nb.njit(cache=True)
def _descend(x, y, a, b):  # type: ignore[no-untyped-def]
    """Centre, radius and sum of squared distances of the minimum downhill of a centre."""
    cost, radius = _cost(x, y, a, b)
    damping = 0.0
    last = math.inf
    for _ in range(_MOST_STEPS):
        step_a, step_b, damping = _newton_step(x, y, a, b, radius, damping)
        step = math.hypot(step_a, step_b) / (1 + radius)
        new_cost, new_radius = _cost(x, y, a + step_a, b + step_b)
        # near the minimum the sum of squares is all rounding, but Newton's steps are still right
        near = damping == 0 and step < 1e-5
        if new_cost <= cost or near:
            a, b, cost, radius = a + step_a, b + step_b, new_cost, new_radius
            if (near and (step < 1e-12 or step > 0.5 * last)) or radius > _STRAIGHT:
                break
            last = step if near else math.inf
            damping = 0.1 * damping if damping > 1e-6 else 0.0
        else:
            damping = max(10 * damping, 1e-3)
    return a, b, radius, cost


@nb.njit(cache=True)
def _algebraic(x, y):  # type: ignore[no-untyped-def]
    """Centre that solves x^2 + y^2 = 2 a x + 2 b y + c (Kasa), for points around the origin."""
    xx = yy = 1e-13      # a tiny ridge keeps points on a line solvable
    xy = xs = ys = 0.0
    for i in range(len(x)):
        square = x[i] * x[i] + y[i] * y[i]
        xx += x[i] * x[i]
        yy += y[i] * y[i]
        xy += x[i] * y[i]
        xs += x[i] * square / 2
        ys += y[i] * square / 2
    determinant = xx * yy - xy * xy
    return (yy * xs - xy * ys) / determinant, (xx * ys - xy * xs) / determinant


@nb.njit(cache=True)
def _cost(x, y, a, b):  # type: ignore[no-untyped-def]
    """Sum of squared distances to the best circle around (a, b), and its radius."""
    radius = cost = 0.0
    for i in range(len(x)):
        radius += math.hypot(x[i] - a, y[i] - b) / len(x)
    for i in range(len(x)):
        cost += (math.hypot(x[i] - a, y[i] - b) - radius) ** 2
    return cost, radius


@nb.njit(cache=True)
def _newton_step(x, y, a, b, radius, damping):  # type: ignore[no-untyped-def]
    """Step of the centre with the exact Hessian, damped until it leads downhill."""
    count = len(x)
    mean_u = mean_v = 0.0
    for i in range(count):
        distance = max(math.hypot(x[i] - a, y[i] - b), 1e-12)
        mean_u += (x[i] - a) / distance / count
        mean_v += (y[i] - b) / distance / count
    aa = ab = bb = slope_a = slope_b = 0.0
    for i in range(count):
        distance = max(math.hypot(x[i] - a, y[i] - b), 1e-12)
        u, v = (x[i] - a) / distance, (y[i] - b) / distance
        off = distance - radius
        slope_a -= off * u
        slope_b -= off * v
        curl = off / distance
        aa += (u - mean_u) ** 2 + curl * (1 - u * u)
        bb += (v - mean_v) ** 2 + curl * (1 - v * v)
        ab += (u - mean_u) * (v - mean_v) - curl * u * v
    smallest = (aa + bb) / 2 - math.sqrt(((aa - bb) / 2) ** 2 + ab * ab)
    if smallest + damping < 1e-12:
        damping = 1e-3 - smallest
    aa, bb = aa + damping, bb + damping
    determinant = aa * bb - ab * ab
    return (ab * slope_b - bb * slope_a) / determinant, (
        ab * slope_a - aa * slope_b) / determinant, damping
