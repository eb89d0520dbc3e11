"""Stack folders: round trips, real folders, and refusal of broken ones with file and field."""
from dataclasses import replace
import os
from pathlib import Path
import shutil
import tempfile
import warnings

import cv2
from heads import NOMINAL
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
import yaml

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.kinematics import lights_at
from ps_head_driver.stack import (
    Geometry,
    Light,
    Mode,
    Panel,
    Plane,
    Stack,
    Truth,
    angular_error_deg,
)
from ps_head_driver.stack_folder import read_lights, read_stack, select_lights, write_stack

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
    # gain maps are relative: to their common maximum
    peaks = [max((gain.max() for gain in stack.gain_maps), default=1) for stack in (a, b)]
    for x, y in zip(a.gain_maps, b.gain_maps, strict=True):
        np.testing.assert_allclose(x / peaks[0], y / peaks[1], rtol=1e-6)
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


UNIT = st.floats(-1, 1).flatmap(lambda z: st.floats(0, 2 * np.pi).map(lambda a: (
    float(np.cos(a) * np.sqrt(1 - z * z)), float(np.sin(a) * np.sqrt(1 - z * z)), z)))
POSITIVE = st.floats(1e-6, 1e6)


@st.composite
def any_light(draw):
    """A light of any kind; right stands at a right angle to axis."""
    axis = np.array(draw(UNIT))
    right = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    right /= np.linalg.norm(right)
    point = st.tuples(*[st.floats(-1, 1)] * 3)
    return Light(
        panel=draw(st.sampled_from(Panel)), mode=draw(st.sampled_from(Mode)),
        position=draw(point), axis=tuple(axis.tolist()), right=tuple(right.tolist()),
        size=draw(st.tuples(st.floats(0, 1), st.floats(0, 1))), lobe_exponent=draw(POSITIVE),
        intensity=draw(POSITIVE | st.tuples(POSITIVE, POSITIVE, POSITIVE)),
        distant=draw(st.booleans()), motor_counts=draw(st.integers(-2**31, 2**31 - 1)),
        tilt=draw(st.floats(-2, 2)), exposure_scale=draw(POSITIVE),
        name=draw(st.text(st.characters(exclude_categories=['Cs']), min_size=1, max_size=8)))


@settings(max_examples=40, deadline=None)
@given(lights=st.lists(any_light(), min_size=1, max_size=4), seed=st.integers(0, 99),
       dtype=st.sampled_from([np.uint8, np.uint16, np.float32]), channels=st.sampled_from([0, 3]),
       with_flat=st.booleans())
def test_any_stack_is_read_as_it_was_written(lights, seed, dtype, channels, with_flat):
    rng = np.random.default_rng(seed)
    images = [(200 * rng.random((3, 5, 3) if channels else (3, 5))).astype(dtype) for _ in lights]
    gains = [rng.uniform(0.1, 1, (2, 3)).astype(np.float32) for _ in lights]
    stack = Stack(images=images, lights=lights, gain_maps=gains if with_flat else [],
                  flat_id='f', convergence_radius=0.06)
    with tempfile.TemporaryDirectory() as folder:
        write_stack(stack, folder)
        again, _ = read_stack(folder)
    same(replace(stack.equations(), lights=[], images=[]),
         replace(again.equations(), lights=[], images=[]))
    same(replace(stack, gain_maps=[]), replace(again, gain_maps=[]))


def test_distant_lights_stay_equations_of_no_panel(tmp_path):
    stack = a_stack()
    lights = [replace(light, panel=Panel.NONE, distant=True) for light in stack.lights]
    write_stack(replace(stack, lights=lights), tmp_path / 'stack')
    again, _ = read_stack(tmp_path / 'stack')
    same(replace(stack, lights=lights), again)
    assert len(again.equations().images) == 4


