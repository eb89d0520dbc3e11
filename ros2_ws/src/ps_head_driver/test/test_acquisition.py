"""The acquisition over the emulated head: faults of frames, cancel, and timing in device time."""
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from ps_head_driver.acquisition import Acquirer, Settings
from ps_head_driver.cameras.fake import FrameFaults
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.fake.cell import ClientHead, FakeCell, fake_cell
from ps_head_driver.recipes import Recipe

RING = {'steps': [{'panel': panel} for panel in 'ENWS']}


@pytest.fixture(scope='module')
def module_cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FakeCell]:
    with fake_cell(tmp_path_factory.mktemp('cell'), 'plate', 0.08) as cell:
        yield cell


@pytest.fixture
def cell(module_cell: FakeCell) -> Iterator[FakeCell]:
    module_cell.settings = Settings(frame_timeout=1.0)
    yield module_cell
    module_cell.camera.faults = FrameFaults()


def brightest_sides(cell: FakeCell, taken) -> list[str]:
    """Toward which edge each picture gets brighter: the side of the panel that lit it."""
    sides = []
    for frame in taken.frames:
        image = frame.image.astype(float)
        rows, columns = image.mean(axis=1), image.mean(axis=0)
        slopes = {'E': columns[-5:].mean() - columns[:5].mean(),
                  'N': rows[:5].mean() - rows[-5:].mean()}
        slopes |= {'W': -slopes['E'], 'S': -slopes['N']}
        sides.append(max(slopes, key=slopes.__getitem__))
    return sides


def test_each_picture_has_its_light(cell: FakeCell):
    taken = cell.acquire(RING)
    assert brightest_sides(cell, taken) == list('ENWS')
    assert np.isnan(taken.motion_px)      # a plain plate cannot tell


@pytest.mark.parametrize(('faults', 'code'), [
    (FrameFaults(drop={2}), ErrorCode.SEQUENCER_FRAME_MISSING),
    (FrameFaults(drop={1, 2, 3, 4}), ErrorCode.SEQUENCER_FRAME_MISSING),
    (FrameFaults(duplicate={3}), ErrorCode.SEQUENCER_FRAME_MISMATCH),
    (FrameFaults(delay={4: 0.6}), None),
    (FrameFaults(swap={2}), None),
], ids=['dropped', 'all dropped', 'duplicated', 'late', 'out of order'])
def test_frame_faults(cell: FakeCell, faults: FrameFaults, code: ErrorCode | None):
    cell.camera.faults = faults
    if code is None:
        assert brightest_sides(cell, cell.acquire(RING)) == list('ENWS')
    else:
        with pytest.raises(PsError) as error:
            cell.acquire(RING)
        assert error.value.code == code
    cell.camera.faults = FrameFaults()
    assert brightest_sides(cell, cell.acquire(RING)) == list('ENWS')     # the next is right again


def test_frames_that_are_off_by_one_are_refused(cell: FakeCell, monkeypatch: pytest.MonkeyPatch):
    collect = cell.camera.collect
    monkeypatch.setattr(cell.camera, 'collect', lambda *arguments: [
        replace(frame, frame_counter=frame.frame_counter - 1,
                trigger_counter=(frame.trigger_counter or 0) - 1)
        for frame in collect(*arguments)])
    with pytest.raises(PsError, match='belongs to trigger') as error:
        cell.acquire(RING)
    assert error.value.code == ErrorCode.SEQUENCER_FRAME_MISMATCH


def test_cancelled_whatever_fails_because_of_it(cell: FakeCell):
    cancelled = []
    head = ClientHead(cell.client, cell.head)
    acquirer = Acquirer(cell.camera, head, lambda: cell.settings, lambda: bool(cancelled))

    def cancel_then_fail(_steps):
        cancelled.append(True)
        raise PsError(ErrorCode.SEQUENCER_HEAD_FAILED, 'stopped on request')

    head.run = cancel_then_fail      # type: ignore[method-assign]
    with pytest.raises(PsError) as error:
        acquirer.acquire(Recipe.model_validate(RING))
    assert error.value.code == ErrorCode.SEQUENCER_CANCELLED


def test_four_views_at_60_hz_take_less_than_100_ms_beyond_the_exposures(cell: FakeCell):
    taken = cell.acquire(RING)
    exposures = sum(light.exposure_time for light in taken.lights)
    print(f'four views: {taken.duration * 1e3:.1f} ms, exposures {exposures * 1e3:.1f} ms')
    assert taken.duration < 0.1 + exposures
