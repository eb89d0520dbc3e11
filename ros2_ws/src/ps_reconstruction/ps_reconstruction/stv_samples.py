"""The pixels that the plan of the robust regression looks at, and the noise they show."""
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from ps_reconstruction.problem import GREY_WEIGHTS, Problem

SAMPLES, LEAST_SAMPLES = 4000, 1000     # pixels that the plan looks at, few or many lights
SAMPLE_FRAMES = 64000         # pixels times lights of the plan


def places(problem: Problem) -> tuple[NDArray, NDArray]:
    """Rows and columns of some thousand pixels spread over the mask."""
    height, width = problem.shape
    most = max(LEAST_SAMPLES, min(SAMPLES, SAMPLE_FRAMES // problem.count))
    if problem.mask is None:
        # an odd stride off the width walks through all columns
        stride = max(1, height * width // most) | 1
        index = np.arange(0, height * width, stride + 2 * (width % stride == 0))
    else:
        index = np.flatnonzero(problem.mask)
        index = index[::max(1, len(index) // most)]
    row, column = np.divmod(index, width)
    return row, column


def noise_of(problem: Problem, row: NDArray, column: NDArray) -> float:
    """Noise of the residuals of LS relative to |g|, from the difference to the next pixel's.

    What the surface does to the residuals, as gloss, it does to both alike; noise differs.
    """
    other = np.where(column + 1 < problem.shape[1], column + 1, column - 1)
    if problem.mask is not None:
        row, column, other = (a[problem.mask[row, other]] for a in (row, column, other))
    u, d, _, _, g = samples(problem, np.r_[row, row], np.r_[column, other], every=True)
    residual = residuals(u, d, g).reshape(len(u), 2, -1)
    # the lower quartile: where the surface changes from pixel to pixel it must not count
    return spread_of(np.diff(residual, axis=1), 0.25) / 2 ** 0.5


def residuals(u: NDArray, d: NDArray, g: NDArray) -> NDArray:
    """What the scaled normals leave of the intensities, relative to |g|, (T, P)."""
    length = np.maximum(np.linalg.norm(g, axis=0), 1e-12)
    relative: NDArray = (u - np.einsum('ip,tip->tp', g, d)) / length
    return relative


def spread_of(values: NDArray, quantile: float = 0.5) -> float:
    """Standard deviation of values around 0 from a quantile of their size, as if normal."""
    if not values.size:
        return 0.0
    return float(np.quantile(np.abs(values), quantile)) / NormalDist().inv_cdf((1 + quantile) / 2)


def samples(problem: Problem, row: NDArray, column: NDArray, every: bool = False
            ) -> tuple[NDArray, NDArray, NDArray, NDArray, NDArray]:
    """What the solver sees at P pixels, without black ones unless ``every``.

    :returns: u (T, P), d (T, 3, P), h (T, 3, P), usable (T, P) 0 or 1, g_ls (3, P), float32.
    """
    nodes = (row / problem.step, column / problem.step)
    lights = _interpolate(problem.lights, *nodes)
    view = _interpolate(view_nodes(problem), *nodes)
    weights = np.array(GREY_WEIGHTS) if problem.colour else np.ones(1)
    values, usable = np.empty(lights.shape[:2]), np.ones(lights.shape[:2], np.bool_)
    dark = (0.0 if problem.ambient is None
            else problem.ambient[row, column].reshape(len(row), -1).astype(np.float64))
    for t, (frame, scale) in enumerate(zip(problem.frames, problem.scale, strict=True)):
        raw = frame[row, column].reshape(len(row), -1).astype(np.float64)
        usable[:, t] = raw.max(axis=1) < problem.saturation
        values[:, t] = np.minimum((raw - dark) * scale, problem.clip) @ weights
    if problem.reciprocal_flat is not None:
        values *= _interpolate(problem.reciprocal_flat, *nodes)
    lit = (values.mean(axis=1) > 0) | every
    values, lights, view, usable = values[lit], lights[lit], view[lit], usable[lit]
    irradiance = np.linalg.norm(lights, axis=2)
    d, u = lights / irradiance[..., None], values / irradiance
    g_ls = np.einsum('pit,pt->pi', np.linalg.pinv(d), u)
    h = d + view[:, None]
    h /= np.linalg.norm(h, axis=2, keepdims=True)
    u, d, h = (np.moveaxis(a, 0, -1) for a in (u, d, h))
    single = [np.ascontiguousarray(a, np.float32) for a in (u, d, h, usable.T, g_ls.T)]
    return single[0], single[1], single[2], single[3], single[4]


def _interpolate(grid: NDArray, row: NDArray, column: NDArray) -> NDArray:
    """Bilinear interpolation of nodes at P positions given in nodes, (gh, gw, ...) to (P, ...)."""
    i = np.minimum(row.astype(int), grid.shape[0] - 2)
    j = np.minimum(column.astype(int), grid.shape[1] - 2)
    fy, fx = (f.reshape(-1, *(1,) * (grid.ndim - 2)) for f in (row - i, column - j))
    result: NDArray = ((1 - fy) * ((1 - fx) * grid[i, j] + fx * grid[i, j + 1])
                       + fy * ((1 - fx) * grid[i + 1, j] + fx * grid[i + 1, j + 1]))
    return result


def view_nodes(problem: Problem) -> NDArray[np.float64]:
    """Directions to the camera at the nodes; from straight above where unknown."""
    if problem.view is not None:
        return problem.view
    view = np.zeros((*problem.lights.shape[:2], 3))
    view[..., 2] = 1
    return view