@pytest.mark.parametrize(('changes', 'words'), [
    ({'lights': a_stack().lights[:3]}, '4 pictures, but 3 lights and 4 gain maps'),
    ({'gain_maps': a_stack().gain_maps[:1]}, '4 pictures, but 4 lights and 1 gain maps'),
    ({'images': [], 'lights': [], 'gain_maps': []}, 'no pictures'),
    ({'images': [*a_stack().images[:3], np.zeros((3, 3), np.uint8)]}, r'picture 3 is \(3, 3\)'),
    ({'mask': np.ones((3, 3), bool)}, r'mask is \(3, 3\)'),
    ({'plane': Plane((0.0, 0.0, 2.0))}, r'stack/lights\.yaml: plane.*not a unit'),
    ({'gain_maps': [np.full((2, 2), np.nan, np.float32)] * 4}, r'stack/flat/000\.tif'),
    ({'gain_maps': [np.ones((2, 2, 2), np.float32)] * 4}, r'shape \(2, 2, 2\)'),
])
def test_a_stack_that_could_not_be_read_is_not_written(tmp_path, changes, words):
    with pytest.raises(PsError, match=words) as error:
        write_stack(a_stack(**changes), tmp_path / 'stack')
    assert error.value.code == ErrorCode.RECONSTRUCTION_BAD_STACK
    assert list(tmp_path.iterdir()) == []


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
    (lambda c: c['frames'][1].pop('axis'), 'axis: a single-panel or distant frame needs it'),
    (lambda c: c['frames'][1].update(colour=1), r'frames\.1\.colour'),
    (lambda c: c['frames'][1].update(intensity=0), r'frames\.1\.intensity'),
    (lambda c: c['frames'][1].update(file='nothing.png'), r'nothing\.png: no such picture'),
    (lambda c: c['frames'][1].update(file='../../etc/passwd'), 'leaves the folder'),
    (lambda c: c['frames'][1].update(file='/etc/passwd'), 'leaves the folder'),
    (lambda c: c['frames'][1].update(intensity=[1, 0, 1]), r'frames\.1.*intensity: .*positive'),
    (lambda c: c['frames'][1].update(right=c['frames'][1]['axis']), r'frames\.1.*right angle'),
    (lambda c: c['frames'][1].update(file='./000.png'), 'listed twice'),
    (lambda c: c['frames'][1].update(file='a\0b'), 'leaves the folder'),
    (lambda c: c['frames'][4].update(distant=True), 'axis: a single-panel or distant frame'),
    (lambda c: c['plane'].update(normal=[0, 0, 0]), 'normal: not a unit'),
    (lambda c: c['plane'].update(normal=[0, 0, 5]), 'normal: not a unit'),
    (lambda c: c['camera'].update(fx=0), r'camera\.fx'),
    (lambda c: c.update(frames=[]), 'frames'),
])
def test_wrong_lights_yaml_is_refused_with_the_field(folder, change, words):
    edit(folder, change)
    refused(folder, words)


def lead_out(folder, name):
    """Replace a file or folder by a link to a copy of it outside."""
    outside = folder.parent / 'outside'
    shutil.move(folder / name, outside)
    (folder / name).symlink_to(outside)


@pytest.mark.parametrize('name', ['000.png', 'mask.png', 'flat', 'flat/001.tif', 'ambient.png',
                                  'Normal_gt.mat', 'height_gt.npz', 'lights.yaml',
                                  'filenames.txt'])
def test_link_out_of_the_folder_is_refused(tmp_path, name):
    truth = Truth(np.ones((12, 16, 3), np.float32), np.ones((12, 16), np.float32))
    write_stack(a_stack(), tmp_path / 'stack', truth)
    read_stack(tmp_path / 'stack')
    lead_out(tmp_path / 'stack', name)
    refused(tmp_path / 'stack', Path(name).name + "' leaves the folder")


@pytest.mark.parametrize('name', ['light_directions.txt', 'ambient.png', '1.png'])
def test_link_out_of_a_benchmark_folder_is_refused(tmp_path, name):
    folder = distant(tmp_path / 'x')
    shutil.copy(folder / '0.png', folder / 'ambient.png')
    read_stack(folder)
    lead_out(folder, name)
    refused(folder, 'leaves the folder')


def test_links_that_go_nowhere_or_round_are_refused(folder):
    (folder / 'mask.png').unlink()
    (folder / 'mask.png').symlink_to('gone.png')
    refused(folder, r'mask\.png: no such picture')
    (folder / 'mask.png').unlink()
    (folder / 'mask.png').symlink_to('mask.png')
    refused(folder, r'mask\.png')


