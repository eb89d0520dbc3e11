"""Robust photometric stereo in plain NumPy: the definition that the compiled version must meet.

Pixel by pixel, frame by frame, in float64. Written to be read, not to be fast; some thousand times
slower than `stv.solve`. It differs where the compiled version shares work: here the Huber weights
of a neighbour q are evaluated for the normal of the patch's own pixel p, pair (p, q) by pair, and
iterated, as Eq. 6 has it; there once per pixel q, for its own normal. The compiled version also
cuts the mean excess over NEAR pixels at the edges of its chunks of CHUNK pixels.
"""
import numpy as np
from numpy.typing import NDArray

from ps_reconstruction import reflectance
from ps_reconstruction.outliers import (
    BELIEVED,
    DARK_RATIO,
    GATE,
    HUBER,
    LEAST_COSINE,
    LEAST_KEPT,
    LEAST_RATIO,
    MANY,
    MOST_EXCESS,
    MOST_RATIO,
    NEAR,
    RANKS,
)
from ps_reconstruction.problem import Problem, expand, intensities
from ps_reconstruction.stv import Plan, StvOptions, Trust, plan

PATCH_ROUNDS = 3      # of the IRLS over a patch


def solve(problem: Problem, options: StvOptions | None = None,
          decided: Plan | None = None) -> NDArray[np.float64]:
    """Scaled normals g of every pixel, (H, W, 3); NaN where there is none.

    :param decided: reflectance and trust; made from the data by `stv.plan` if not given.
    """
    options = options or StvOptions()
    decided = decided or plan(problem, options)
    intensity = intensities(problem)                                             # (H, W, T)
    light = expand(problem.lights, problem.step, problem.shape)                  # (H, W, T, 3)
    view = (np.broadcast_to((0.0, 0.0, 1.0), (*problem.shape, 3)) if problem.view is None
            else expand(problem.view, problem.step, problem.shape))
    irradiance = np.linalg.norm(light, axis=-1)
    direction = light / irradiance[..., None]
    half = direction + view[:, :, None]
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    usable = np.stack([frame.reshape(*problem.shape, -1).max(axis=-1) < problem.saturation
                       for frame in problem.frames], axis=-1)
    mask = np.ones(problem.shape, np.bool_) if problem.mask is None else problem.mask
    reference = np.full((*problem.shape, 3), np.nan)
    own = reference.copy()
    kept = np.zeros(intensity.shape, np.bool_)      # w_temp
    effective = light.copy()                        # f s
    shared = _shared_excess(intensity / irradiance, direction, usable & mask[..., None])
    for y, x in np.argwhere(mask):
        if intensity[y, x].sum() > 0:
            reference[y, x] = _fit(light[y, x], intensity[y, x], np.ones(problem.count))
            own[y, x], kept[y, x], factor = pixel(
                intensity[y, x] / irradiance[y, x], direction[y, x], half[y, x], usable[y, x],
                reference[y, x], decided, options.rounds, shared[y, x])
            effective[y, x] *= factor[:, None]
    if decided.trust == Trust.LEAST_SQUARES:
        return reference
    result = own.copy()
    for y, x in np.argwhere(np.isfinite(own[..., 0])):
        result[y, x] = _patch(y, x, own, kept, reference[y, x], intensity, effective,
                              irradiance, decided, options)
    length = np.linalg.norm(result, axis=-1, keepdims=True)
    mean = result / length + decided.hold * reference / np.linalg.norm(
        reference, axis=-1, keepdims=True)
    return mean * length / np.linalg.norm(mean, axis=-1, keepdims=True)


def pixel(u: NDArray, d: NDArray, h: NDArray, usable: NDArray, g: NDArray, decided: Plan,
          rounds: int, shared: NDArray | None = None) -> tuple[NDArray, NDArray, NDArray]:
    """Temporal rejection at one pixel: its own scaled normal, w_temp (T,) and f / (n.l) (T,).

    :param u: (T,) intensity per irradiance; d, h: (T, 3) directions and half-vectors.
    :param g: (3,) least squares.
    :param shared: (T,) mean excess over Lambert's law of NEAR pixels; only for few lights.
    """
    if decided.trust == Trust.LEAST_SQUARES:
        return g, np.ones(len(u), np.bool_), np.ones(len(u))
    factor = np.ones(len(u))
    g, keep = _first_of_many(u, d, usable) if len(u) >= MANY else _first_of_few(
        u, d, h, usable, decided, shared)
    if decided.trust == Trust.REFLECTANCE:
        if len(u) < MANY:
            usable = keep
        for _ in range(rounds):
            factor, keep = _compare(u, d, h, usable, g, decided)
            if len(u) >= MANY:
                keep = _darkest(u, keep)
            g = _fit(factor[:, None] * d, u, keep * _huber(u - factor * (d @ g), g), g)
    return g, keep, factor


def _first_of_many(u: NDArray, d: NDArray, usable: NDArray) -> tuple[NDArray, NDArray]:
    last, ordered = len(u) - 1, np.sort(u)
    low, high = ordered[int(RANKS[0] * last)], ordered[int(np.ceil(RANKS[1] * last)) - 1]
    keep = usable & (u > low) & (u <= high)
    g = _fit(d, u, keep)
    for _ in range(3):
        predicted = d @ g
        keep = _darkest(u, usable & (predicted > LEAST_COSINE * np.linalg.norm(g))
                        & (u > LEAST_RATIO * predicted))
        g = _fit(d, u, keep, g)
    return g, keep


