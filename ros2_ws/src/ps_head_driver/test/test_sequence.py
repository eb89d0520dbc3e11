"""Frames are given to lights by counters and times, or not at all."""
from dataclasses import replace
import random

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from ps_head_driver import sequence
from ps_head_driver.cameras.base import Frame
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.stack import Light


def exposures(count=4, first_strobe=11, first_frame=3, period_s=0.017):
    """Strobes of one program and the frames that a healthy camera yields for them."""
    lights = [Light(name=f'L{i}', strobe_counter=first_strobe + i,
                    device_time_ns=int((5 + i * period_s) * 1e9)) for i in range(count)]
    frames = [Frame(image=np.full((2, 3), i, np.uint8), frame_counter=first_frame + i,
                    trigger_counter=first_strobe + i,
                    device_time_ns=int((99 + i * period_s) * 1e9), host_time_ns=i,
                    exposure_time=0.004, gain=0.0) for i in range(count)]
    return frames, lights


@given(st.integers(1, 12), st.integers(0, 2**31), st.randoms())
def test_any_order_of_arrival_gives_the_same_match(count, seed, shuffler):
    frames, lights = exposures(count, first_strobe=seed, first_frame=seed // 3)
    arrived = frames.copy()
    shuffler.shuffle(arrived)
    assert sequence.match(arrived, lights, 0.001) == frames


def refused(frames, lights, code, words):
    random.Random(0).shuffle(frames)
    with pytest.raises(PsError, match=words) as error:
        sequence.match(frames, lights, 0.001)
    assert error.value.code == code


@pytest.mark.parametrize('lost', range(4))
def test_lost_frame_is_named(lost):
    frames, lights = exposures()
    del frames[lost]
    refused(frames, lights, ErrorCode.SEQUENCER_FRAME_MISSING, f'missing: L{lost}')


def test_no_frame_at_all():
    refused([], exposures()[1], ErrorCode.SEQUENCER_FRAME_MISSING, '4 triggers, but 0 frames')


def test_duplicated_frame():
    frames, lights = exposures()
    refused([*frames, frames[1]], lights, ErrorCode.SEQUENCER_FRAME_MISMATCH, 'arrived twice')


def test_frame_too_many():
    frames, lights = exposures(5)
    refused(frames, lights[:4], ErrorCode.SEQUENCER_FRAME_MISMATCH, '5 frames')


@pytest.mark.parametrize('reports_triggers', [True, False])
def test_lost_frame_made_up_by_a_late_one(reports_triggers):
    frames, lights = exposures(5)
    del frames[2]        # the camera lost one and sent one more at the end
    if not reports_triggers:
        frames = [replace(frame, trigger_counter=None) for frame in frames]
    refused(frames, lights[:4], ErrorCode.SEQUENCER_FRAME_MISMATCH, 'lost in between')


def test_off_by_one_is_seen_by_the_trigger_count():
    frames, lights = exposures(5)
    refused(frames[:4], lights[1:], ErrorCode.SEQUENCER_FRAME_MISMATCH, 'belongs to trigger 11')


def test_wrong_times_are_seen():
    frames, lights = exposures()
    frames[2] = replace(frames[2], device_time_ns=frames[2].device_time_ns + 3_000_000)
    refused(frames, lights, ErrorCode.SEQUENCER_FRAME_MISMATCH, 'frame 3 came 37.00 ms')


def test_camera_without_clock_or_trigger_count_is_matched_by_its_own_count():
    frames, lights = exposures()
    frames = [replace(f, device_time_ns=None, trigger_counter=None) for f in frames]
    assert sequence.match(frames[::-1], lights, 0.001) == frames


def test_frames_of_different_size_are_refused():
    frames, _ = exposures()
    frames[3] = replace(frames[3], image=np.zeros((2, 2), np.uint8))
    with pytest.raises(PsError, match='frame 4') as error:
        sequence.check_images(frames)
    assert error.value.code == ErrorCode.SEQUENCER_BAD_IMAGE
