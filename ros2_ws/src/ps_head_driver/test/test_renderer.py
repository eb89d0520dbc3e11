"""The renderer against analytic truths; nothing here uses light_model.py or a solver."""
import math

import cv2
import numpy as np
import pytest
from scipy.integrate import dblquad

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.fake.renderer import Sensor, corners, emitters, make_renderer
from ps_head_driver.fake.scenes import SCENES, Scene, make_scene
from ps_head_driver.fake.surface_renderer import MATT, SurfaceRenderer
from ps_head_driver.frames import slope_to_normal
from ps_head_driver.head_model import DIRECTIONS, load_head, nominal_head_path
from ps_head_driver.kinematics import BrightFieldKinematics, DarkFieldKinematics
from ps_head_driver.stack import angular_error_deg

HEAD = load_head(nominal_head_path())
TILT, DF_TILT = math.radians(30), 1.3
BRIGHT, DARK = BrightFieldKinematics(HEAD), DarkFieldKinematics(HEAD)
CLEAN = Sensor(bit_depth=16, noise=False)
ON = {'E': (1, 0, 0, 0), 'N': (0, 1, 0, 0), 'W': (0, 0, 1, 0), 'S': (0, 0, 0, 1)}


def grid_scene(height, albedo=0.8, pitch=5e-5, **gloss):
    """Scene of a height function over the nominal field of view."""
    x, y = np.meshgrid(np.arange(-640, 641) * pitch, np.arange(-540, 541) * pitch)
    return Scene('test', (-640 * pitch, -540 * pitch), pitch,
                 np.ascontiguousarray(height(x, y), float),
                 np.full(x.shape, albedo, np.float32), **gloss)


def seen_points(renderer):
    """Where the pixels look: x, y, z, each (H, W)."""
    return renderer._points[:3].reshape(3, *renderer.shape).astype(float)


def irradiance(pose, point):
    """Irradiance of a horizontal surface by adaptive integration over the panel."""
    up = np.cross(pose.axis, pose.right)

    def integrand(v, u):
        d = pose.center + u * pose.right + v * up - point
        r = np.linalg.norm(d)
        return (-(d @ pose.axis) / r) ** pose.lobe_exponent * d[2] / r ** 3

    width, height = pose.size
    return pose.intensity * dblquad(
        integrand, -width / 2, width / 2, -height / 2, height / 2, epsrel=1e-6)[0]


@pytest.fixture(scope='module')
def plate():
    return make_renderer('plate', HEAD, CLEAN, scale=0.05)


@pytest.mark.parametrize('direction', DIRECTIONS)
def test_plate_radiance_is_the_integral_over_the_panel(plate, direction):
    pose = BRIGHT.panel_pose(direction, TILT)
    radiance = plate.panel_radiance(pose)
    x, y, z = seen_points(plate)
    for row, column in ((0, 0), (25, 32), (50, 63), (10, 55)):
        point = np.array([x[row, column], y[row, column], z[row, column]])
        expected = 0.8 / math.pi * irradiance(pose, point)
        assert radiance[row, column] == pytest.approx(expected, rel=1e-4)


def test_narrow_lobe_is_the_integral_too(plate):
    pose = BRIGHT.panel_pose('N', TILT)
    narrow = type(pose)(pose.center, pose.axis, pose.right, pose.size, 3.5, 0.7)
    x, y, _ = seen_points(plate)
    expected = 0.8 / math.pi * irradiance(narrow, np.array([x[5, 5], y[5, 5], 0.0]))
    assert plate.panel_radiance(narrow)[5, 5] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(('ring', 'tilt'), [(BRIGHT, 0.0), (BRIGHT, TILT), (BRIGHT, 1.5),
                                            (DARK, 1.1), (DARK, 1.5)])
def test_sampling_error_of_the_light_vector(ring, tilt):
    """The emitters that the camera sums against many more, over the field of view."""
    def vector(pose, point, count):
        samples, _ = emitters(pose, count, gauss=count == MATT)
        d = samples[:3].T - point
        r = np.linalg.norm(d, axis=1, keepdims=True)
        cosine = np.maximum(-(d @ pose.axis)[:, None] / r, 0)
        return np.sum(cosine * d / r ** 3 * samples[3, :, None], axis=0)

    worst = 0.0
    for direction in DIRECTIONS:
        pose = ring.panel_pose(direction, tilt)
        for point in ((0, 0, 0), (0.025, 0.02, 0), (-0.025, 0.02, 0.002), (0.025, -0.02, -0.002)):
            coarse, dense = (vector(pose, np.array(point), n) for n in (MATT, (120, 60)))
            worst = max(worst, float(angular_error_deg(coarse, dense)))
            assert np.linalg.norm(coarse) == pytest.approx(np.linalg.norm(dense), rel=1e-3)
    assert worst < 0.01


