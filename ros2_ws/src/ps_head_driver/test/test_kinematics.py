"""The crank-slider: loop closure, derivative, dead points, panel poses and their tolerances."""
from heads import NOMINAL, random_head
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.head_model import DIRECTIONS, HeadModel
from ps_head_driver.kinematics import BrightFieldKinematics, DarkFieldKinematics, lights_at

seeds = st.integers(0, 2**32 - 1)


def joints(head: HeadModel, m: float, tilt: float) -> tuple[np.ndarray, np.ndarray]:
    """Slider joint and crank pin, straight from the words of head.yaml."""
    field = head.bright_field
    slider = field.slider
    z = slider.z_at_m0 + slider.direction * (m - slider.m0_counts) / slider.counts_per_metre
    angle = tilt + field.crank.offset
    pin = np.array([field.hinge.r, field.hinge.z]) + field.crank.radius * np.array(
        [np.cos(angle), -np.sin(angle)])
    return np.array([slider.r, z]), pin


@settings(max_examples=100, deadline=None)
@given(seeds, st.floats(0, 1))
def test_the_rod_keeps_its_length_over_the_whole_range(seed, where):
    head = random_head(np.random.default_rng(seed))
    motor = BrightFieldKinematics(head)
    low, high = motor.limits_counts
    m = low + where * (high - low)
    slider, pin = joints(head, m, float(motor.tilt(m)))
    assert np.linalg.norm(slider - pin) == pytest.approx(head.bright_field.rod_length, abs=1e-12)


@settings(max_examples=50, deadline=None)
@given(seeds, st.floats(0.001, 0.999))
def test_derivative_is_exact(seed, where):
    motor = BrightFieldKinematics(random_head(np.random.default_rng(seed)))
    low, high = motor.limits_counts
    m = low + 1 + where * (high - low - 2)
    step = 0.5
    numeric = (motor.tilt(m + step) - motor.tilt(m - step)) / (2 * step)
    assert motor.dtilt_dm(m) == pytest.approx(numeric, rel=1e-4)


@settings(max_examples=50, deadline=None)
@given(seeds, st.floats(0.01, 0.99))
def test_motor_position_inverts_tilt_on_the_assembled_branch(seed, where):
    motor = BrightFieldKinematics(random_head(np.random.default_rng(seed)))
    low, high = motor.limits_counts
    m = low + where * (high - low)
    assert motor.motor_position(motor.tilt(m)) == pytest.approx(m, abs=1e-4)


def test_nominal_head_covers_100_degrees_without_a_dead_point():
    motor = BrightFieldKinematics(NOMINAL)
    assert motor.limits_counts == NOMINAL.bright_field.slider.limits_counts
    low, high = np.degrees(motor.tilt_limits)
    assert low == pytest.approx(0, abs=1e-4)
    assert high > 100
    tilt = motor.tilt(np.arange(0, 64001, 100))
    assert np.all(np.diff(tilt) > 0)


def test_range_ends_before_a_dead_point():
    data = NOMINAL.model_dump()
    data['bright_field']['slider']['limits_counts'] = (-40000, 200000)
    motor = BrightFieldKinematics(HeadModel.model_validate(data))
    low, high = motor.limits_counts
    assert -40000 <= low < 0 < 64000 < high < 200000
    # rod and crank are nearly in line at the ends, and the tilt is monotone up to there
    for end in (low, high):
        slider, pin = joints(NOMINAL, end, float(motor.tilt(end)))
        hinge = np.array([NOMINAL.bright_field.hinge.r, NOMINAL.bright_field.hinge.z])
        crank, rod = pin - hinge, slider - pin
        sine = abs(crank[0] * rod[1] - crank[1] * rod[0]) / (
            np.linalg.norm(crank) * np.linalg.norm(rod))
        assert sine < 0.2
    assert np.all(np.diff(motor.tilt(np.linspace(low, high, 500))) > 0)
    with pytest.raises(PsError, match=f'{low} to {high}') as error:
        motor.tilt(high + 1)
    assert error.value.code == ErrorCode.CR_OUT_OF_LIMITS


