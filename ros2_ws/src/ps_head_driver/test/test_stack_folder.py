"""Stack folders: round trips, real folders, and refusal of broken ones with file and field."""
from dataclasses import replace
import os
from pathlib import Path

import cv2
from heads import NOMINAL
import numpy as np
import pytest
import yaml

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.kinematics import lights_at
from ps_head_driver.stack import Geometry, Light, Panel, Plane, Stack, Truth, angular_error_deg
from ps_head_driver.stack_folder import read_stack, select_lights, write_stack

DATA = Path(os.environ.get('PS_DATA', Path(__file__).resolve().parents[5] / 'shared' / 'data'))
RNG = np.random.default_rng(5)


def a_stack(dtype=np.uint8, channels=0, **changes) -> Stack:
    shape = (12, 16, channels) if channels else (12, 16)
    lights = [replace(light, name=f'my {light.name}', exposure_scale=0.5)
              for light in lights_at(NOMINAL, 25000, 1.3)[:4]]
    images = [(RNG.random(shape) * (255 if dtype == np.uint8 else 60000)).astype(dtype)
              for _ in lights]
    camera = NOMINAL.camera.model_copy(update={'width_px': 16, 'height_px': 12})
    stack = Stack(images=images, lights=lights, camera=camera, ambient=images[0] // 9,
                  mask=RNG.random((12, 16)) > 0.3, plane=Plane((0.0, 0.6, 0.8), 1e-3),
                  gain_maps=[np.maximum(RNG.random((6, 8)), 0.01).astype(np.float32)
                             for _ in lights],
                  geometry=Geometry.CALIBRATED, stack_id='s', part_id='p', calibration_id='c',
                  flat_id='f', convergence_radius=0.06)
    return replace(stack, **changes)