def test_right_side_is_brighter(plate):
    images = {d: plate.render(TILT, DF_TILT, ON[d]).astype(int) for d in DIRECTIONS}
    assert images['E'][25, 60] > 1.3 * images['E'][25, 3]
    assert images['W'][25, 3] > 1.3 * images['W'][25, 60]
    assert images['N'][2, 32] > 1.2 * images['N'][48, 32]       # row 0 is at the top
    assert images['S'][48, 32] > 1.2 * images['S'][2, 32]


def test_tilted_plate_faces_the_lower_side():
    renderer = make_renderer('tilted_plate', HEAD, CLEAN, scale=0.05, tilt_x=0.1, tilt_y=-0.05)
    centre = {d: int(renderer.render(TILT, DF_TILT, ON[d])[25, 32]) for d in DIRECTIONS}
    assert centre['W'] > 1.1 * centre['E']      # rises along +x, so it looks to -x
    assert centre['N'] > 1.05 * centre['S']     # falls along +y, so it looks to +y
    normal = renderer.truth().normal
    slope = np.array([math.tan(0.1), math.tan(-0.05)])
    assert angular_error_deg(normal, slope_to_normal(slope)).max() < 1e-4


def test_cast_shadow_of_a_step_has_the_penumbra_of_the_panel():
    pitch, step, drop = 5e-5, -0.002, 0.004
    renderer = SurfaceRenderer(
        grid_scene(lambda x, y: np.where(x >= step - 1e-9, 0.0, -drop)), HEAD, CLEAN, scale=0.5)
    edge = step + pitch     # where the spline has reached the upper level
    flat = SurfaceRenderer(grid_scene(lambda x, y: np.full_like(x, -drop)), HEAD, CLEAN, scale=0.5)
    pose = BRIGHT.panel_pose('E', TILT)
    row = renderer.shape[0] // 2
    x, y, z = (values[row] for values in seen_points(renderer))
    low = (z < -drop + 1e-6) & (x < edge - 1e-4)
    measured = (renderer.panel_radiance(pose)[row] / flat.panel_radiance(pose)[row])[low]
    positions = emitters(pose, (60, 60), gauss=False)[0][:3].T
    expected = []
    for point in np.stack([x, y, z], axis=-1)[low]:
        d = positions - point
        over_edge = point[2] + d[:, 2] * (edge - point[0]) / d[:, 0]
        r = np.linalg.norm(d, axis=1)
        light = -(d @ pose.axis) * d[:, 2] / r ** 4
        expected.append(light[over_edge > 0].sum() / light.sum())
    expected = np.array(expected)
    assert ((expected > 0.05) & (expected < 0.95)).sum() > 5     # the penumbra is resolved
    assert np.abs(measured - expected).max() < 0.03
    half = [np.interp(0.5, v[::-1], x[low][::-1]) for v in (measured, expected)]
    assert half[0] == pytest.approx(half[1], abs=4e-5)          # half a pixel of this picture


def test_no_shadow_on_the_lit_side_of_a_step():
    renderer, flat = (SurfaceRenderer(grid_scene(height), HEAD, CLEAN, scale=0.1) for height in (
        lambda x, y: np.where(x >= 0, 0.0, -0.004), lambda x, y: np.full_like(x, -0.004)))
    pose = BRIGHT.panel_pose('W', TILT)
    x, _, z = seen_points(renderer)
    low = (z < -0.004 + 1e-6) & (x < -5e-4)
    assert low.sum() > 1000
    np.testing.assert_allclose(renderer.panel_radiance(pose)[low],
                               flat.panel_radiance(pose)[low], rtol=1e-3)


