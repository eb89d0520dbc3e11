"""Robust regression: against its oracle, its objective, and scenes with known normals."""
import dataclasses

import numpy as np
from numpy.typing import NDArray
import pytest

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.stack import angular_error_deg
from ps_reconstruction import least_squares, reflectance, stv, stv_oracle
from ps_reconstruction.problem import (
    FEW_LIGHTS,
    HIGHLIGHT,
    MASKED,
    SATURATED,
    SHADOW,
    Problem,
    constant_lights,
    expand,
)
from ps_reconstruction.stv import Plan, StvOptions, Trust


def lights_of(count: int, slant: float = 30.0) -> NDArray:
    """Unit vectors to lights on two rings (one ring for four)."""
    azimuth = 2 * np.pi * np.arange(count) / count
    slants = np.radians(slant + (15 * (np.arange(count) % 2) if count > 4 else np.zeros(count)))
    return np.stack([np.sin(slants) * np.cos(azimuth), np.sin(slants) * np.sin(azimuth),
                     np.cos(slants)], axis=-1)


def sphere(size: int = 64, limit: float = 0.8) -> tuple[NDArray, NDArray]:
    """Normals (size, size, 3) and mask of a sphere, up to sin(slope) = limit."""
    y, x = np.mgrid[1:-1:size * 1j, -1:1:size * 1j]
    mask = x * x + y * y < limit ** 2
    return np.stack([x, y, np.sqrt(np.clip(1 - x * x - y * y, 0.01, 1))], axis=-1), mask


def render(normal: NDArray, mask: NDArray, lights: NDArray, gloss: float = 0.0,
           noise: float = 0.0, albedo: float = 0.5) -> Problem:
    """Float pictures with attached shadows and, added, a lobe of the half-vector."""
    half = half_vectors(lights)
    cosine = np.clip(normal @ lights.T, 0, None)
    peak = np.clip(normal @ half.T, 0, 1) ** 60 * (cosine > 0)
    value = albedo * cosine + gloss * peak
    value += noise * np.random.default_rng(1).normal(size=value.shape)
    grid, step = constant_lights(lights, mask.shape)
    frames = [np.ascontiguousarray(value[..., t], np.float32) for t in range(len(lights))]
    return Problem(frames, grid, step, np.ones((len(lights), 1)), mask=mask)


def half_vectors(lights: NDArray) -> NDArray:
    half = lights + np.array([0.0, 0.0, 1.0])
    unit: NDArray = half / np.linalg.norm(half, axis=1, keepdims=True)
    return unit


def errors(solution: NDArray, normal: NDArray, mask: NDArray) -> NDArray:
    return angular_error_deg(solution[mask], normal[mask])


@pytest.mark.parametrize('count', [3, 4, 6, 12])
def test_clean_lambertian_pictures_give_the_true_normals(count: int) -> None:
    normal, mask = sphere(limit=0.5)
    problem = render(normal, mask, lights_of(count))
    solution = stv.solve(problem)
    assert errors(solution.normal, normal, mask).max() < 0.5
    assert np.median(errors(solution.normal, normal, mask)) < 0.02
    np.testing.assert_allclose(solution.albedo[mask], 0.5, rtol=0.01)


@pytest.mark.parametrize('count', [4, 12])
def test_agrees_with_the_oracle(count: int) -> None:
    normal, mask = sphere(24)
    problem = render(normal, mask, lights_of(count), gloss=0.5, noise=0.002)
    decided = stv.plan(problem)
    g = stv_oracle.solve(problem, decided=decided)
    solution = stv.solve(problem)
    deviation = errors(solution.normal, g / np.linalg.norm(g, axis=-1, keepdims=True), mask)
    assert np.nanmedian(deviation) < 0.1
    fast, plain = (np.nanmean(errors(n, normal, mask)) for n in (
        solution.normal, g / np.linalg.norm(g, axis=-1, keepdims=True)))
    assert fast < plain + 0.1


@pytest.mark.parametrize('trust', list(Trust))
def test_without_patches_equals_the_oracle_pixel_by_pixel(trust: Trust) -> None:
    normal, mask = sphere(16)
    problem = render(normal, mask, lights_of(4), gloss=0.3)
    options = StvOptions(patch=1, ridge=0.0, trust=trust)
    decided = stv.plan(problem, options)
    assert decided.trust == trust
    solution = stv.solve(problem, options)
    g = stv_oracle.solve(problem, options, decided)
    deviation = errors(solution.normal, g / np.linalg.norm(g, axis=-1, keepdims=True), mask)
    assert np.nanpercentile(deviation, 95) < 0.2


