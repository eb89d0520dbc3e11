from dataclasses import replace

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from ps_head_driver.errors import ErrorCode, PsError
from ps_reconstruction.least_squares import check_lights, solve, solve_reference
from ps_reconstruction.problem import (
    GREY_WEIGHTS,
    SATURATED,
    SHADOW,
    Problem,
    constant_lights,
    expand,
    grid_size,
)


def ring_lights(count: int, slant: float = 0.7) -> np.ndarray:
    azimuth = np.arange(count) * 2 * np.pi / count
    return np.stack([np.sin(slant) * np.cos(azimuth), np.sin(slant) * np.sin(azimuth),
                     np.full(count, np.cos(slant))], axis=-1)


def smooth_problem(shape: tuple[int, int], count: int, step: int, seed: int) -> Problem:
    """Lights that change by a few per cent over the picture; frames of noise."""
    rng = np.random.default_rng(seed)
    gh, gw = grid_size(shape, step)
    y, x = np.meshgrid(np.arange(gh) / gh, np.arange(gw) / gw, indexing='ij')
    drift = 0.02 * rng.standard_normal((2, 1, 1, count, 3))
    lights = ring_lights(count) + drift[0] * x[..., None, None] + drift[1] * y[..., None, None]
    frames = [rng.integers(20, 250, shape, np.uint8) for _ in range(count)]
    return Problem(frames, lights, step, np.full((count, 1), 1 / 255))


@settings(max_examples=15, deadline=None)
@given(height=st.integers(2, 40), width=st.integers(2, 90), count=st.integers(3, 9),
       step=st.integers(2, 50), seed=st.integers(0, 99))
def test_kernel_equals_reference(height: int, width: int, count: int, step: int,
                                 seed: int) -> None:
    problem = smooth_problem((height, width), count, step, seed)
    kernel, reference = solve(problem), solve_reference(problem)
    # the kernel interpolates the pseudo-inverse, the reference the lights
    np.testing.assert_allclose(kernel.normal, reference.normal, atol=2e-3)
    np.testing.assert_allclose(kernel.albedo, reference.albedo, rtol=2e-3, atol=1e-4)