def test_parts_that_cannot_be_assembled_are_refused():
    data = NOMINAL.model_dump()
    data['bright_field']['rod_length'] = 0.2
    with pytest.raises(PsError, match='cannot be assembled') as error:
        BrightFieldKinematics(HeadModel.model_validate(data))
    assert error.value.code == ErrorCode.HEAD_BAD_REQUEST


def test_tilt_out_of_reach_says_the_range():
    with pytest.raises(PsError, match=r'0\.00 to 101\.95 deg') as error:
        BrightFieldKinematics(NOMINAL).motor_position(np.radians(110))
    assert error.value.code == ErrorCode.HEAD_OUT_OF_LIMITS


@pytest.mark.parametrize(('direction', 'outward'), [
    ('E', (1, 0)), ('N', (0, 1)), ('W', (-1, 0)), ('S', (0, -1))])
def test_nominal_pose_is_what_head_yaml_draws(direction, outward):
    tilt = np.radians(30)
    pose = BrightFieldKinematics(NOMINAL).panel_pose(direction, tilt)
    radial = np.array([*outward, 0.0])
    np.testing.assert_allclose(pose.axis, -np.sin(tilt) * radial - [0, 0, np.cos(tilt)], atol=1e-7)
    np.testing.assert_allclose(
        pose.center, (0.04 + 0.07 * np.cos(tilt)) * radial
        + [0, 0, 0.15 - 0.07 * np.sin(tilt)], atol=1e-8)
    np.testing.assert_allclose(pose.right, np.cross([0, 0, 1], radial), atol=1e-7)


def with_east(**changes) -> HeadModel:
    data = NOMINAL.model_dump()
    data['bright_field']['panels']['E'].update(changes)
    return HeadModel.model_validate(data)


def test_tolerances_move_only_their_panel_and_as_named():
    def east(head):
        return BrightFieldKinematics(head).panel_pose('E', 0.5)
    plain = east(NOMINAL)
    shifted = east(with_east(shift=(1e-3, 2e-3, 3e-3)))
    np.testing.assert_allclose(shifted.center - plain.center, [1e-3, 2e-3, 3e-3])
    np.testing.assert_array_equal(shifted.axis, plain.axis)

    tilted = east(with_east(tilt_offset=0.1))
    np.testing.assert_allclose(
        tilted.axis, BrightFieldKinematics(NOMINAL).panel_pose('E', 0.6).axis)

    twisted = east(with_east(twist=0.1))
    hinge = np.array([0.04, 0, 0.15])
    c, s = np.cos(0.1), np.sin(0.1)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    np.testing.assert_allclose(twisted.axis, turn @ plain.axis, atol=1e-12)
    np.testing.assert_allclose(twisted.center - hinge, turn @ (plain.center - hinge), atol=1e-12)

    other = BrightFieldKinematics(with_east(twist=0.1, intensity=2.0)).panel_pose('N', 0.5)
    np.testing.assert_array_equal(
        other.center, BrightFieldKinematics(NOMINAL).panel_pose('N', 0.5).center)
    assert other.intensity == 1.0


@settings(max_examples=30, deadline=None)
@given(seeds, st.floats(0, 1.7), st.sampled_from(DIRECTIONS))
def test_axis_and_width_are_orthogonal_unit_vectors(seed, tilt, direction):
    head = random_head(np.random.default_rng(seed))
    for ring in (BrightFieldKinematics(head), DarkFieldKinematics(head)):
        pose = ring.panel_pose(direction, tilt)
        assert np.linalg.norm(pose.axis) == pytest.approx(1)
        assert np.linalg.norm(pose.right) == pytest.approx(1)
        assert pose.axis @ pose.right == pytest.approx(0, abs=1e-12)


def test_lights_at_lists_both_rings_in_order():
    lights = lights_at(NOMINAL, 20000, 1.3)
    assert [light.name for light in lights] == [
        f'{ring}_{name}' for ring in ('BF', 'DF') for name in DIRECTIONS]
    assert lights[0].tilt == float(BrightFieldKinematics(NOMINAL).tilt(20000))
    assert lights[4].tilt == 1.3
    assert all(light.axis[2] < 0 for light in lights)