def test_what_noise_explains_is_no_highlight_here_nor_in_the_oracle() -> None:
    normal, mask = sphere(64, limit=0.6)
    problem = render(normal, mask, lights_of(4), noise=0.01)
    options = StvOptions(patch=1, ridge=0.0)
    decided = stv.plan(problem, options)
    assert decided.trust == Trust.REJECTION
    # relative to |g| = 0.5; LS leaves a quarter of the variance of four lights in the residuals
    sigma = 0.01 / 0.5 / 2
    assert 1.5 * sigma < decided.margin < 3.3 * sigma
    solution, plain = stv.solve(problem, options), least_squares.solve(problem)
    g = stv_oracle.solve(problem, options, decided)
    np.testing.assert_allclose(scaled(solution)[mask], g[mask], atol=1e-4)
    same = errors(solution.normal, plain.normal.astype(float), mask) < 0.01
    assert same.mean() > 0.98
    eager = stv.solve(problem, options, decided=dataclasses.replace(decided, margin=0.0))
    assert (errors(eager.normal, plain.normal.astype(float), mask) < 0.01).mean() < 0.6


def test_gloss_below_the_noise_of_a_pixel_is_found_in_neighbours() -> None:
    normal, mask = sphere(64, limit=0.6)
    problem = render(normal, mask, lights_of(4), gloss=0.05, noise=0.01)
    options = StvOptions(patch=1, ridge=0.0, trust=Trust.REJECTION)
    decided = stv.plan(problem, options)
    assert decided.shared_margin < 0.5 * decided.margin
    alone = dataclasses.replace(decided, shared_margin=float('inf'))
    together, single, plain = (errors(solution.normal, normal, mask).mean() for solution in (
        stv.solve(problem, options, decided=decided), stv.solve(problem, options, decided=alone),
        least_squares.solve(problem)))
    assert together < single < plain
    g = stv_oracle.solve(problem, options, decided)
    same = np.abs(scaled(stv.solve(problem, options, decided=decided)) - g)[mask].max(axis=-1)
    assert (same < 1e-4).mean() > 0.99


def test_the_solution_lowers_the_objective_of_equation_6() -> None:
    """Huber loss over the believed frames plus ridge, f s as light vectors: below that of LS."""
    normal, mask = sphere(24, limit=0.6)
    lights = lights_of(12)
    problem = render(normal, mask, lights, gloss=0.6, noise=0.004)
    options = StvOptions(patch=1, trust=Trust.REFLECTANCE, rounds=6)
    decided = stv.plan(problem, options)
    g_ls, g = scaled(least_squares.solve(problem)), scaled(stv.solve(problem, options))
    value = np.stack(problem.frames, axis=-1).astype(float)
    lower = 0
    places = np.argwhere(mask)[::5]
    for y, x in places:
        _, keep, factor = stv_oracle.pixel(
            value[y, x], lights, half_vectors(lights), np.ones(12, bool), g_ls[y, x], decided,
            options.rounds)
        effective = (factor[:, None] * lights)[keep]
        delta = stv_oracle.HUBER * np.linalg.norm(g[y, x])
        strength = options.ridge * np.trace(effective.T @ effective) / 3
        objective = []
        for candidate in (g[y, x], g_ls[y, x]):
            size = np.abs(value[y, x][keep] - effective @ candidate)
            loss = np.where(size < delta, size ** 2 / 2, delta * (size - delta / 2))
            objective.append(loss.sum() + strength * np.sum((candidate - g_ls[y, x]) ** 2))
        assert objective[0] <= objective[1] + 1e-6
        lower += objective[0] < 0.9 * objective[1]
    assert lower > 0.3 * len(places)


def scaled(solution: least_squares.Solution) -> NDArray:
    g: NDArray = solution.normal.astype(float) * solution.albedo[..., None]
    return g


@pytest.mark.parametrize('count', [4, 12, 48])
def test_a_glossy_sphere_is_better_than_least_squares(count: int) -> None:
    normal, mask = sphere(96, limit=0.9)
    problem = render(normal, mask, lights_of(count), gloss=0.4, noise=0.002)
    robust = errors(stv.solve(problem).normal, normal, mask)
    plain = errors(least_squares.solve(problem).normal, normal, mask)
    assert np.nanmean(robust) < 0.6 * np.nanmean(plain)
    assert np.nanpercentile(robust, 90) < 0.6 * np.nanpercentile(plain, 90)


