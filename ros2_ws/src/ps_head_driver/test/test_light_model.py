"""Light vectors against brute-force integration over the panel, and their interpolation."""
from dataclasses import replace

from heads import NOMINAL
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from ps_head_driver.camera_model import plane_points
from ps_head_driver.errors import PsError
from ps_head_driver.kinematics import lights_at
from ps_head_driver.light_model import as_distant, light_grid, light_vectors
from ps_head_driver.stack import Light, Plane, angular_error_deg

LIGHTS = lights_at(NOMINAL, 19000, 1.3)


def integrated(light: Light, point: np.ndarray, exponent: float = 1.0, n: int = 300) -> np.ndarray:
    """Vector irradiance by summing n x n pieces of the panel, in the words of radiometry."""
    up = np.cross(light.axis, light.right)
    steps = (np.arange(n) + 0.5) / n - 0.5
    a, b = np.meshgrid(steps * light.size[0], steps * light.size[1])
    pieces = np.array(light.position) + a[..., None] * np.array(light.right) + b[..., None] * up
    to_light = pieces - point
    distance = np.linalg.norm(to_light, axis=-1, keepdims=True)
    cosine = -(to_light @ np.array(light.axis))[..., None] / distance
    area = light.size[0] * light.size[1] / n**2
    return (cosine**exponent * to_light / distance**3 * area).sum(axis=(0, 1)) * light.intensity


inside = st.tuples(st.floats(-0.025, 0.025), st.floats(-0.02, 0.02), st.floats(-2e-3, 5e-3))


@settings(max_examples=15, deadline=None)
@given(inside, st.sampled_from(range(8)))
def test_lambert_panel_equals_integration(point, index):
    light = replace(LIGHTS[index], intensity=0.9)
    expected = integrated(light, np.array(point))
    np.testing.assert_allclose(light_vectors(light, point), expected,
                               rtol=2e-4, atol=1e-5 * np.linalg.norm(expected))


@settings(max_examples=8, deadline=None)
@given(inside, st.sampled_from([0.0, 2.0, 5.0]))
def test_other_lobes_equal_integration(point, exponent):
    light = replace(LIGHTS[1], lobe_exponent=exponent)
    expected = integrated(light, np.array(point), exponent)
    got = light_vectors(light, point)
    assert angular_error_deg(got, expected) < 0.05
    assert np.linalg.norm(got) == pytest.approx(np.linalg.norm(expected), rel=3e-3)


def test_vectors_point_to_the_light_and_vanish_behind_the_panel():
    for light in LIGHTS:
        towards = np.array(light.position) - [0, 0, 0]
        assert light_vectors(light, [0.0, 0.0, 0.0]) @ towards > 0
        behind = np.array(light.position) - 0.05 * np.array(light.axis)
        np.testing.assert_array_equal(light_vectors(light, behind), 0)


def test_distant_light_is_the_same_everywhere():
    light = Light(distant=True, axis=(0.6, 0.0, -0.8), intensity=2.0)
    np.testing.assert_allclose(light_vectors(light, np.zeros((3, 4, 3))),
                               np.broadcast_to([-1.2, 0, 1.6], (3, 4, 3)))


def test_as_distant_agrees_at_its_point_only():
    near = LIGHTS[0]
    far = as_distant(near)
    np.testing.assert_allclose(light_vectors(far, [0.0, 0, 0]), light_vectors(near, [0.0, 0, 0]))
    corner = np.array([0.025, 0.02, 0.0])
    assert angular_error_deg(light_vectors(far, corner), light_vectors(near, corner)) > 5
    with pytest.raises(PsError, match='faces away'):
        as_distant(replace(near, axis=(0.0, 0.0, 1.0)))


def test_interpolation_error_of_both_rings_over_the_field_of_view():
    rng = np.random.default_rng(0)
    shape = (1024, 1280)
    grid = light_grid(LIGHTS, NOMINAL.camera, shape)
    rows, columns = rng.uniform(0, 1023, 3000), rng.uniform(0, 1279, 3000)
    points = plane_points(NOMINAL.camera, np.stack([columns, rows], axis=-1), Plane())
    exact = np.stack([light_vectors(light, points) for light in LIGHTS], axis=1)
    interpolated = grid.at(rows, columns)
    assert angular_error_deg(interpolated, exact).max() < 0.01
    lengths = np.linalg.norm(interpolated, axis=-1) / np.linalg.norm(exact, axis=-1)
    assert np.abs(lengths - 1).max() < 1e-4
    # the edges of the picture are nodes
    np.testing.assert_allclose(grid.at(1023, 1279), grid.vectors[-1, -1])


def test_relief_moves_the_points_of_the_grid():
    shape = (64, 80)
    raised = light_grid(LIGHTS[:1], NOMINAL.camera, shape, height=np.full(shape, 2e-3))
    flat = light_grid(LIGHTS[:1], NOMINAL.camera, shape)
    assert np.linalg.norm(raised.vectors) > np.linalg.norm(flat.vectors)    # nearer to the panel


def test_near_light_without_camera_is_refused():
    with pytest.raises(PsError, match='camera intrinsics'):
        light_grid(LIGHTS[:1], None, (10, 10))