@pytest.mark.parametrize(('ring', 'tilt'), [(BRIGHT, TILT), (DARK, DF_TILT)])
def test_attached_shadow(ring, tilt):
    renderer = make_renderer('dome', HEAD, CLEAN, scale=0.2, radius=0.008, height=0.007)
    points = np.stack(seen_points(renderer), axis=-1)
    normal = renderer.truth().normal
    for direction in DIRECTIONS:
        pose = ring.panel_pose(direction, tilt)
        facing = np.stack([np.sum(normal * (corner - points), axis=-1)
                           for corner in corners(pose)])
        radiance = renderer.panel_radiance(pose)
        turned_away = (facing < 0).all(axis=0)
        assert turned_away.sum() > 20
        assert (radiance[turned_away] == 0).all()
        # the convex top casts no shadow on itself
        top = (points[..., 2] > 0.0005) & (facing > 0.004).all(axis=0)
        assert top.sum() > 200
        assert (radiance[top] > 0).all()


def test_dome_truth_is_the_sphere():
    radius, height = 0.015, 0.003
    renderer = make_renderer('dome', HEAD, CLEAN, scale=0.25, radius=radius, height=height)
    sphere = (radius ** 2 + height ** 2) / (2 * height)
    x, y, z = seen_points(renderer)
    truth = renderer.truth()
    inside = np.hypot(x, y) < radius - 2e-4
    expected = np.stack([x, y, z + sphere - height], axis=-1) / sphere
    assert angular_error_deg(truth.normal, expected)[inside].max() < 0.01
    exact = np.sqrt(sphere ** 2 - (x ** 2 + y ** 2)[inside]) - (sphere - height)
    assert np.abs(truth.height[inside] - exact).max() < 1e-7
    assert np.abs(truth.height[np.hypot(x, y) > radius + 2e-4]).max() < 1e-9


def test_boss_is_as_high_and_as_steep_as_asked():
    scene = make_scene('boss', height='0.001')      # as text, like from a parameter
    x = np.linspace(0, 0.006, 3001)
    z, p, _ = scene.surface(x, np.zeros_like(x))
    assert z[0] == pytest.approx(0.001, rel=5e-4)
    assert abs(z[-1]) < 1e-9
    assert math.degrees(math.atan(-p.min())) == pytest.approx(20, abs=0.02)


@pytest.mark.parametrize(('ra', 'correlation'), [(0.8e-6, 2e-4), (12.5e-6, 4e-4)])
def test_specimen_has_the_roughness_and_correlation_asked_for(ra, correlation):
    scene = make_scene('roughness', ra=ra, correlation=correlation)
    step = 2.5e-5
    x, y = np.meshgrid(np.arange(-800, 800) * step, np.arange(-600, 600, 8) * step)
    z = scene.surface(x, y)[0]
    assert np.abs(z - z.mean()).mean() == pytest.approx(ra, rel=0.03)
    lag = round(correlation / step)
    z -= z.mean()
    assert (z[:, :-lag] * z[:, lag:]).mean() / (z ** 2).mean() == pytest.approx(
        math.exp(-1), abs=0.05)


def test_scratches_have_three_depths_in_four_directions():
    scene = make_scene('scratches', depth=1e-5)
    columns = (np.arange(4) - 1.5) * 0.011
    for row, depth in ((0.012, 5e-6), (0.0, 1e-5), (-0.012, 2e-5)):
        bottom = scene.surface(columns, np.full(4, row))[0]
        np.testing.assert_allclose(bottom, -depth, rtol=0.15)     # the spline rounds it


@pytest.mark.parametrize('name', [name for name in SCENES if name != 'ring'])
def test_normals_of_every_scene_are_the_slopes_of_its_height(name):
    scene = make_scene(name)
    random = np.random.default_rng(3)
    x, y = random.uniform(-0.02, 0.02, (2, 20_000))
    _, p, q = scene.surface(x, y)
    h = 1e-7
    for slope, dx, dy in ((p, h, 0.0), (q, 0.0, h)):
        above, below = scene.surface(x + dx, y + dy)[0], scene.surface(x - dx, y - dy)[0]
        difference = (above - below) / (2 * h)
        np.testing.assert_allclose(slope, difference, atol=1e-4 * max(np.abs(slope).max(), 1e-6))