def test_single_wrong_frames_are_rejected_and_named() -> None:
    normal, mask = sphere(48, limit=0.4)
    problem = render(normal, mask, lights_of(12))
    problem.frames[3][20:24, 20:24] = 0.0        # a cast shadow
    problem.frames[7][28:31, 20:24] += 1.0       # a highlight
    solution = stv.solve(problem, StvOptions(patch=1))
    assert solution.reason is not None
    assert errors(solution.normal, normal, mask).max() < 0.5
    assert (solution.reason[20:24, 20:24] & SHADOW).all()
    assert (solution.reason[28:31, 20:24] & HIGHLIGHT).all()
    assert not solution.reason[24, 30]
    assert (solution.reason[~mask] == MASKED).all()


def test_saturated_frames_do_not_count() -> None:
    normal, mask = sphere(48, limit=0.4)
    problem = render(normal, mask, lights_of(6), albedo=1.0)
    level = 0.9
    clipped = dataclasses.replace(
        problem, frames=[np.minimum(f, level) for f in problem.frames], saturation=level)
    solution = stv.solve(clipped, StvOptions(patch=1, trust=Trust.REJECTION))
    assert solution.reason is not None
    assert (solution.reason & SATURATED).any()
    left = np.sum([f < level for f in clipped.frames], axis=0)
    assert errors(solution.normal, normal, mask & (left >= 4)).max() < 0.5


def test_fewer_than_three_frames_left_are_named() -> None:
    normal, mask = sphere(32, limit=0.4)
    problem = render(normal, mask, lights_of(4))
    for frame in problem.frames[:2]:
        frame[12:16, 12:16] = 2.0
    solution = stv.solve(dataclasses.replace(problem, saturation=2.0),
                         StvOptions(trust=Trust.REJECTION))
    assert solution.reason is not None
    assert (solution.reason[12:16, 12:16] == FEW_LIGHTS | SATURATED).all()
    assert not (solution.reason[20:, 20:][mask[20:, 20:]] & FEW_LIGHTS).any()


def test_ambient_light_is_subtracted() -> None:
    normal, mask = sphere(48)
    clean = render(normal, mask, lights_of(4), gloss=0.4)
    room = (0.2 * np.random.default_rng(0).random(mask.shape)).astype(np.float32)
    lit = dataclasses.replace(clean, frames=[f + room for f in clean.frames], ambient=room)
    np.testing.assert_allclose(stv.solve(lit).normal, stv.solve(clean).normal, atol=2e-3)


def test_near_field_lights_and_flat_field_are_interpolated() -> None:
    normal, mask = sphere(40, limit=0.5)
    grid = np.broadcast_to(lights_of(4), (6, 6, 4, 3)).copy()
    grid[..., 0] += 0.02 * np.arange(6)[None, :, None]
    flat = 1 + 0.1 * np.random.default_rng(0).random((6, 6, 4))
    light = expand(grid, 8, mask.shape)
    value = 0.6 * np.einsum('hwi,hwti->hwt', normal, light) / expand(flat, 8, mask.shape)
    problem = Problem([np.ascontiguousarray(value[..., t], np.float32) for t in range(4)], grid, 8,
                      np.ones((4, 1)), mask=mask, reciprocal_flat=flat)
    assert errors(stv.solve(problem).normal, normal, mask).max() < 0.5


@pytest.mark.parametrize('dtype', [np.uint8, np.uint16])
def test_integer_colour_pictures_give_colour_albedo(dtype: type) -> None:
    normal, mask = sphere(48, limit=0.4)
    full = float(np.iinfo(dtype).max)
    tint = np.array([0.8, 0.5, 0.3])
    grey = render(normal, mask, lights_of(5), albedo=1.0)
    frames = [np.round(f[..., None] * tint * full).astype(dtype) for f in grey.frames]
    problem = dataclasses.replace(grey, frames=frames, scale=np.full((5, 3), 1 / full))
    solution = stv.solve(problem)
    assert errors(solution.normal, normal, mask).mean() < 0.5
    np.testing.assert_allclose(np.median(solution.albedo[mask], axis=0), tint, rtol=0.01)


def test_metal_like_surfaces_with_few_lights_keep_least_squares() -> None:
    """Four lights cannot separate a pure lobe from the body: trust least squares."""
    normal, mask = sphere(64)
    problem = render(normal, mask, lights_of(4), gloss=1.0, albedo=0.02)
    assert stv.plan(problem).trust == Trust.LEAST_SQUARES
    np.testing.assert_allclose(stv.solve(problem).normal, least_squares.solve(problem).normal,
                               atol=1e-3)


