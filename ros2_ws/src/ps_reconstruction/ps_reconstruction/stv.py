"""Robust photometric stereo (paper, §2.4, Eq. 5-7), compiled and on all cores.

For every pixel p

    min over g   sum_{q in N(p)} sum_t w_patch(p, q) w_temp(q, t) huber(v_t(q) - f_t(q) s_t(q) . g)
                 + lambda |g - g_LS(p)|^2

v intensity, s light vector, w_patch spatial Gaussian times edge-aware weight, w_temp in {0, 1}.
f_t = f(n.l, n.h) / (n.l) is the object's own departure from Lambert's law (reflectance.py), 1 for
a matt surface: it makes s_t effective, as the paper has it.

Two stages. `plan` looks at some thousand pixels spread over the image: it fits the reflectance
and chooses how far to trust it (`Trust`). Then bands of rows are solved independently. Temporal
and Huber weights belong to a pixel q and are shared by all patches that contain it, so a patch
is a weighted sum of normal equations that exist already. `stv_oracle.solve` is the unshared
definition in plain NumPy.
"""
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from ps_head_driver.errors import ErrorCode, PsError
from ps_reconstruction import backend, reflectance
from ps_reconstruction.bands import for_bands
from ps_reconstruction.least_squares import check_lights, empty_solution
from ps_reconstruction.outliers import (
    HUBER,
    LEAST_COSINE,
    LEAST_RATIO,
    MANY,
    MOST_RATIO,
    NEAR,
    estimate_samples,
)
from ps_reconstruction.problem import GREY_WEIGHTS, MAX_PATCH, Problem, Solution
from ps_reconstruction.stv_kernels import combine_patches, finish, solve_pixels
from ps_reconstruction.stv_samples import (
    noise_of,
    places,
    residuals,
    samples,
    spread_of,
    view_nodes,
)

BAND, LEAST_BAND = 48, 12     # rows per band; fewer for many lights, to bound the memory
BAND_FRAMES = 768             # rows times lights of a band
SAMPLE_BAND = 512             # samples per core and call
ROUNDS = 5                    # of the reflectance fit
NOT_LAMBERTIAN = 0.04         # median misfit of LS from which few lights tell nothing more
NOT_EXPLAINED = 0.05          # upper quartile of the misfit after rejection: likewise
SIGNIFICANT = 3.0             # largest margin of a highlight, in standard deviations of the noise
NOISE_ALONE = 1.15            # residuals of LS over noise, below which few lights see a matt part
DOUBTFUL = (0.1, 0.15)        # median misfit of many lights: LS begins to count, counts fully
FAR_WORSE = 3.0               # misfit with reflectance over that of rejection: not with few lights
QUANTILE = 0.75               # of the misfits, by which the estimates are compared


class Trust(IntEnum):
    """How far a stack departs from least squares; each rests on the one before."""

    LEAST_SQUARES = 0         # the robust estimates predict the frames worse: keep LS
    REJECTION = 1             # reject shadows and highlights, Lambert's law for the rest
    REFLECTANCE = 2           # also the object's own reflectance, and Huber weights against it


@dataclass(frozen=True)
class StvOptions:
    """Parameters of the robust regression; the defaults suit metal, plastic and ceramic parts.

    :param patch: width of the square patch N(p) in pixels, odd; 1 for none.
    :param spatial_sigma: of the spatial Gaussian, in pixels.
    :param edge_tolerance: difference of the scaled normals that halves the edge-aware weight, as
        a multiple of the scatter that the plan expects of them.
    :param ridge: lambda, relative to the information of the equations.
    :param rounds: repetitions of rejection and solution per pixel.
    :param trust: fixed choice instead of the one made from the data.
    """

    patch: int = 5
    spatial_sigma: float = 1.0
    edge_tolerance: float = 1.25
    ridge: float = 1e-3
    rounds: int = 2
    trust: Trust | None = None

    def __post_init__(self) -> None:
        if self.patch % 2 == 0 or not 1 <= self.patch <= MAX_PATCH:
            raise PsError(ErrorCode.RECONSTRUCTION_BAD_PARAMETER,
                          f'patch: {self.patch} must be odd, 1 to {MAX_PATCH}')
        for name in ('spatial_sigma', 'edge_tolerance'):
            if not getattr(self, name) > 0:
                raise PsError(ErrorCode.RECONSTRUCTION_BAD_PARAMETER, f'{name}: must be positive')
        if not self.ridge >= 0 or not 1 <= self.rounds <= 50:
            raise PsError(ErrorCode.RECONSTRUCTION_BAD_PARAMETER,
                          'ridge must not be negative, rounds must be 1 to 50')


