"""Careful integration: confidence weights, masks and height steps.

Minimises sum over links between neighbours of weight * (w_j - w_i - gradient)^2. Every pixel has
its own gradient and may trust the neighbour on one side more than the other: at a height step the
two pixels turn away from each other and the link fades (bilaterally weighted integration, after
Cao et al., ECCV 2022). Each set of weights is solved by conjugate gradients, preconditioned by a
multigrid cycle that merges 2 x 2 pixels per level, so masks of any shape need no special care.
"""
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from ps_reconstruction.bands import for_bands

BAND = 64
COARSEST = 64                 # cells at which the hierarchy ends
# Merging without smoothing makes the coarse links twice too stiff for smooth errors
COARSE_STIFFNESS = 0.5


@dataclass
class _Level:
    """Links of one grid: ``right[y, x]`` joins (y, x) and (y, x + 1), ``down`` likewise."""

    right: NDArray[np.float32]
    down: NDArray[np.float32]
    reciprocal: NDArray[np.float32]      # 1 / sum of the links of a cell; 0 for a cell with none


def integrate(
    du: NDArray[np.float32], dv: NDArray[np.float32], confidence: NDArray | None = None,
    start: NDArray[np.float32] | None = None, steepness: float = 2.0, rounds: int = 10,
    tolerance: float = 1e-4, pitch: float = 1.0,
) -> NDArray[np.float32]:
    """Integrate a gradient field where it is known.

    :param du: (H, W) derivative along the columns axis at the pixels, NaN where unknown.
    :param dv: (H, W) derivative along the rows axis.
    :param confidence: (H, W), 0 to 255; None weighs all known pixels alike.
    :param start: (H, W) first guess.
    :param steepness: how sharply a pixel turns away from a height step; 0 for none.
    :param rounds: updates of the side weights.
    :param tolerance: relative residual at which conjugate gradients stop.
    :param pitch: change of w on a slope of 45 degrees (1 / fx for a perspective camera, the
        pixel pitch for a parallel one).
    :returns: (H, W) float32, free by one constant per connected region.
    """
    known = np.isfinite(du) & np.isfinite(dv)
    trust = known.astype(np.float32)
    if confidence is not None:
        trust *= confidence.astype(np.float32) * np.float32(1 / 255)
    du, dv = (np.where(known, g, np.float32(0)) for g in (du, dv))
    # distances count along the surface normal, so steep parts do not tear
    facing = 1 / (1 + (du * du + dv * dv) / np.float32(pitch ** 2))
    if steepness > 0:
        trust *= facing
    w = np.zeros(du.shape, np.float32) if start is None else start.astype(np.float32).copy()
    w[~known] = 0
    sharpness = np.float32(steepness / pitch ** 2)
    for number in range(rounds if steepness > 0 else 1):
        right, down, source = (np.zeros(du.shape, np.float32) for _ in range(3))
        # the first round has nothing to judge by
        k = sharpness if number or start is not None else np.float32(0)
        _links(w, du, dv, trust, facing * k, right, down, source)
        before = w.copy()
        _conjugate_gradients(_hierarchy(right, down), source, w, tolerance)
        if number and np.abs(w - before).max() < 0.01 * pitch:
            break
    return w


def _hierarchy(right: NDArray, down: NDArray) -> list[_Level]:
    levels = []
    while True:
        levels.append(_Level(right, down, _reciprocal(right, down)))
        if right.size <= COARSEST or min(right.shape) == 1:
            return levels
        right, down = _merge_links(right, down, np.float32(COARSE_STIFFNESS))