@pytest.mark.parametrize('count', [4, 6, 10, 32])
@pytest.mark.parametrize(('albedo', 'gloss'), [(0.5, 0.0), (0.03, 0.3), (0.0, 1.0)])
def test_never_worse_than_least_squares(count: int, albedo: float, gloss: float) -> None:
    """Matt, black gloss, bare metal: neither the mean nor the tail of the error may grow."""
    normal, mask = sphere(64, limit=0.9)
    problem = render(normal, mask, lights_of(count), gloss=gloss, noise=0.002, albedo=albedo)
    robust, plain = (np.nan_to_num(errors(solver(problem).normal, normal, mask), nan=90.0)
                     for solver in (stv.solve, least_squares.solve))
    assert robust.mean() < plain.mean() + 0.05
    assert np.percentile(robust, 90) < np.percentile(plain, 90) + 0.05


def test_badly_explained_frames_pull_towards_least_squares() -> None:
    normal, mask = sphere(48)
    problem = render(normal, mask, lights_of(12), gloss=0.4)
    free, held = (stv.solve(problem, decided=Plan(np.zeros(reflectance.TERMS), Trust.REJECTION,
                                                  0.01, hold)).normal[mask] for hold in (0.0, 1.0))
    plain = least_squares.solve(problem).normal[mask]
    middle = free + plain
    middle /= np.linalg.norm(middle, axis=-1, keepdims=True)
    np.testing.assert_allclose(held, middle, atol=1e-3)


def test_the_confidence_predicts_the_error() -> None:
    normal, mask = sphere(96, limit=0.9)
    problem = render(normal, mask, lights_of(4), gloss=0.4, noise=0.003)
    solution = stv.solve(problem)
    assert solution.confidence is not None
    error = errors(solution.normal, normal, mask)
    certain = solution.confidence[mask] > np.median(solution.confidence[mask])
    assert np.nanmean(error[certain]) < 0.7 * np.nanmean(error[~certain])
    assert not solution.confidence[~mask].any()


def test_the_result_does_not_depend_on_the_number_of_cores(
        monkeypatch: pytest.MonkeyPatch) -> None:
    normal, mask = sphere(120, limit=0.9)
    problem = render(normal, mask, lights_of(4), gloss=0.4, noise=0.003)
    first = stv.solve(problem)
    monkeypatch.setenv('PS_THREADS', '1')
    second = stv.solve(problem)
    np.testing.assert_array_equal(first.normal, second.normal)
    np.testing.assert_array_equal(first.confidence, second.confidence)


def test_black_pictures_give_no_normals() -> None:
    normal, mask = sphere(32)
    problem = render(normal, mask, lights_of(4), albedo=0.0)
    solution = stv.solve(problem)
    assert np.isnan(solution.normal).all()
    assert solution.reason is not None
    assert (solution.reason[mask] & FEW_LIGHTS).all()


@pytest.mark.parametrize('wrong', [{'patch': 4}, {'patch': 17}, {'rounds': 0}, {'ridge': -1.0},
                                   {'spatial_sigma': 0.0}, {'edge_tolerance': 0.0}])
def test_wrong_parameters_are_refused(wrong: dict) -> None:
    with pytest.raises(PsError) as caught:
        StvOptions(**wrong)
    assert caught.value.code == ErrorCode.RECONSTRUCTION_BAD_PARAMETER


def test_the_compiled_reflectance_equals_the_plain_one() -> None:
    coefficients = np.linspace(-0.1, 0.2, reflectance.TERMS)
    x, h = np.random.default_rng(0).uniform(0.2, 1, (2, 50))
    plain = reflectance.departures(coefficients, x, h)
    basis = np.empty(reflectance.TERMS)
    for i in range(50):
        reflectance.fill_basis(x[i], h[i], basis)
        assert plain[i] == pytest.approx(1 + coefficients @ basis / x[i], rel=1e-6)
        compiled = reflectance.departure.py_func(coefficients.astype(np.float32),
                                                 np.float32(x[i]), np.float32(h[i]))
        assert compiled == pytest.approx(plain[i], rel=1e-4)


def test_a_rough_body_is_found_by_the_shared_reflectance() -> None:
    """Reflectance flatter than Lambert's law: the fit must recover it, and the normals."""
    normal, mask = sphere(64, limit=0.85)
    lights = lights_of(16)
    problem = render(normal, mask, lights)
    flatter = [np.ascontiguousarray(f * (1 + 0.4 * (1 - f / 0.5)), np.float32)
               for f in problem.frames]
    problem = dataclasses.replace(problem, frames=flatter)
    decided: Plan = stv.plan(problem)
    assert decided.trust == Trust.REFLECTANCE
    robust = errors(stv.solve(problem).normal, normal, mask).mean()
    assert robust < 0.4 * errors(least_squares.solve(problem).normal, normal, mask).mean()
