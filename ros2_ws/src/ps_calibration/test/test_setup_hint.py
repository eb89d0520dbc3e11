"""What to tell who sets the target up: it must be right, in sign, too."""
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ps_calibration.ring_target import RingTarget
from ps_calibration.setup_hint import SetupHint, setup_hint
from ps_calibration.synthetic import Bench
from ps_calibration.synthetic_dirt import glints
from ps_calibration.synthetic_faults import E, N, S, W
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.stack import Stack


def test_following_the_hint_centres_and_levels(
        stack: Stack, bench: Bench, target: RingTarget) -> None:
    hint = setup_hint(stack, target, stack.camera)
    where = bench.where
    np.testing.assert_allclose(where.position[:2] + hint.shift, 0, atol=2e-5)
    along = Rotation.from_rotvec([0, 0, hint.turn]).apply(where.rotation[:, 0])
    assert np.arctan2(along[1], along[0]) == pytest.approx(0, abs=1e-3)
    # the plane's normal as the head sees it, once it is turned
    normal = Rotation.from_rotvec([*hint.tilt, 0]).inv().apply(where.rotation[:, 2])
    np.testing.assert_allclose(normal, [0, 0, 1], atol=3e-3)
    assert np.degrees(np.hypot(*hint.tilt)) > 0.3, 'a level target shows nothing here'


def test_hint_in_words() -> None:
    assert 'in place' in SetupHint((0.001, 0.0), 0.02, (0.0, 0.01)).text
    text = SetupHint((0.004, -0.001), 0.0, (0.0, 0.0)).text
    assert '+4.0 mm in x and -1.0 mm in y' in text


def test_saturated_pictures_are_called_so(stack: Stack, target: RingTarget) -> None:
    burnt = [np.full_like(image, 255) if k in (E, N, W, S) else image
             for k, image in enumerate(stack.images)]
    with pytest.raises(PsError, match='saturated') as refused:
        setup_hint(replace(stack, images=burnt), target, stack.camera)
    assert refused.value.code is ErrorCode.CALIBRATION_CAPTURE_FAILED
    assert 'lower its exposure' in refused.value.message
    assert 'clean' not in refused.value.message


def test_dirt_that_glints_is_to_be_cleaned(stack: Stack, target: RingTarget) -> None:
    with pytest.raises(PsError, match='scattered spots; clean the target'):
        setup_hint(glints(stack, 160), target, stack.camera)


def test_a_plate_just_at_the_end_of_the_range_is_not_called_dirty(
        stack: Stack, target: RingTarget) -> None:
    bright = [np.clip(np.round(1.02 * 255 / np.quantile(image, 0.95) * image), 0, 255).astype(
        np.uint8) if k == E else image for k, image in enumerate(stack.images)]
    with pytest.raises(PsError, match='frame E is saturated; lower its exposure'):
        setup_hint(replace(stack, images=bright), target, stack.camera)