def _first_of_few(u: NDArray, d: NDArray, h: NDArray, usable: NDArray, decided: Plan,
                  shared: NDArray | None) -> tuple[NDArray, NDArray]:
    g, keep = _without_dark(u, d, usable)
    if keep.sum() > 3:
        cosine = np.where(keep, h @ g / np.linalg.norm(g), -1)
        glossy = np.argmax(cosine)
        excess = (u[glossy] - d[glossy] @ g) / np.linalg.norm(g)
        together = shared is not None and excess > 0 and shared[glossy] > decided.shared_margin
        if cosine[glossy] > GATE and (excess > decided.margin or together):
            keep[glossy] = False
            g = _fit(d, u, keep, g)
    return g, keep


def _without_dark(u: NDArray, d: NDArray, usable: NDArray) -> tuple[NDArray, NDArray]:
    """Drop attached shadows, as long as more than three frames are left."""
    keep = usable.copy()
    while keep.sum() > 3:
        darkest = np.flatnonzero(keep)[np.argmin(u[keep])]
        if u[darkest] >= DARK_RATIO * u.max():
            break
        keep[darkest] = False
    return _fit(d, u, keep), keep


def _shared_excess(u: NDArray, d: NDArray, usable: NDArray) -> NDArray[np.float64]:
    """Mean over NEAR pixels of a row of the excess over Lambert's law relative to |g|, (H, W, T).

    Frames that are not believed count 0, and so does what lies beside the picture.
    """
    excess = np.zeros(u.shape)
    if u.shape[-1] < MANY:
        for y, x in np.argwhere(usable.sum(axis=-1) >= 3):
            g, keep = _without_dark(u[y, x], d[y, x], usable[y, x])
            length = np.linalg.norm(g)
            if length > 0:
                excess[y, x] = keep * (u[y, x] - d[y, x] @ g) / length
    padded = np.pad(np.clip(excess, -MOST_EXCESS, MOST_EXCESS), [(0, 0), (NEAR // 2,) * 2, (0, 0)])
    windows: NDArray = np.lib.stride_tricks.sliding_window_view(padded, NEAR, axis=1)
    return np.asarray(windows.mean(axis=-1))


def _compare(u: NDArray, d: NDArray, h: NDArray, usable: NDArray, g: NDArray, decided: Plan
             ) -> tuple[NDArray, NDArray]:
    """Reflectance factor f / (n.l) and whether each frame fits the prediction."""
    length = np.linalg.norm(g)
    cosine, half = d @ g / length, h @ g / length
    factor = reflectance.departures(decided.coefficients, np.clip(cosine, LEAST_COSINE, 1),
                                    np.clip(half, reflectance.LEAST_HALF, 1))
    predicted = factor * cosine * length
    keep = (usable & (cosine >= LEAST_COSINE) & (half >= reflectance.LEAST_HALF)
            & (u > LEAST_RATIO * predicted) & (u < MOST_RATIO * predicted))
    return factor, keep


def _patch(y: int, x: int, own: NDArray, kept: NDArray, reference: NDArray, intensity: NDArray,
           effective: NDArray, irradiance: NDArray, decided: Plan, options: StvOptions) -> NDArray:
    """Eq. 6 at one pixel by iteratively reweighted least squares.

    Normals differ within a patch by as much as the edge-aware weight tolerates; the Huber
    threshold is wider by that, so that it judges frames and not the form of the surface.
    """
    radius = options.patch // 2
    height, width = intensity.shape[:2]
    members = [(v, w) for v in range(max(0, y - radius), min(height, y + radius + 1))
               for w in range(max(0, x - radius), min(width, x + radius + 1))
               if np.isfinite(own[v, w, 0])]
    tolerance = options.edge_tolerance * decided.scatter
    edge = tolerance * np.linalg.norm(own[y, x])
    weight = np.array([
        np.exp(-0.5 * ((v - y) ** 2 + (w - x) ** 2) / options.spatial_sigma ** 2)
        / (1 + np.sum((own[v, w] - own[y, x]) ** 2) / edge ** 2) for v, w in members])
    g, reweighted = own[y, x], decided.trust == Trust.REFLECTANCE
    for _ in range(PATCH_ROUNDS):
        matrix, right = np.zeros((3, 3)), np.zeros(3)
        for w_patch, q in zip(weight, members, strict=True):
            residual = (intensity[q] - effective[q] @ g) / irradiance[q]
            w_huber = _huber(residual, g, HUBER + tolerance) if reweighted else 1.0
            row = w_patch * kept[q] * w_huber
            matrix += effective[q].T @ (row[:, None] * effective[q])
            right += effective[q].T @ (row * intensity[q])
        strength = options.ridge * np.trace(matrix) / 3
        g = np.linalg.solve(matrix + strength * np.eye(3), right + strength * reference)
    return g


def _huber(residual: NDArray, g: NDArray, threshold: float = HUBER) -> NDArray:
    limit = threshold * np.linalg.norm(g)
    weight: NDArray = limit / np.maximum(np.abs(residual), limit)
    return weight


def _darkest(u: NDArray, keep: NDArray) -> NDArray:
    used = np.sort(u[keep])
    if len(used) <= LEAST_KEPT:
        return keep
    limit = used[max(LEAST_KEPT, int(BELIEVED * len(used) + 0.5)) - 1]
    return keep & (u <= limit)


def _fit(equations: NDArray, right: NDArray, weight: NDArray, fallback: NDArray | None = None
         ) -> NDArray:
    """Weighted least squares; ``fallback`` where fewer than three frames are left."""
    if fallback is not None and np.count_nonzero(weight) < 3:
        return fallback
    root = np.sqrt(weight)
    solution: NDArray = np.linalg.lstsq(equations * root[:, None], right * root, rcond=None)[0]
    return solution