def test_pixels_look_along_the_rays_of_a_distorted_lens():
    camera = HEAD.camera.model_copy(update={
        'distortion': (-0.2, 0.05, 8e-4, -6e-4, 0.01), 'cx': 600.0, 'cy': 530.0})
    head = HEAD.model_copy(update={'camera': camera})
    renderer = make_renderer('dome', head, CLEAN, scale=0.1)
    points = np.stack(seen_points(renderer), axis=-1).reshape(-1, 3)
    optical = points * [1, -1, -1] + [0, 0, camera.camera_standoff]
    small = renderer.camera
    matrix = np.array([[small.fx, 0, small.cx], [0, small.fy, small.cy], [0, 0, 1]])
    pixels = cv2.projectPoints(optical, np.zeros(3), np.zeros(3), matrix,
                               np.array(small.distortion))[0].reshape(*renderer.shape, 2)
    v, u = np.mgrid[:renderer.shape[0], :renderer.shape[1]]
    assert np.abs(pixels - np.stack([u, v], axis=-1)).max() < 1e-3
    z = renderer.scene.surface(points[:, 0], points[:, 1])[0]
    assert np.abs(z - points[:, 2]).max() < 1e-8


def test_panels_add_up_and_the_cache_changes_nothing(plate):
    fresh = make_renderer('plate', HEAD, CLEAN, scale=0.05)
    single = [plate.radiance(TILT, DF_TILT, ON[d]) for d in DIRECTIONS]
    both = plate.radiance(TILT, DF_TILT, (1, 1, 1, 1), (0, 0.5, 0, 0))
    assert np.array_equal(both, fresh.radiance(TILT, DF_TILT, (1, 1, 1, 1), (0, 0.5, 0, 0)))
    dark_field = plate.radiance(TILT, DF_TILT, (0, 0, 0, 0), (0, 1, 0, 0))
    np.testing.assert_allclose(both, sum(single) + 0.5 * dark_field, rtol=1e-5)
    assert not np.array_equal(single[0], plate.radiance(TILT + 1e-3, DF_TILT, ON['E']))


def test_cache_is_limited():
    renderer = make_renderer('plate', HEAD, CLEAN, scale=0.05)
    renderer._cache_bytes = 3 * renderer.panel_radiance(BRIGHT.panel_pose('E', 0.1)).nbytes
    for i in range(8):
        renderer.panel_radiance(BRIGHT.panel_pose('E', 0.2 + 0.1 * i))
    assert len(renderer._cache) == 3


def test_head_tolerances_show(plate):
    panels = dict(HEAD.bright_field.panels)
    panels['E'] = panels['E'].model_copy(update={'shift': (0.0, 0.02, 0.0), 'intensity': 1.1})
    bright = HEAD.bright_field.model_copy(update={'panels': panels})
    other = SurfaceRenderer(plate.scene, HEAD.model_copy(update={'bright_field': bright}), CLEAN,
                            0.05)
    ratio = other.radiance(TILT, DF_TILT, ON['E']) / plate.radiance(TILT, DF_TILT, ON['E'])
    assert ratio[0].mean() > 1.1 > ratio[-1].mean()       # it moved along +y: up in the picture
    np.testing.assert_array_equal(other.radiance(TILT, DF_TILT, ON['W']),
                                  plate.radiance(TILT, DF_TILT, ON['W']))


def test_gloss_mirrors_the_panel():
    """A plate that bisects the angle between camera and panel shows a highlight, matt or not."""
    centre = BRIGHT.panel_pose('E', TILT).center
    slope = -math.tan(math.atan2(centre[0], centre[2]) / 2)
    renderers = [SurfaceRenderer(grid_scene(lambda x, y: slope * x, specular=s, roughness=0.15),
                                 HEAD, CLEAN, scale=0.05) for s in (0.0, 0.05)]
    for direction, mirrors in (('E', True), ('W', False), ('N', False)):
        matt, glossy = (r.radiance(TILT, DF_TILT, ON[direction])[25, 32] for r in renderers)
        assert glossy >= matt
        assert (glossy > 1.5 * matt) == mirrors


# ---------------------------------------------------------------------------- sensor

@pytest.mark.parametrize('level', [0.1, 0.4, 0.8])
def test_noise_is_shot_and_read_noise(level):
    sensor = Sensor(bit_depth=16, full_well=8000.0, read_noise=12.0)
    image = sensor.expose(np.full((300, 300), level, np.float32), 0.0, np.random.default_rng(2))
    electrons = image / 65535 * 8000.0
    assert electrons.mean() == pytest.approx(level * 8000.0, rel=1e-3)
    assert electrons.std() == pytest.approx(math.sqrt(level * 8000.0 + 144.0), rel=0.02)