def test_flat_folder_of_the_user_may_be_anywhere(folder, tmp_path):
    expected = read_stack(folder)[0].gain_maps
    shutil.move(folder / 'flat', tmp_path / 'board')
    assert read_stack(folder)[0].gain_maps == []
    got = read_stack(folder, flat=tmp_path / 'board')[0].gain_maps
    np.testing.assert_array_equal(got, expected)
    lead_out(tmp_path / 'board', '002.tif')
    with pytest.raises(PsError, match='leaves the folder'):
        read_stack(folder, flat=tmp_path / 'board')


@pytest.mark.parametrize('lines', ['003.png 001.png 000.png 002.png',
                                   '003.png ambient.png ./001.png 000.png 002.png'])
def test_filenames_txt_states_the_order(folder, lines):
    before, _ = read_stack(folder)
    (folder / 'filenames.txt').write_text('\r\n'.join(lines.split()))
    same(before.subset([3, 1, 0, 2]), read_stack(folder)[0])
    same(before.subset([3, 0]), read_stack(folder, lights='1, 3')[0])


def test_frames_beyond_filenames_txt_follow(folder):
    before, _ = read_stack(folder)
    (folder / 'filenames.txt').write_text('002.png\n')
    same(before.subset([2, 0, 1, 3]), read_stack(folder)[0])


@pytest.mark.parametrize(('content', 'words'), [
    (b'000.png\nnothere.png\n', "filenames.txt: 'nothere.png' is not in lights.yaml"),
    (b'000.png\n./000.png\n', 'listed twice'), (b'\n', 'empty'), (b'\xff\xfe', 'UTF-8')])
def test_wrong_filenames_beside_lights_yaml_are_refused(folder, content, words):
    (folder / 'filenames.txt').write_bytes(content)
    refused(folder, words)


def test_motor_counts_of_a_frame_win_also_if_zero(folder):
    def change(content):
        content['motor_counts'] = 7
        content['frames'][0]['motor_counts'] = 0
        del content['frames'][1]['motor_counts']
    edit(folder, change)
    assert [light.motor_counts for light in read_stack(folder)[0].lights] == [0, 7, 25000, 25000]
    assert read_lights(folder).motor_counts == 7


@pytest.mark.parametrize('value', [np.nan, np.inf])
@pytest.mark.parametrize('name', ['000.tif', 'flat/001.tif'])
def test_pixels_that_are_no_numbers_are_refused(tmp_path, name, value):
    write_stack(a_stack(np.float32), tmp_path / 'stack')
    file = tmp_path / 'stack' / name
    picture = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    picture[1, 1] = value
    cv2.imwrite(str(file), picture)
    refused(tmp_path / 'stack', f'{name}: pixels')


def test_broken_and_odd_pictures_are_named(folder):
    (folder / '001.png').write_bytes(b'no picture')
    refused(folder, r'001\.png: cannot be read')
    cv2.imwrite(str(folder / '001.png'), np.zeros((3, 3), np.uint8))
    refused(folder, r'001\.png is \(3, 3\)')
    (folder / '001.png').write_bytes(b'')
    refused(folder, r'001\.png: cannot be read')


def test_missing_flat_picture_is_named(folder):
    (folder / 'flat' / '002.tif').unlink()
    refused(folder, r'no flat-field picture 002')


@pytest.mark.parametrize('there', [True, False])
def test_frames_that_are_no_equation_need_no_flat_picture(tmp_path, there):
    stack = a_stack()
    lights = [*stack.lights[:3], replace(stack.lights[3], panel=Panel.NONE)]
    write_stack(replace(stack, lights=lights), tmp_path / 'stack')
    file = tmp_path / 'stack' / 'flat' / '003.tif'
    file.unlink()
    if there:
        cv2.imwrite(str(file), np.zeros((6, 8), np.float32))
    *gains, last = read_stack(tmp_path / 'stack')[0].gain_maps
    peak = max(gain.max() for gain in stack.gain_maps[:3])
    np.testing.assert_allclose(gains, np.array(stack.gain_maps[:3]) / peak, rtol=1e-6)
    assert (last == 1).all()


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
    assert [light.name for light in select_lights(stack, ' 3 , 1 ', folder).lights] == ['2', '0']