def same(a: Stack, b: Stack) -> None:
    assert [light.name for light in a.lights] == [light.name for light in b.lights]
    for x, y in zip(a.lights, b.lights, strict=True):
        assert x == replace(y, strobe_duration=x.strobe_duration)
    for x, y in zip(a.images, b.images, strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_array_equal(x, y)
    for name in ('ambient', 'mask'):
        x, y = getattr(a, name), getattr(b, name)
        assert (x is None) == (y is None)
        if x is not None:
            np.testing.assert_array_equal(x, y)
    peak = max((gain.max() for gain in a.gain_maps), default=1)
    for x, y in zip(a.gain_maps, b.gain_maps, strict=True):
        np.testing.assert_allclose(x / peak, y, rtol=1e-6)
    for name in ('camera', 'plane', 'geometry', 'stack_id', 'part_id', 'calibration_id', 'flat_id',
                 'convergence_radius'):
        assert getattr(a, name) == getattr(b, name), name


@pytest.mark.parametrize('dtype', [np.uint8, np.uint16])
@pytest.mark.parametrize('channels', [0, 3])
def test_round_trip(tmp_path, dtype, channels):
    stack = a_stack(dtype, channels)
    normal = RNG.normal(size=(12, 16, 3)).astype(np.float32)
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    height = RNG.random((12, 16)).astype(np.float32)
    write_stack(stack, tmp_path / 'stack', Truth(normal, height))
    again, truth = read_stack(tmp_path / 'stack')
    same(stack, again)
    assert np.nanmax(angular_error_deg(truth.normal, normal)) < 1e-4
    np.testing.assert_array_equal(truth.height, height)
    assert sorted(p.name for p in tmp_path.iterdir()) == ['stack']


def test_lights_that_are_no_equation_stay_frames(tmp_path):
    stack = a_stack(ambient=None, gain_maps=[])
    lights = [*stack.lights[:2], replace(stack.lights[2], panel=Panel.ALL),
              Light(name='dark', panel=Panel.NONE)]
    write_stack(replace(stack, lights=lights), tmp_path / 'stack')
    again, _ = read_stack(tmp_path / 'stack')
    assert [light.panel for light in again.lights] == [Panel.E, Panel.N, Panel.ALL, Panel.NONE]
    assert len(again.equations().images) == 2


def test_nothing_is_written_over(tmp_path):
    (tmp_path / 'stack').mkdir()
    (tmp_path / 'stack' / 'mine.txt').write_text('keep')
    with pytest.raises(PsError, match='is there already'):
        write_stack(a_stack(), tmp_path / 'stack')
    assert [p.name for p in tmp_path.rglob('*')] == ['stack', 'mine.txt']


@pytest.fixture
def folder(tmp_path):
    write_stack(a_stack(), tmp_path / 'stack')
    return tmp_path / 'stack'


def edit(folder, change):
    path = folder / 'lights.yaml'
    content = yaml.safe_load(path.read_text())
    change(content)
    path.write_text(yaml.safe_dump(content))


def refused(folder, words):
    with pytest.raises(PsError, match=words) as error:
        read_stack(folder)
    assert error.value.code == ErrorCode.RECONSTRUCTION_BAD_STACK
    assert '\n' not in error.value.message


@pytest.mark.parametrize(('change', 'words'), [
    (lambda c: c['frames'][1].update(panel='NE'), r'lights\.yaml: frames\.1\.panel'),
    (lambda c: c['frames'][1].update(axis=[0, 0, -2]), r'frames\.1.*axis: not a unit'),
    (lambda c: c['frames'][1].update(position=[0, float('nan'), 0]), r'frames\.1\.position'),
    (lambda c: c['frames'][1].pop('axis'), 'axis: a single-panel frame needs it'),
    (lambda c: c['frames'][1].update(colour=1), r'frames\.1\.colour'),
    (lambda c: c['frames'][1].update(intensity=0), r'frames\.1\.intensity'),
    (lambda c: c['frames'][1].update(file='nothing.png'), r'nothing\.png: no such picture'),
    (lambda c: c['frames'][1].update(file='../../etc/passwd'), 'leaves the folder'),
    (lambda c: c['frames'][1].update(file='/etc/passwd'), 'leaves the folder'),
    (lambda c: c['camera'].update(fx=0), r'camera\.fx'),
    (lambda c: c.update(frames=[]), 'frames'),
])
def test_wrong_lights_yaml_is_refused_with_the_field(folder, change, words):
    edit(folder, change)
    refused(folder, words)


def test_link_out_of_the_folder_is_refused(folder, tmp_path):
    (tmp_path / 'secret.png').write_bytes((folder / '000.png').read_bytes())
    (folder / '000.png').unlink()
    (folder / '000.png').symlink_to(tmp_path / 'secret.png')
    refused(folder, 'leaves the folder')


def test_broken_and_odd_pictures_are_named(folder):
    (folder / '001.png').write_bytes(b'no picture')
    refused(folder, r'001\.png: cannot be read')
    cv2.imwrite(str(folder / '001.png'), np.zeros((3, 3), np.uint8))
    refused(folder, r'001 is \(3, 3\)')
    (folder / '001.png').write_bytes(b'')
    refused(folder, r'001\.png: cannot be read')


def test_missing_flat_picture_is_named(folder):
    (folder / 'flat' / '002.tif').unlink()
    refused(folder, r'no flat-field picture 002')


def distant(folder, lines=('0 0 1', '0 0.6 0.8', '0.6 0 0.8')):
    folder.mkdir()
    for i in range(3):
        cv2.imwrite(str(folder / f'{i}.png'), np.full((4, 5), 40 * i + 10, np.uint8))
    (folder / 'filenames.txt').write_text('0.png\n1.png\n2.png\n')
    (folder / 'light_directions.txt').write_text('\n'.join(lines))
    return folder


def test_benchmark_layout(tmp_path):
    folder = distant(tmp_path / 'x')
    (folder / 'light_intensities.txt').write_text('1 2 3\n1 1 1\n2 2 2\n')
    stack, truth = read_stack(folder)
    assert truth is None
    assert stack.camera is None
    assert stack.lights[2].axis == pytest.approx((-0.6, 0, -0.8))
    assert stack.lights[0].intensity == (1, 2, 3)
    assert [light.name for light in select_lights(stack, '3,1', folder).lights] == ['2', '0']


@pytest.mark.parametrize(('file', 'content', 'words'), [
    ('light_directions.txt', '0 0 1\n', '1 lines of 3 numbers, expected 3'),
    ('light_directions.txt', '0 0 1\n0 0 2\n1 0 0\n', 'line 2 is not a unit'),
    ('light_directions.txt', 'a b c\n', 'not a table'),
    ('light_intensities.txt', '1\n1\n-1\n', 'must be positive'),
    ('light_intensities.txt', '1\n1\nnan\n', 'finite'),
    ('filenames.txt', '\n', 'empty'),
    ('filenames.txt', '../0.png\n1.png\n2.png\n', 'leaves the folder'),
    ('Normal_gt.mat', 'x', 'Normal_gt'),
    ('height_gt.npz', 'x', 'height'),
])
def test_wrong_benchmark_files_are_refused(tmp_path, file, content, words):
    folder = distant(tmp_path / 'x')
    (folder / file).write_text(content)
    refused(folder, words)


@pytest.mark.parametrize(('selection', 'words'), [
    ('0', 'from 1 to 3'), ('4', 'from 1 to 3'), ('1,1', 'different'), ('five', 'subsets.json')])
def test_wrong_selection_is_refused(tmp_path, selection, words):
    folder = distant(tmp_path / 'x')
    stack, _ = read_stack(folder)
    with pytest.raises(PsError, match=words):
        select_lights(stack, selection, folder)


def test_four_plain_pictures(tmp_path):
    for ending, value in (('000', 10), ('090', 20), ('180', 30), ('270', 40)):
        cv2.imwrite(str(tmp_path / f'part_{ending}.png'), np.full((4, 6), value, np.uint8))
        cv2.imwrite(str(tmp_path / f'flat_{ending}.png'), np.full((4, 6), 2 * value, np.uint8))
    cv2.imwrite(str(tmp_path / 'part_all.png'), np.zeros((4, 6), np.uint8))
    stack, _ = read_stack(tmp_path, slant=np.radians(30))
    got = {light.panel: int(image[0, 0]) for light, image in zip(
        stack.lights, stack.images, strict=True)}
    assert got == {Panel.S: 10, Panel.E: 20, Panel.N: 30, Panel.W: 40}
    towards_light = {light.panel: -np.array(light.axis) for light in stack.lights}
    np.testing.assert_allclose(towards_light[Panel.E], [0.5, 0, np.sqrt(0.75)], atol=1e-12)
    np.testing.assert_allclose(towards_light[Panel.N], [0, 0.5, np.sqrt(0.75)], atol=1e-12)
    assert stack.geometry is Geometry.ASSUMED
    assert [float(gain[0, 0]) for gain in stack.gain_maps] == [0.5, 0.75, 1.0, 0.25]
    cv2.imwrite(str(tmp_path / 'other_090.png'), np.zeros((4, 6), np.uint8))
    refused(tmp_path, r'ends in 090, found other_090\.png, part_090\.png')


def test_empty_and_missing_folders_say_what_is_wanted(tmp_path):
    refused(tmp_path, 'lights.yaml, no filenames.txt and no four')
    refused(tmp_path / 'no', 'no such folder')


@pytest.mark.skipif(not DATA.is_dir(), reason=f'no DiLiGenT data at {DATA}; set PS_DATA')
def test_real_benchmark_folder():
    folder = DATA / 'diligent' / 'ballPNG'
    stack, truth = read_stack(folder)
    assert len(stack.images) == 96
    assert stack.images[0].dtype == np.uint16
    assert truth is not None
    assert np.isfinite(truth.normal[stack.mask]).all()
    four = select_lights(stack, 'four', folder)
    assert [light.name for light in four.lights] == ['076', '056', '028', '049']