def test_noise_repeats_with_the_seed_and_differs_between_frames():
    def frame(seed, number):
        return make_renderer('plate', HEAD, Sensor(), 0.05, seed).render(
            TILT, DF_TILT, ON['E'], frame=number)

    assert np.array_equal(frame(5, 3), frame(5, 3))
    assert not np.array_equal(frame(5, 3), frame(5, 4))
    assert not np.array_equal(frame(5, 3), frame(6, 3))


def test_levels_of_the_default_exposure(plate):
    image = make_renderer('plate', HEAD, Sensor(noise=False), 0.05).render(
        TILT, DF_TILT, ON['E'])
    assert image.dtype == np.uint8
    assert 0.58 < image[25, 32] / 255 < 0.62
    assert image.max() < 250
    wide = plate.render(TILT, DF_TILT, ON['E'])
    assert wide.dtype == np.uint16
    assert wide[25, 32] / 65535 == pytest.approx(image[25, 32] / 255, abs=1 / 255)


def test_exposure_strobe_gain_and_saturation(plate):
    def centre(**settings):
        return plate.render(TILT, DF_TILT, ON['E'], **settings)[25, 32]

    full = float(centre())
    assert centre(exposure=0.002) == pytest.approx(full / 2, rel=1e-3)
    assert centre(exposure=0.004, strobe=0.001) == pytest.approx(full / 4, rel=1e-3)
    assert centre(exposure=0.001, strobe=0.004) == pytest.approx(full / 4, rel=1e-3)
    assert centre(exposure=0.001, gain=6.0206) == pytest.approx(full / 2, rel=1e-3)
    assert centre(exposure=0.1) == 65535
    assert plate.render(TILT, DF_TILT, (0, 0, 0, 0)).max() == 0


def test_ambient_light_and_vignetting(plate):
    room = SurfaceRenderer(plate.scene, HEAD, Sensor(16, noise=False, ambient=0.1), 0.05)
    dark = room.render(TILT, DF_TILT, (0, 0, 0, 0), exposure=0.008, strobe=0.001)
    assert dark[25, 32] == pytest.approx(0.8 * 0.1 * 2 * 65535, rel=1e-3)
    lens = SurfaceRenderer(plate.scene, HEAD, Sensor(16, noise=False, vignetting=0.3), 0.05)
    ratio = lens.render(TILT, DF_TILT, ON['E']) / plate.render(TILT, DF_TILT, ON['E'])
    assert ratio[0, 0] == pytest.approx(0.7, abs=0.01)
    assert ratio[25, 32] == pytest.approx(1.0, abs=0.01)


# ---------------------------------------------------------------------------- wrong requests

def test_wrong_scenes_are_refused_by_name():
    with pytest.raises(PsError, match=r'plate, glossy_plate, .*copper, ring') as unknown:
        make_scene('moon')
    assert unknown.value.code == ErrorCode.SEQUENCER_BAD_REQUEST
    with pytest.raises(PsError, match=r"'colour'.*radius, height"):
        make_scene('dome', colour=3)
    with pytest.raises(PsError, match='height=tall is not a float'):
        make_scene('boss', height='tall')
    with pytest.raises(PsError, match='grid pitches, 150 um'):
        make_scene('roughness', correlation=1e-4)
    with pytest.raises(PsError, match='albedo and specular'):
        make_scene('plate', albedo=1.5)
    with pytest.raises(PsError, match=r'roughness of 0\.1 to 1'):
        make_scene('glossy_plate', roughness=0.01)
    with pytest.raises(PsError, match="'height' is not of the form name=value"):
        make_renderer('boss:height', HEAD)
    with pytest.raises(PsError, match=r"'bent'.*no_wall, turned_over"):
        make_renderer('ring:defect=bent', HEAD)
    with pytest.raises(PsError, match='smaller than the field of view'):
        SurfaceRenderer(make_scene('plate', size=(0.03, 0.03)), HEAD)
    with pytest.raises(ValueError, match='bit_depth'):
        Sensor(bit_depth=12)
