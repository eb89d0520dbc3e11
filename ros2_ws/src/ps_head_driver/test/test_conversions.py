"""Messages and arrays: round trips, fast filling of image data, refusal of broken messages."""
from dataclasses import replace
import time

from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
import numpy as np
import pytest

pytest.importorskip('ps_interfaces.msg', reason='needs the built workspace (make setup)')

from ps_head_driver import conversions as convert
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.head_model import load_head, nominal_head_path
from ps_head_driver.stack import (
    Geometry,
    Light,
    Mode,
    Panel,
    Plane,
    Pose,
    Stack,
    exposure,
    with_exposure_scale,
)

pixels = st.sampled_from([(np.uint8, 0), (np.uint16, 0), (np.uint8, 3), (np.uint16, 3),
                          (np.float32, 0), (np.float32, 2), (np.float32, 3)])


@given(st.data(), pixels, st.integers(1, 9), st.integers(1, 9))
def test_image_round_trip(data, pixel, height, width):
    dtype, channels = pixel
    shape = (height, width, channels) if channels else (height, width)
    image = data.draw(npst.arrays(dtype, shape))
    message = convert.image_to_message(image)
    assert message.step == len(message.data) // height
    np.testing.assert_array_equal(convert.message_to_image(message), image)


def test_padded_rows_and_big_endian_are_understood():
    image = np.arange(12, dtype=np.uint16).reshape(3, 4)
    message = convert.image_to_message(image)
    rows = image.astype('>u2').view(np.uint8).reshape(3, 8)
    message.data = np.pad(rows, ((0, 0), (0, 5))).tobytes()
    message.step, message.is_bigendian = 13, 1
    np.testing.assert_array_equal(convert.message_to_image(message), image)


def test_bgr_becomes_rgb():
    rgb = np.random.default_rng(0).integers(0, 255, (4, 6, 3), np.uint8)
    message = convert.image_to_message(rgb[..., ::-1], encoding='bgr8')
    np.testing.assert_array_equal(convert.message_to_image(message), rgb)


@pytest.mark.parametrize('order', ['rggb', 'bggr', 'gbrg', 'grbg'])
def test_bayer_of_a_uniform_colour_is_that_colour(order):
    colour = {'r': 200, 'g': 100, 'b': 50}
    tile = np.array([[colour[order[0]], colour[order[1]]], [colour[order[2]], colour[order[3]]]],
                    np.uint8)
    message = convert.image_to_message(np.tile(tile, (8, 8)), encoding=f'bayer_{order}8')
    image = convert.message_to_image(message)
    np.testing.assert_array_equal(image[4:-4, 4:-4].reshape(-1, 3),
                                  np.tile([200, 100, 50], (64, 1)))


@pytest.mark.parametrize('change', [
    {'encoding': 'yuv422'}, {'height': 1000}, {'width': 10**9}, {'step': 1}])
def test_broken_image_is_refused(change):
    message = convert.image_to_message(np.zeros((4, 5), np.uint8))
    for name, value in change.items():
        setattr(message, name, value)
    with pytest.raises(PsError) as error:
        convert.message_to_image(message)
    assert error.value.code == ErrorCode.SEQUENCER_BAD_IMAGE


def test_filling_an_image_costs_like_a_copy_of_its_bytes():
    image = np.zeros((2048, 2448), np.uint8)

    def shortest(function):
        times = []
        for _ in range(7):
            begin = time.perf_counter()
            function()
            times.append(time.perf_counter() - begin)
        return min(times)

    copy = shortest(image.copy)
    # element-wise conversion, the mistake this guards against, is more than 100 times a copy
    assert shortest(lambda: convert.image_to_message(image)) < 30 * copy


