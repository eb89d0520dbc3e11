"""The camera: pixels to rays and points and back, with distortion, on tilted planes and relief."""
from heads import NOMINAL
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from ps_head_driver.camera_model import (
    camera_center,
    pixel_grid,
    pixel_rays,
    plane_points,
    project,
    scaled_camera,
)
from ps_head_driver.head_model import CameraGeometry
from ps_head_driver.stack import Plane

small = st.floats(-0.2, 0.2)
cameras = st.builds(
    lambda fx, fy, cx, cy, k1, k2, p1, p2: CameraGeometry(
        width_px=1280, height_px=1024, fx=fx, fy=fy, cx=cx, cy=cy, camera_standoff=0.3,
        distortion=(k1, k2, p1 / 50, p2 / 50, 0.0)),
    st.floats(2000, 9000), st.floats(2000, 9000), st.floats(500, 800), st.floats(400, 600),
    small, small, small, small)
pixels = st.tuples(st.floats(0, 1279), st.floats(0, 1023))


@given(cameras, pixels, st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(-5e-3, 5e-3))
def test_pixel_to_surface_and_back(camera, pixel, tilt_x, tilt_y, height):
    normal = np.array([tilt_x, tilt_y, 1.0]) / np.sqrt(1 + tilt_x**2 + tilt_y**2)
    plane = Plane(tuple(normal), 1e-3)
    point = plane_points(camera, pixel, plane, height)
    np.testing.assert_allclose(project(camera, point), pixel, atol=1e-6)
    # the point is the plane's, lifted along z
    assert (point - [0, 0, height]) @ normal == pytest.approx(1e-3, abs=1e-12)


def test_axes_of_the_nominal_camera():
    """The picture's right is x, its upper edge is y: 50 x 40 mm around the optical axis."""
    camera = NOMINAL.camera
    right_top = plane_points(camera, (1279.5, -0.5), Plane())
    np.testing.assert_allclose(right_top, [0.025, 0.020, 0.0], atol=1e-9)
    np.testing.assert_allclose(plane_points(camera, (639.5, 511.5), Plane()), 0, atol=1e-12)
    np.testing.assert_array_equal(camera_center(camera), [0, 0, 0.3])
    assert np.all(pixel_rays(camera, [(0, 0), (5, 7)])[:, 2] == -1)


def test_scaled_camera_sees_the_same_field():
    half = scaled_camera(NOMINAL.camera, 640, 512)
    for corner, corner_half in (((-0.5, -0.5), (-0.5, -0.5)), ((1279.5, 1023.5), (639.5, 511.5))):
        np.testing.assert_allclose(plane_points(NOMINAL.camera, corner, Plane()),
                                   plane_points(half, corner_half, Plane()), atol=1e-12)


@given(st.integers(1, 3000), st.integers(1, 3000), st.floats(1, 500))
def test_grid_reaches_both_edges(height, width, step):
    rows, columns = pixel_grid((height, width), step)
    for nodes, count in ((rows, height), (columns, width)):
        assert len(nodes) >= 2
        assert nodes[0] == 0
        assert nodes[-1] == count - 1
        assert np.all(np.diff(nodes) <= step + 1e-9)