@pytest.mark.parametrize(('file', 'content', 'words'), [
    ('light_directions.txt', '0 0 1\n', '1 lines of 3 numbers, expected 3'),
    ('light_directions.txt', '0 0 1\n0 0 2\n1 0 0\n', 'line 2 is not a unit'),
    ('light_directions.txt', 'a b c\n', 'not a table'),
    ('light_intensities.txt', '1\n1\n-1\n', 'must be positive'),
    ('light_intensities.txt', '1\n1\nnan\n', 'finite'),
    ('filenames.txt', '\n', 'empty'),
    ('filenames.txt', '../0.png\n1.png\n2.png\n', 'leaves the folder'),
    ('Normal_gt.mat', 'x', 'Normal_gt'),
    ('filenames.txt', '0.png\n1.png\n./0.png\n', 'listed twice'),
    ('filenames.txt', '0.png\n1.png\nambient.png\n', 'no light direction'),
    ('filenames.txt', b'\xff\xfe0.png', r'filenames\.txt: not a text'),
    ('light_directions.txt', b'\xff\xfe', r'directions\.txt: not a text'),
    ('light_directions.txt', '', 'directions.txt: empty'),
    ('light_directions.txt', '# x y z\n', 'directions.txt: empty'),
    ('height_gt.npz', 'x', r'height_gt\.npz: key height'),
    ('height_gt.npz', '', r'height_gt\.npz: key height'),
    ('height_gt.npz', b'PK\x03\x04garbage', r'height_gt\.npz: key height'),
])
def test_wrong_benchmark_files_are_refused(tmp_path, file, content, words):
    folder = distant(tmp_path / 'x')
    (folder / file).write_bytes(content.encode() if isinstance(content, str) else content)
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        refused(folder, words)


def test_array_under_the_name_of_an_archive_is_refused(tmp_path):
    folder = distant(tmp_path / 'x')
    with (folder / 'height_gt.npz').open('wb') as file:
        np.save(file, np.zeros((4, 5)))
    refused(folder, r'height_gt\.npz: key height')


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


def real(name):
    folder = DATA / name
    if not folder.is_dir():
        pytest.skip(f'no {folder}; set PS_DATA')
    return folder


def test_real_benchmark_folder():
    folder = real('diligent/ballPNG')
    stack, truth = read_stack(folder)
    assert len(stack.images) == 96
    assert stack.images[0].dtype == np.uint16
    assert truth is not None
    assert np.isfinite(truth.normal[stack.mask]).all()
    four = select_lights(stack, 'four', folder)
    assert [light.name for light in four.lights] == ['076', '056', '028', '049']


def test_real_four_pictures():
    stack, truth = read_stack(real('metal_disc'))
    assert truth is None
    assert stack.geometry is Geometry.ASSUMED
    assert [(light.name, light.panel) for light in stack.lights] == [
        ('part_090', Panel.E), ('part_180', Panel.N), ('part_270', Panel.W),
        ('part_000', Panel.S)]
    assert all(light.is_equation for light in stack.lights)
    height, width = stack.shape
    for gain in stack.gain_maps:
        assert gain.shape[0] <= 512
        assert gain.shape[1] / gain.shape[0] == pytest.approx(width / height, rel=0.01)
    assert max(gain.max() for gain in stack.gain_maps) == 1.0


def test_frames_of_all_and_of_no_panel_have_no_geometry(tmp_path):
    """As the head reports them: zero vectors."""
    nowhere = (0.0, 0.0, 0.0)
    lights = [Light(panel=panel, position=nowhere, axis=nowhere, right=nowhere, intensity=level)
              for panel, level in ((Panel.ALL, 1.0), (Panel.NONE, 0.0))]
    write_stack(Stack(images=[np.full((8, 9), 7, np.uint8)] * 2, lights=lights), tmp_path / 'out')
    again = read_stack(tmp_path / 'out')[0]
    assert [light.panel for light in again.lights] == [Panel.ALL, Panel.NONE]