@pytest.mark.parametrize('dtype', [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize('count', [3, 4, 5, 8])
def test_exact_normals_from_exact_pictures(dtype: type, count: int) -> None:
    rng = np.random.default_rng(1)
    normal = rng.uniform(-0.4, 0.4, (30, 40, 3)) + np.array([0, 0, 1])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    albedo = rng.uniform(0.3, 0.9, (30, 40))
    lights = ring_lights(count)
    full = {np.uint8: 255, np.uint16: 65535, np.float32: 1}[dtype]
    values = np.moveaxis(albedo[..., None] * (normal @ lights.T), -1, 0) * full
    frames = [np.rint(v).astype(dtype) if full > 1 else v.astype(dtype) for v in values]
    grid, step = constant_lights(lights, (30, 40))
    found = solve(Problem(frames, grid, step, np.full((count, 1), 1 / full)))
    tolerance = {np.uint8: 0.02, np.uint16: 1e-4, np.float32: 1e-5}[dtype]
    np.testing.assert_allclose(found.normal, normal, atol=tolerance)
    np.testing.assert_allclose(found.albedo, albedo, atol=tolerance)


def test_ambient_flat_scale_and_mask_are_undone() -> None:
    rng = np.random.default_rng(2)
    normal = rng.normal(0, 0.2, (25, 31, 3)) + np.array([0, 0, 1])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    lights = ring_lights(4)
    grid, _ = constant_lights(lights, (25, 31))
    step = 8
    gh, gw = grid_size((25, 31), step)
    grid = np.broadcast_to(lights, (gh, gw, 4, 3)).copy()
    gain = 1 + 0.1 * rng.random((gh, gw, 4))
    exposure = np.array([1.0, 0.5, 0.8, 0.25])
    ambient = rng.uniform(0, 0.2, (25, 31)).astype(np.float32)
    clean = normal @ lights.T / expand(1 / gain, step, (25, 31))
    frames = [(clean[..., t] * exposure[t] + ambient).astype(np.float32) for t in range(4)]
    mask = rng.random((25, 31)) > 0.3
    problem = Problem(frames, grid, step, 1 / exposure[:, None], reciprocal_flat=1 / gain,
                      ambient=ambient, mask=mask)
    for found in (solve(problem), solve_reference(problem)):
        np.testing.assert_allclose(found.normal[mask], normal[mask], atol=1e-3)
        assert np.isnan(found.normal[~mask]).all()
        assert np.isnan(found.albedo[~mask]).all()
    assert not solve(problem).confidence[~mask].any()    # type: ignore[index]


def test_colour_albedo() -> None:
    rng = np.random.default_rng(3)
    normal = rng.normal(0, 0.1, (20, 24, 3)) + np.array([0, 0, 1])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    colour = rng.uniform(0.2, 0.9, (20, 24, 3))
    tint = rng.uniform(0.5, 2.0, (5, 3))
    lights = ring_lights(5)
    frames = [(colour * (normal @ s)[..., None] * k).astype(np.float32)
              for s, k in zip(lights, tint, strict=True)]
    grid, step = constant_lights(lights, (20, 24))
    problem = Problem(frames, grid, step, 1 / tint, clip=1.0)
    found = solve(problem)
    np.testing.assert_allclose(found.normal, normal, atol=1e-5)
    np.testing.assert_allclose(found.albedo, colour, atol=1e-5)
    np.testing.assert_allclose(solve_reference(problem).albedo, colour @ GREY_WEIGHTS, atol=1e-5)


def test_shadow_and_saturation_lower_the_confidence() -> None:
    lights = ring_lights(4)
    frames = [np.full((8, 8), 180, np.uint8) for _ in lights]
    frames[0][2, 3] = 255
    frames[1][5, 5] = 0
    grid, step = constant_lights(lights, (8, 8))
    found = solve(Problem(frames, grid, step, np.full((4, 1), 1 / 255), saturation=250))
    assert found.confidence is not None
    assert found.reason is not None
    assert found.reason[2, 3] == SATURATED
    assert found.reason[5, 5] == SHADOW
    assert found.confidence[0, 0] == 255
    assert found.confidence[2, 3] < 150
    assert found.confidence[5, 5] < 150


def test_residual_is_that_of_the_redundant_equation() -> None:
    lights = ring_lights(4)
    frames = [np.full((6, 6), v, np.float32) for v in (0.6, 0.5, 0.6, 0.5)]
    grid, step = constant_lights(lights, (6, 6))
    found = solve(Problem(frames, grid, step, np.ones((4, 1))))
    # E + W - N - S = 0.2 over the four: residual 0.05 each, sqrt(4 * 0.05^2 / (4 - 3)) = 0.1
    assert found.residual_rms == pytest.approx(0.1 / 0.55, rel=1e-4)


def test_degenerate_lights_are_refused() -> None:
    frames = [np.full((6, 6), 90, np.uint8)] * 3
    flat = np.array([[0.7, 0, 0.7], [-0.7, 0, 0.7], [0, 0, 1.0]])
    for lights in (flat, np.eye(3) * 1e-170):
        grid, step = constant_lights(lights, (6, 6))
        with pytest.raises(PsError, match='condition number') as caught:
            solve(Problem(frames, grid, step, np.ones((3, 1))))
        assert caught.value.code == ErrorCode.RECONSTRUCTION_DEGENERATE_LIGHTS
    grid, step = constant_lights(flat[:2], (6, 6))
    with pytest.raises(PsError) as caught:
        solve(Problem(frames[:2], grid, step, np.ones((2, 1))))
    assert caught.value.code == ErrorCode.RECONSTRUCTION_TOO_FEW_LIGHTS


def test_same_bits_on_any_number_of_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = smooth_problem((70, 90), 5, 16, 7)
    first = solve(problem)
    monkeypatch.setenv('PS_THREADS', '1')
    second = solve(problem)
    assert np.array_equal(first.normal, second.normal, equal_nan=True)
    assert np.array_equal(first.albedo, second.albedo, equal_nan=True)
    assert first.residual_rms == second.residual_rms


def test_scaling_the_pictures_scales_the_albedo_only() -> None:
    problem = smooth_problem((20, 30), 4, 10, 5)
    first, second = solve(problem), solve(replace(problem, scale=problem.scale * 3))
    np.testing.assert_allclose(first.normal, second.normal, atol=1e-6)
    np.testing.assert_allclose(first.albedo * 3, second.albedo, rtol=1e-5)


def test_lights_too_strong_to_compute_with_are_refused():
    with pytest.raises(PsError, match='too long') as error:
        check_lights(np.eye(3)[None] * 1e200)
    assert error.value.code == ErrorCode.RECONSTRUCTION_BAD_STACK