def _conjugate_gradients(levels: list[_Level], source: NDArray, w: NDArray, tolerance: float,
                         most: int = 60) -> None:
    """Improve ``w`` in place until the residual is ``tolerance`` of the source."""
    top = levels[0]
    residual = np.empty_like(w)
    _residual(top.right, top.down, source, w, residual)
    goal = tolerance * np.sqrt(_dot(source, source))
    direction, product = np.zeros_like(w), np.empty_like(w)
    zero = np.zeros_like(w)
    before = 1.0
    for number in range(most):
        if np.sqrt(_dot(residual, residual)) <= goal:
            return
        better = _cycle(levels, 0, residual)
        rho = _dot(residual, better)
        direction *= np.float32(rho / before if number else 0.0)
        direction += better
        _residual(top.right, top.down, zero, direction, product)
        np.negative(product, out=product)
        curvature = _dot(direction, product)
        if rho <= 0 or curvature <= 0:       # at the limit of float32
            return
        step = np.float32(rho / curvature)
        w += step * direction
        residual -= step * product
        before = rho


def _dot(a: NDArray, b: NDArray) -> float:
    """Sum of products in float64, in an order that does not depend on the cores."""
    return float(np.sum(for_bands(
        len(a), BAND, lambda i, j: np.einsum('yx,yx->', a[i:j], b[i:j], dtype=np.float64))))


def _cycle(levels: list[_Level], depth: int, source: NDArray) -> NDArray:
    """One symmetric W-cycle from a zero guess."""
    level = levels[depth]
    w = np.zeros_like(source)
    if depth == len(levels) - 1:
        for _ in range(8):
            _smooth(level, source, w, (0, 1))
            _smooth(level, source, w, (1, 0))
        return w
    _smooth(level, source, w, (0, 1))
    residual = np.empty_like(source)
    for _ in range(2 if depth > 1 else 1):
        _residual(level.right, level.down, source, w, residual)
        coarse = _cycle(levels, depth + 1, _merge(residual))
        _spread(coarse, level.reciprocal, w)
        _smooth(level, source, w, (0, 1) if depth > 1 else ())
        _smooth(level, source, w, (1, 0))
    return w


def _smooth(level: _Level, source: NDArray, w: NDArray, colours: tuple[int, ...]) -> None:
    for colour in colours:
        if w.size < 10000:
            _relax(level.right, level.down, level.reciprocal, source, w, colour, 0, len(w))
            continue
        for_bands(len(w), BAND, lambda i, j, c=colour: _relax(    # type: ignore[misc]
            level.right, level.down, level.reciprocal, source, w, c, i, j))


@numba.njit(nogil=True, cache=True)
def _links(w, du, dv, trust, sharpness, right, down, source):    # type: ignore[no-untyped-def]
    """Weights of the links and the right side of the normal equations."""
    height, width = w.shape
    one, half = np.float32(1), np.float32(0.5)
    side_x = np.empty((height, width), np.float32)     # trust towards x + 1; 1 - it towards x - 1
    side_y = np.empty((height, width), np.float32)
    for y in range(height):
        for x in range(width):
            forward = backward = np.float32(0)
            share = half
            has_right = x + 1 < width and trust[y, x + 1] > 0
            has_left = x > 0 and trust[y, x - 1] > 0
            if has_right and has_left:
                forward = w[y, x + 1] - w[y, x]
                backward = w[y, x] - w[y, x - 1]
                share = one / (one + np.exp(min(sharpness[y, x] * (
                    forward * forward - backward * backward), np.float32(50))))
            side_x[y, x] = share
            share = half
            has_down = y + 1 < height and trust[y + 1, x] > 0
            has_up = y > 0 and trust[y - 1, x] > 0
            if has_down and has_up:
                forward = w[y + 1, x] - w[y, x]
                backward = w[y, x] - w[y - 1, x]
                share = one / (one + np.exp(min(sharpness[y, x] * (
                    forward * forward - backward * backward), np.float32(50))))
            side_y[y, x] = share
    for y in range(height):
        for x in range(width):
            if trust[y, x] <= 0:
                continue
            if x + 1 < width and trust[y, x + 1] > 0:
                a = side_x[y, x] * trust[y, x]
                b = (one - side_x[y, x + 1]) * trust[y, x + 1]
                right[y, x] = a + b
                flow = a * du[y, x] + b * du[y, x + 1]
                source[y, x] -= flow
                source[y, x + 1] += flow
            if y + 1 < height and trust[y + 1, x] > 0:
                a = side_y[y, x] * trust[y, x]
                b = (one - side_y[y + 1, x]) * trust[y + 1, x]
                down[y, x] = a + b
                flow = a * dv[y, x] + b * dv[y + 1, x]
                source[y, x] -= flow
                source[y + 1, x] += flow


