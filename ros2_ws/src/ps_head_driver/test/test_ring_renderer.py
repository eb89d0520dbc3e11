"""The scene of the calibration target: where it lies, what is wrong with it, its shadows."""
import math

import numpy as np
import pytest

from ps_head_driver.errors import PsError
from ps_head_driver.fake.renderer import OFF, Sensor, emitters, make_renderer
from ps_head_driver.fake.ring_renderer import RingSolid, _meets
from ps_head_driver.head_model import load_head, nominal_head_path

HEAD = load_head(nominal_head_path())
CLEAN = Sensor(bit_depth=16, noise=False)


def ring(arguments: str = ''):
    return make_renderer(f'ring:{arguments}', HEAD, CLEAN, scale=0.1)


def in_wall(x, y):
    """Whether the wall of the shipped target stands above points of its frame."""
    solid = RingSolid()
    radius, azimuth = np.hypot(x, y), np.arctan2(y, x)
    inside = (radius >= solid.radii[0]) & (radius <= solid.radii[1]) & (azimuth >= 0)
    for slit in solid.slits:
        along = np.cos(slit) * x + np.sin(slit) * y
        across = np.cos(slit) * y - np.sin(slit) * x
        inside &= (along < 0) | (np.abs(across) > solid.slit_width / 2)
    return inside


def test_ways_end_where_steps_along_them_enter_the_wall():
    solid = RingSolid()
    footprint = (*solid.radii, solid.height, solid.slit_width / 2)
    slits = np.stack([np.cos(solid.slits), np.sin(solid.slits)], axis=1)
    steps, met = np.linspace(0, 1, 4001), 0
    for start, way in np.random.default_rng(1).uniform(-0.02, 0.02, (5000, 2, 2)):
        found = _meets(*start, *way, footprint, (1.0, 0.0, -1.0, 0.0), slits)
        points = start[:, None] + way[:, None] * steps
        entered = steps[in_wall(*points)]
        if entered.size and found > 1:      # a corner, cut between two steps, is no hit
            assert entered.size <= 1
        elif found <= 1:
            met += 1
            assert in_wall(*(start + way * min(found + 1e-9, 1.0)))
            if entered.size:
                assert found == pytest.approx(entered[0], abs=2 / 4000)
    assert 1000 < met < 4000


@pytest.mark.parametrize(('panel', 'tilt'), [('bright', math.radians(30)), ('dark', 1.3)])
def test_soft_shadows_are_those_of_many_lamps(panel, tilt):
    """Against a thousand lamps over the panel, their light stepped through the solid."""
    renderer = ring()
    pose = getattr(renderer, f'_{panel}').panel_pose('E', tilt)
    lamps = emitters(pose, (40, 25), gauss=False)[0][:3].T
    points = renderer._points[:, :3]
    radiance = renderer.panel_radiance(pose).ravel() / renderer.albedo.ravel() * math.pi
    bare = ring('defect=no_wall')
    free = bare.panel_radiance(pose).ravel() / bare.albedo.ravel() * math.pi
    seen = radiance / free
    partly = np.flatnonzero((points[:, 2] == 0) & (seen > 0.03) & (seen < 0.97))
    assert partly.size > 200
    steps, errors = np.linspace(0, 1, 600), []
    for k in np.random.default_rng(2).choice(partly, 40, replace=False):
        way = lamps - points[k]
        distance = np.linalg.norm(way, axis=1)
        light = -(way @ pose.axis) * way[:, 2] / distance ** 4
        reach = 0.004 / way[:, 2]           # of the way to where it is above the wall
        x, y = (points[k, i] + (way[:, i] * reach)[:, None] * steps for i in (0, 1))
        passed = ~in_wall(x, y).any(axis=1)
        errors.append(seen[k] - (light * passed).sum() / light.sum())
    assert np.abs(errors).max() < 0.03
    assert np.abs(np.mean(errors)) < 0.003


def test_it_lies_where_it_is_put():
    moved = ring('x=0.004,turn=1.5708,z=-0.001')
    height = moved.truth().height
    row, column = np.nonzero(height > 0.0029)       # the crown of the wall
    camera = moved.camera
    reach = camera.camera_standoff - 0.003
    x = (column - camera.cx) / camera.fx * reach
    y = (camera.cy - row) / camera.fy * reach
    assert np.hypot(x - 0.004, y) == pytest.approx(0.011, abs=0.0013)
    assert x.max() < 0.0045         # turned by a quarter: the open side looks to +x
    assert height.min() == pytest.approx(-0.001)


def test_tilt_is_that_of_the_plane():
    normal = ring('tilt_x=0.02,tilt_y=-0.01').truth().normal[3, 3]
    assert normal[:2] / normal[2] == pytest.approx([-math.tan(0.02), math.tan(0.01)], abs=1e-6)


def test_defects_show():
    whole, no_wall, turned, blocked = (
        ring(f'defect={name}') for name in ('none', 'no_wall', 'turned_over', 'blocked_slit'))
    assert whole.truth().height.max() == pytest.approx(0.004)
    assert no_wall.truth().height.max() == 0
    assert no_wall.albedo.min() == pytest.approx(0.05)          # the dots are still there
    assert turned.albedo.min() == pytest.approx(0.8)            # on the back there are none
    more = (blocked.truth().height == np.float32(0.004)) & (whole.truth().height == 0)
    assert 0 < more.sum() < 30
    with pytest.raises(PsError, match='not a float'):
        ring('x=left')


def test_pictures_of_a_calibration():
    renderer = ring()
    pictures = renderer.capture(math.radians(30), 0.8)
    singles = np.sum([picture.astype(float) for picture in pictures[:4]], axis=0)
    assert pictures[4] * 4.0 == pytest.approx(singles, abs=5)   # ALL has a quarter exposure
    assert pictures[5].max() == 0
    # each panel's shadow lies on the side away from it, outside the ring or in its hollow
    camera, shape = renderer.camera, renderer.shape
    v, u = np.mgrid[:shape[0], :shape[1]]
    x = (u - camera.cx) / camera.fx * camera.camera_standoff
    y = (camera.cy - v) / camera.fy * camera.camera_standoff
    hollow = np.hypot(x, y) < 0.0085
    share = [picture / np.maximum(singles, 1) for picture in pictures[:4]]
    west, east = hollow & (x < -0.006) & (y > 0.002), hollow & (x > 0.006) & (y > 0.002)
    assert share[0][east].mean() < 0.8 * share[0][west].mean()
    assert share[2][west].mean() < 0.8 * share[2][east].mean()


def test_long_shadows_of_the_dark_field_do_not_end_on_the_way():
    east = (1.0, 0.0, 0.0, 0.0)
    lit, bare = (ring(arguments).radiance(0.5, 1.3, OFF, east)
                 for arguments in ('', 'defect=no_wall'))
    seen = lit / bare
    camera = ring().camera
    pitch = camera.camera_standoff / camera.fx
    row = round(camera.cy - 0.0045 / pitch)         # behind the wall, between two slits
    columns = np.round(camera.cx - np.array([0.0165, 0.0200, 0.0235, 0.0248]) / pitch).astype(int)
    behind = seen[row, columns]
    assert behind.max() < 0.5
