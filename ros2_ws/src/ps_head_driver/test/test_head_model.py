"""Head files: the nominal one is read as written, a wrong one is refused with file and field."""
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
import yaml

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.frames import (
    normal_to_slope,
    optical_to_plane,
    plane_to_optical,
    slope_to_normal,
)
from ps_head_driver.head_model import load_head, nominal_head_path
from ps_head_driver.stack import angular_error_deg


def nominal() -> dict:
    return yaml.safe_load(nominal_head_path().read_text())


def write(folder: Path, data: object) -> Path:
    path = folder / 'head.yaml'
    path.write_text(yaml.safe_dump(data))
    return path


def test_nominal_head_is_what_the_file_says():
    head = load_head(nominal_head_path())
    data = nominal()
    assert head.camera.camera_standoff == data['camera']['camera_standoff']
    assert list(head.bright_field.panel_size) == data['bright_field']['panel_size']
    assert [p.azimuth for p in head.dark_field.panels.values()] == pytest.approx(
        [0, np.pi / 2, np.pi, 3 * np.pi / 2])


@pytest.mark.parametrize(('path', 'value', 'field'), [
    (('camera', 'fx'), -1.0, 'camera.fx'),
    (('camera', 'camera_standoff'), 'far', 'camera.camera_standoff'),
    (('bright_field', 'rod_length'), float('nan'), 'bright_field.rod_length'),
    (('bright_field', 'slider', 'direction'), 2, 'bright_field.slider.direction'),
    (('bright_field', 'slider', 'limits_counts'), [5, 5], 'limits_counts'),
    (('dark_field', 'tilt_range'), [1.5, 1.1], 'tilt_range'),
    (('bright_field', 'colour'), 'red', 'bright_field.colour'),
])
def test_wrong_value_is_named(tmp_path, path, value, field):
    data = nominal()
    section = data
    for key in path[:-1]:
        section = section[key]
    section[path[-1]] = value
    with pytest.raises(PsError) as error:
        load_head(write(tmp_path, data))
    assert error.value.code == ErrorCode.HEAD_BAD_REQUEST
    assert 'head.yaml' in error.value.message
    assert field in error.value.message
    assert '\n' not in error.value.message


@pytest.mark.parametrize('content', ['', '- 1\n- 2\n', 'a: [', '\x00\x01', 'name: x\n'])
def test_no_head_file_at_all_is_one_line(tmp_path, content):
    path = tmp_path / 'head.yaml'
    path.write_text(content)
    with pytest.raises(PsError, match=r'head\.yaml') as error:
        load_head(path)
    assert '\n' not in error.value.message


def test_missing_file_is_named(tmp_path):
    with pytest.raises(PsError, match=r'nothing\.yaml: No such file'):
        load_head(tmp_path / 'nothing.yaml')


def test_panel_missing_is_named(tmp_path):
    data = nominal()
    del data['bright_field']['panels']['W']
    with pytest.raises(PsError, match='W missing'):
        load_head(write(tmp_path, data))


# a subnormal slope rounds to a normal without a sign: 5e-324 / 2.2 is 0
slopes = st.floats(-20, 20, allow_subnormal=False)


@given(slopes, slopes)
def test_slope_and_normal_are_inverse_and_signed(p, q):
    slope = np.array([p, q])
    normal = slope_to_normal(slope)
    assert np.linalg.norm(normal) == pytest.approx(1)
    assert normal[2] > 0
    assert np.sign(normal[0]) == -np.sign(p)      # rising to the right faces left
    np.testing.assert_allclose(normal_to_slope(normal), slope, atol=1e-9)
    optical = plane_to_optical(normal)
    assert optical[2] < 0                          # visible: against the viewing direction
    np.testing.assert_array_equal(optical_to_plane(optical), normal)


@given(st.floats(1e-6, 3.1))
def test_angular_error_is_precise_also_for_small_angles(angle):
    turned = np.array([np.sin(angle), 0, np.cos(angle)])
    assert angular_error_deg(turned, np.array([0, 0, 1.0])) == pytest.approx(
        np.degrees(angle), rel=1e-9)