@numba.njit(nogil=True, cache=True)
def _reciprocal(right, down):    # type: ignore[no-untyped-def]
    height, width = right.shape
    result = np.zeros((height, width), np.float32)
    for y in range(height):
        for x in range(width):
            total = right[y, x] + down[y, x]
            if x > 0:
                total += right[y, x - 1]
            if y > 0:
                total += down[y - 1, x]
            if total > np.float32(1e-12):
                result[y, x] = np.float32(1) / total
    return result


@numba.njit(nogil=True, cache=True)
def _merge_links(right, down, stiffness):    # type: ignore[no-untyped-def]
    height, width = right.shape
    coarse = ((height + 1) // 2, (width + 1) // 2)
    coarse_right, coarse_down = np.zeros(coarse, np.float32), np.zeros(coarse, np.float32)
    for y in range(height):
        for x in range(width):
            if x % 2 == 1 and x + 1 < width:
                coarse_right[y // 2, x // 2] += stiffness * right[y, x]
            if y % 2 == 1 and y + 1 < height:
                coarse_down[y // 2, x // 2] += stiffness * down[y, x]
    return coarse_right, coarse_down


@numba.njit(nogil=True, cache=True)
def _merge(values):    # type: ignore[no-untyped-def]
    height, width = values.shape
    coarse = np.zeros(((height + 1) // 2, (width + 1) // 2), np.float32)
    for y in range(height):
        for x in range(width):
            coarse[y // 2, x // 2] += values[y, x]
    return coarse


@numba.njit(nogil=True, cache=True)
def _spread(coarse, reciprocal, w):    # type: ignore[no-untyped-def]
    height, width = w.shape
    for y in range(height):
        for x in range(width):
            if reciprocal[y, x] > 0:
                w[y, x] += coarse[y // 2, x // 2]


@numba.njit(nogil=True, cache=True)
def _relax(right, down, reciprocal, source, w, colour, first, last):    # type: ignore[no-untyped-def]
    """Gauss-Seidel on the cells with (x + y) % 2 == colour of some rows."""
    height, width = w.shape
    for y in range(first, last):
        for x in range((y + colour) % 2, width, 2):
            total = source[y, x]
            if x + 1 < width:
                total += right[y, x] * w[y, x + 1]
            if x > 0:
                total += right[y, x - 1] * w[y, x - 1]
            if y + 1 < height:
                total += down[y, x] * w[y + 1, x]
            if y > 0:
                total += down[y - 1, x] * w[y - 1, x]
            w[y, x] = total * reciprocal[y, x]


@numba.njit(nogil=True, cache=True)
def _residual_rows(right, down, source, w, out, first, last):    # type: ignore[no-untyped-def]
    height, width = w.shape
    for y in range(first, last):
        for x in range(width):
            total = source[y, x]
            if x + 1 < width:
                total += right[y, x] * (w[y, x + 1] - w[y, x])
            if x > 0:
                total += right[y, x - 1] * (w[y, x - 1] - w[y, x])
            if y + 1 < height:
                total += down[y, x] * (w[y + 1, x] - w[y, x])
            if y > 0:
                total += down[y - 1, x] * (w[y - 1, x] - w[y, x])
            out[y, x] = total


def _residual(right: NDArray, down: NDArray, source: NDArray, w: NDArray, out: NDArray) -> None:
    """Source less the operator on ``w``."""
    for_bands(len(w), BAND, lambda i, j: _residual_rows(right, down, source, w, out, i, j))