def stack() -> Stack:
    rng = np.random.default_rng(1)
    frame = {'dtype': np.uint8, 'size': (6, 8)}
    lights = [Light(
        name=f'BF_{panel.name}', panel=panel, mode=Mode.BRIGHT_FIELD, position=(0.1, 0.02, 0.12),
        axis=(-0.6, 0.0, -0.8), right=(0.0, 1.0, 0.0), size=(0.06, 0.03), intensity=0.97,
        motor_counts=25000, tilt=0.6, strobe_duration=0.002 * (i + 1), exposure_time=0.01,
        strobe_counter=7 + i, frame_counter=3 + i, device_time_ns=10**9 + i)
        for i, panel in enumerate([Panel.E, Panel.N, Panel.W, Panel.S])]
    return Stack(
        images=[rng.integers(0, 255, **frame) for _ in lights],
        lights=with_exposure_scale(lights),
        camera=load_head(nominal_head_path()).camera, ambient=rng.integers(0, 9, **frame),
        mask=rng.random((6, 8)) > 0.5,
        gain_maps=[rng.random((3, 4)).astype(np.float32) for _ in lights],
        plane=Plane((0.0, 0.6, 0.8), 1e-3), geometry=Geometry.CALIBRATED, stack_id='s',
        session_id='t', part_id='p', calibration_id='c', flat_id='f', stamp_ns=123456789012345678,
        head_pose=Pose('base_link', (1.0, 2.0, 3.0), (0.0, 0.0, 0.6, 0.8)),
        convergence_radius=0.06, light_height=0.12)


def test_stack_round_trip():
    before = stack()
    after = convert.message_to_stack(convert.stack_to_message(before))
    for name in ('images', 'gain_maps'):
        for a, b in zip(getattr(before, name), getattr(after, name), strict=True):
            np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(before.ambient, after.ambient)
    np.testing.assert_array_equal(before.mask, after.mask)
    arrays = {'images': [], 'gain_maps': [], 'ambient': None, 'mask': None}
    assert replace(before, **arrays) == replace(after, **arrays)
    assert [light.exposure_scale for light in after.lights] == [0.25, 0.5, 0.75, 1.0]


def test_strobe_counts_only_while_the_shutter_is_open_and_gain_multiplies():
    assert exposure(Light(strobe_duration=0.02, exposure_time=0.01)) == 0.01
    assert exposure(Light(strobe_duration=0.002, exposure_time=0.01)) == 0.002
    assert exposure(Light(exposure_time=0.01, gain=20.0)) == pytest.approx(0.1)




@pytest.mark.parametrize(('change', 'named'), [
    (lambda m: m.images.clear(), 'images'),
    (lambda m: m.lights.pop(), 'lights'),
    (lambda m: m.gain_maps.pop(), 'gain_maps'),
    (lambda m: setattr(m.lights[1], 'panel', 77), 'lights'),
    (lambda m: setattr(m, 'geometry', 9), 'geometry'),
    (lambda m: m.images.__setitem__(1, convert.image_to_message(np.zeros((2, 2), np.uint8))),
     r'images\[1\]'),
    (lambda m: setattr(m, 'ambient', convert.image_to_message(np.zeros((2, 2), np.uint8))),
     'ambient'),
])
def test_inconsistent_stack_is_refused_with_the_field(change, named):
    message = convert.stack_to_message(stack())
    change(message)
    with pytest.raises(PsError, match=named) as error:
        convert.message_to_stack(message)
    assert error.value.code == ErrorCode.RECONSTRUCTION_BAD_STACK


def test_foreign_distortion_model_is_refused():
    message = convert.stack_to_message(stack())
    message.camera_info.distortion_model = 'equidistant'
    with pytest.raises(PsError, match='equidistant'):
        convert.message_to_stack(message)


@settings(max_examples=30)
@given(st.integers(0, 2**31 * 10**9 - 1))
def test_time_round_trip(stamp_ns):
    assert convert.time_to_ns(convert.time_to_message(stamp_ns)) == stamp_ns


def test_calibration_round_trip():
    from datetime import UTC, datetime

    from ps_head_driver.calibration_file import HeadCalibration, MotorCorrection, PanelCorrection
    head = load_head(nominal_head_path())
    before = HeadCalibration(
        calibration_id='a', created=datetime(2026, 5, 6, tzinfo=UTC), head_serial='PS-1',
        camera=head.camera, verdict='POOR', verdict_reason='dirt',
        motor=MotorCorrection(offset_counts=120.0, scale=1.01, crank_offset=0.002),
        panels={'BF_N': PanelCorrection(shift=(1e-3, 0.0, 0.0), shadow_residual_px=0.2),
                'DF_E': PanelCorrection()})
    after = convert.message_to_calibration(convert.calibration_to_message(before, head))
    assert after == before
    assert convert.message_to_calibration(convert.calibration_to_message(None, head)) is None