@dataclass(frozen=True)
class Plan:
    """What holds for the whole stack: the reflectance and how far to trust it.

    :param scatter: expected relative error of a pixel's own scaled normal.
    :param margin: excess over Lambert's law, relative to |g|, that noise explains.
    :param shared_margin: likewise, of the mean of NEAR pixels side by side.
    :param hold: share of the LS normal added to the robust unit normal, 1 where many frames are
        explained badly: then neither is right and their errors partly cancel.
    """

    coefficients: NDArray[np.float64]
    trust: Trust
    scatter: float = 0.0
    hold: float = 0.0
    margin: float = 0.0
    shared_margin: float = float('inf')


def solve(problem: Problem, options: StvOptions | None = None, quality: bool = True,
          out: Solution | None = None, decided: Plan | None = None) -> Solution:
    """Normals and albedo by robust regression.

    :param quality: also compute confidence, reason and residual_rms.
    :param out: arrays to fill instead of new ones; must fit the problem.
    :param decided: reflectance and trust, for instance of a good part; made by `plan` if None.
    :raises PsError: RECONSTRUCTION_TOO_FEW_LIGHTS, RECONSTRUCTION_DEGENERATE_LIGHTS.
    """
    options = options or StvOptions()
    check_lights(problem.lights)
    result = out if out is not None else empty_solution(problem, quality)
    height, width = problem.shape
    decided = decided or plan(problem, options)
    reject, reflect = decided.trust > Trust.LEAST_SQUARES, decided.trust == Trust.REFLECTANCE
    coefficients = decided.coefficients.astype(np.float32)
    margins = np.array([decided.margin, decided.shared_margin], np.float32)
    lights = _planes(problem.lights)
    view = _planes(view_nodes(problem))
    flat = (np.zeros((0, 0, 0), np.float32) if problem.reciprocal_flat is None
            else _planes(problem.reciprocal_flat))
    spatial = _spatial(options)
    radius = options.patch // 2
    band = backend.band_rows(height, max(LEAST_BAND, min(BAND, BAND_FRAMES // problem.count)))
    solve_band = backend.kernel('solve_pixels', solve_pixels)
    combine_band = backend.kernel('combine_patches', combine_patches)
    finish_band = backend.kernel('finish', finish)
    edge = options.edge_tolerance * decided.scatter

    def work(first: int, last: int) -> tuple[float, float, int]:
        top, bottom = max(first - radius, 0), min(last + radius, height)
        shape = (bottom - top, width)
        channels, grey, saturated = _band_values(problem, top, bottom)
        mask = np.ones(shape, np.bool_) if problem.mask is None else problem.mask[top:bottom]
        reference, scaled = np.zeros((2, 3, *shape), np.float32)
        equations = np.zeros((9, *shape), np.float32)
        shading = np.zeros((problem.count if problem.colour else 0, *shape), np.float32)
        tally = np.zeros((4, *shape), np.float32)
        reason = np.zeros(shape, np.uint8)
        solve_band(grey, saturated, mask, lights, view, flat, problem.step, top, coefficients,
                   margins, options.rounds, reject, reflect, reference, scaled, equations, shading,
                   tally, reason)
        inner = slice(first - top, last - top)
        if not reject:
            solved = reference[:, inner]
        else:
            solved = np.empty((3, last - first, width), np.float32)
            combine_band(reference, scaled, equations, spatial, edge, options.ridge, first - top,
                         solved)
        length = np.empty((last - first, width), np.float32)
        confidence = np.empty((last - first, width), np.uint8)
        sums: tuple[float, float, int] = finish_band(
            solved, reference[:, inner], tally[:, inner], mask[inner], problem.count,
            decided.hold, result.normal[first:last], length, confidence, reason[inner])
        if problem.colour:
            colour = np.einsum('thw,thwc->hwc', shading[:, inner], channels[:, inner])
            colour[np.isnan(length)] = np.nan
            result.albedo[first:last] = colour
        else:
            result.albedo[first:last] = length
        if quality:
            assert result.confidence is not None
            assert result.reason is not None
            result.confidence[first:last] = confidence
            result.reason[first:last] = reason[inner]
        return sums

    squares, brightness, count = np.sum(for_bands(height, band, work), axis=0)
    if quality and problem.count > 3 and count and brightness > 0:
        result.residual_rms = float(np.sqrt(squares / count) / (brightness / count))
    return result


def plan(problem: Problem, options: StvOptions | None = None) -> Plan:
    """Fit the object's reflectance to sample pixels and choose how far to trust it.

    The choice compares how well each estimate predicts all frames of the samples, the rejected
    ones included: |difference| / mean intensity of the pixel, its upper quartile. Few lights must
    also be explained well by a matt body and a few outliers, and get no reflectance where LS
    leaves only noise; where many lights are explained badly, part of the LS normal is added
    (`Plan.hold`).
    """
    options = options or StvOptions()
    pixels = places(problem)
    u, d, h, usable, g_ls = samples(problem, *pixels)
    lambertian = np.zeros(reflectance.TERMS)
    if problem.count == 3 or u.shape[1] == 0:
        return Plan(lambertian, Trust.LEAST_SQUARES)
    margin, shared, alone = 0.0, float('inf'), False
    if problem.count < MANY:
        noise, spread = noise_of(problem, *pixels), spread_of(residuals(u, d, g_ls))
        alone = spread < NOISE_ALONE * noise
        # Against what gloss adds: the less there is, the surer a highlight must be. This ratio of
        # variance to deviation is the threshold known from wavelet denoising as BayesShrink
        # (Chang, Yu and Vetterli, 2000).
        gloss = max(spread ** 2 - noise ** 2, 1e-20) ** 0.5
        margin = noise * min(SIGNIFICANT, noise / gloss)
        # of the mean of neighbours noise is less, what the surface does is not
        less = noise / NEAR ** 0.5
        shared = less * (SIGNIFICANT if alone else min(SIGNIFICANT, less / gloss))

    def estimated(coefficients: NDArray, trust: Trust) -> NDArray[np.float32]:
        g = g_ls.copy()
        single = coefficients.astype(np.float32)
        margins = np.array([margin, np.inf], np.float32)
        for_bands(g.shape[1], SAMPLE_BAND, lambda first, last: estimate_samples(
            u, d, h, usable, single, margins, options.rounds, trust > Trust.LEAST_SQUARES,
            trust == Trust.REFLECTANCE, g, first, last))
        return g

    g_first = estimated(lambertian, Trust.REJECTION)
    coefficients, g = lambertian, g_first
    exact = [a.astype(np.float64) for a in (u, d, h)]
    for _ in range(ROUNDS):
        present, c = g.astype(np.float64), coefficients
        parts = for_bands(g.shape[1], SAMPLE_BAND, lambda first, last, present=present, c=c:    # type: ignore[misc]
                          reflectance.normal_equations(
            exact[0], exact[1], exact[2], usable, present, c, LEAST_COSINE, LEAST_RATIO,
            MOST_RATIO, HUBER, first, last))
        information, right = (sum(part[i] for part in parts) for i in (0, 1))
        coefficients = reflectance.improved(coefficients, information, right)
        g = estimated(coefficients, Trust.REFLECTANCE)
    misfit = {
        Trust.LEAST_SQUARES: _misfit(u, d, h, g_ls, lambertian),
        Trust.REJECTION: _misfit(u, d, h, g_first, lambertian),
        Trust.REFLECTANCE: _misfit(u, d, h, g, coefficients)}
    level = {trust: float(np.quantile(values, QUANTILE)) for trust, values in misfit.items()}
    middle = {trust: float(np.median(values)) for trust, values in misfit.items()}
    if options.trust is not None:
        trust = options.trust
    elif problem.count >= MANY:
        fits = level[Trust.REFLECTANCE] <= level[Trust.REJECTION]
        trust = Trust.REFLECTANCE if fits else Trust.REJECTION
    elif (middle[Trust.LEAST_SQUARES] > NOT_LAMBERTIAN
          or level[Trust.REJECTION] > NOT_EXPLAINED):
        trust = Trust.LEAST_SQUARES
    elif alone:
        trust = Trust.REJECTION       # a matt part: a reflectance would be fitted to the noise
    else:      # dropping frames always lowers the misfit of few; that alone must not count
        trust = max(choice for choice in Trust if level[choice] <= level[Trust.LEAST_SQUARES])
        if level[trust] > FAR_WORSE * level[Trust.REJECTION]:
            trust = Trust.REJECTION   # the reflectance did not come out
    hold = 0.0
    if problem.count >= MANY:
        low, high = DOUBTFUL
        hold = float(np.clip((middle[trust] - low) / (high - low), 0, 1))
    return Plan(coefficients, trust, max(level[trust] * (4 / problem.count) ** 0.5, 1e-4), hold,
                margin, shared)


def _misfit(u: NDArray, d: NDArray, h: NDArray, g: NDArray, coefficients: NDArray) -> NDArray:
    """Relative differences between samples and prediction, (T, P), at most 1."""
    length = np.maximum(np.linalg.norm(g, axis=0), 1e-12)
    cosine = np.clip(np.einsum('ip,tip->tp', g, d) / length, 1e-3, 1)
    half = np.clip(np.einsum('ip,tip->tp', g, h) / length, reflectance.LEAST_HALF, 1)
    predicted = length * cosine * reflectance.departures(coefficients, cosine, half)
    level = np.maximum(np.mean(u, axis=0), 1e-12)
    return np.minimum(np.abs(u - predicted) / level, 1)


def _planes(grid: NDArray) -> NDArray[np.float32]:
    """Nodes (gh, gw, ...) as float32 planes (..., gh, gw)."""
    return np.ascontiguousarray(np.moveaxis(grid, (0, 1), (-2, -1)), np.float32)


def _spatial(options: StvOptions) -> NDArray[np.float32]:
    """Spatial weights of a patch, 1 at its centre."""
    offset = np.arange(options.patch) - options.patch // 2
    square = offset[:, None] ** 2 + offset[None] ** 2
    weights: NDArray[np.float32] = np.exp(-0.5 * square / options.spatial_sigma ** 2
                                          ).astype(np.float32)
    return weights


def _band_values(problem: Problem, top: int, bottom: int) -> tuple[NDArray, NDArray, NDArray]:
    """Normalised intensities of rows ``top`` to ``bottom``, before the flat field.

    :returns: channels (T, h, W, C) and grey (T, h, W), float32; saturated (T, h, W) or of size 0.
    """
    shape = (bottom - top, problem.shape[1], 3 if problem.colour else 1)
    channels = np.empty((problem.count, *shape), np.float32)
    limited = np.isfinite(problem.saturation)
    saturated = np.zeros((problem.count if limited else 0, *shape[:2]), np.bool_)
    dark = None if problem.ambient is None else problem.ambient[top:bottom].reshape(shape)
    for t, (frame, scale) in enumerate(zip(problem.frames, problem.scale, strict=True)):
        raw = frame[top:bottom].reshape(shape)
        if limited:
            saturated[t] = (raw >= problem.saturation).any(axis=-1)
        channels[t] = raw
        if dark is not None:
            channels[t] -= dark
        channels[t] *= scale.astype(np.float32)
    if np.isfinite(problem.clip):
        np.minimum(channels, np.float32(problem.clip), out=channels)
    grey = channels @ np.array(GREY_WEIGHTS, np.float32) if problem.colour else channels[..., 0]
    return channels, np.ascontiguousarray(grey), saturated
