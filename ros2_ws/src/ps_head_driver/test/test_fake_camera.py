"""The fake camera on a trigger socket, without an emulator: the test announces the strobes."""
from pathlib import Path
import threading
import time

import numpy as np
import pytest

from ps_head_driver.cameras.fake import FakeCamera, FrameFaults
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.fake.bench import fake_head
from ps_head_driver.fake.renderer import Sensor, make_renderer
from ps_head_driver.fake.trigger_socket import StrobeEvent, TriggerServer
from ps_head_driver.head_client import HeadClient, Motion
from ps_head_driver.head_model import load_head, nominal_head_path
from ps_head_driver.kinematics import BrightFieldKinematics
from ps_head_driver.protocol import FULL_LEVEL, Step
from ps_head_driver.serial_link import SerialLink

HEAD = load_head(nominal_head_path())
TILT, DF_TILT, PERIOD_NS = 0.5, 1.3, 20_000_000
SINGLE = np.eye(4)


class Board:
    """Announces strobes like the emulator."""

    def __init__(self, path: Path) -> None:
        self.server = TriggerServer(path)
        self.count, self.triggers, self.boot = 0, 100, 0
        self._lock, self._end = threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        while not self._end.wait(0.005):
            with self._lock:
                self.server.service()

    def strobe(self, levels=(1, 0, 0, 0), tilt=TILT, strobe_s=0.004, trigger=True):
        self.count += 1
        self.triggers += trigger
        with self._lock:
            self.server.strobe(StrobeEvent(
                self.count, self.triggers, self.count * PERIOD_NS, strobe_s,
                tuple(float(level) for level in levels), (0.0,) * 4, 1000.0, tilt, DF_TILT,
                self.boot))

    def close(self) -> None:
        self._end.set()
        self._thread.join()
        self.server.close()


@pytest.fixture
def board(tmp_path):
    board = Board(tmp_path / 'trigger.sock')
    yield board
    board.close()


@pytest.fixture
def camera(board, tmp_path):
    with FakeCamera(HEAD, 'plate', tmp_path / 'trigger.sock', scale=0.05, noise=False) as camera:
        yield camera


def test_frames_show_what_the_board_did(camera, board):
    camera.arm([0.004] * 4)
    before = time.time_ns()
    for i in range(4):
        board.strobe(SINGLE[i], tilt=0.4 + 0.05 * i)
    frames = camera.collect(4, 5.0)
    own = make_renderer('plate', HEAD, Sensor(noise=False), scale=0.05)
    for i, frame in enumerate(frames):
        expected = own.render(0.4 + 0.05 * i, DF_TILT, SINGLE[i])
        assert np.array_equal(frame.image, expected)
        assert frame.trigger_counter == 101 + i
        assert frame.frame_counter == frames[0].frame_counter + i
        assert frame.device_time_ns == (i + 1) * PERIOD_NS
        assert frame.host_time_ns - frames[0].host_time_ns == i * PERIOD_NS
    assert abs(frames[0].host_time_ns - before) < 1e9
    assert camera.camera_geometry == own.camera
    assert np.array_equal(camera.renderer.truth().height, own.truth().height)


def test_exposures_and_gain_are_those_armed(camera, board):
    camera.arm([0.002, 0.004, 0.004], gain=6.0206)
    board.strobe(strobe_s=0.004)       # longer than the shutter is open
    board.strobe(strobe_s=0.001)       # shorter
    board.strobe(levels=(0, 0, 0, 0))
    full, part, dark = camera.collect(3, 5.0)
    assert full.image[25, 32] == pytest.approx(2 * part.image[25, 32], abs=2)
    assert dark.image.max() == 0
    assert (full.exposure_time, part.exposure_time, full.gain) == (0.002, 0.004, 6.0206)


def test_old_frames_are_flushed_and_counters_go_on(camera, board):
    camera.arm([0.004])
    board.strobe()
    time.sleep(0.1)         # it has reached the camera
    camera.arm([0.004])
    board.strobe()
    first, = camera.collect(1, 5.0)
    camera.disarm()
    board.strobe()
    time.sleep(0.1)
    camera.arm([0.004])
    assert camera.collect(1, 0.2) == []
    board.strobe()
    second, = camera.collect(1, 5.0)
    assert second.frame_counter == first.frame_counter + 1
    assert second.trigger_counter == first.trigger_counter + 2


def test_noise_differs_between_frames_and_repeats_between_cameras(board, tmp_path):
    def pair():
        with FakeCamera(HEAD, 'plate', tmp_path / 'trigger.sock', scale=0.05, seed=4) as camera:
            camera.arm([0.004] * 2)
            board.strobe()
            board.strobe()
            return [frame.image for frame in camera.collect(2, 5.0)]

    first, second = pair(), pair()
    assert not np.array_equal(first[0], first[1])
    assert np.array_equal(first[0], second[0])
    assert np.array_equal(first[1], second[1])


@pytest.mark.parametrize(('faults', 'order'), [
    (FrameFaults(drop={2}), [1, 3]),
    (FrameFaults(duplicate={2}), [1, 2, 2, 3]),
    (FrameFaults(swap={1}), [2, 1, 3]),
    (FrameFaults(delay={2: 0.3}), [1, 2, 3])])
def test_faults(camera, board, faults, order):
    camera.faults = faults
    camera.arm([0.004] * 3)
    start = time.monotonic()
    for _ in range(3):
        board.strobe()
    frames = camera.collect(max(len(order), 3), 0.3)
    assert [frame.trigger_counter - 100 for frame in frames] == order
    if faults.delay:
        assert time.monotonic() - start > 0.3


def test_triggers_that_come_too_fast_are_missed(board, tmp_path):
    with FakeCamera(HEAD, 'plate', tmp_path / 'trigger.sock', scale=0.05,
                    max_frame_rate=30.0) as camera:
        camera.arm([0.004] * 4)
        for _ in range(4):
            board.strobe()      # 50 Hz
        frames = camera.collect(4, 0.3)
    assert [frame.trigger_counter - 100 for frame in frames] == [1, 3]
    assert frames[1].frame_counter == frames[0].frame_counter + 1


def test_a_strobe_without_trigger_makes_no_picture(camera, board):
    camera.arm([0.004] * 2)
    board.strobe()
    board.strobe(trigger=False)
    board.strobe()
    board.boot, board.triggers = 1, 0       # the board restarts
    board.strobe(trigger=False)
    frames = camera.collect(3, 0.3)
    assert [frame.trigger_counter for frame in frames] == [101, 102]


def test_with_the_emulator_it_shows_where_the_motor_really_is(tmp_path):
    motion = Motion(settle_s=0.0)
    ring = [Step(1 << i, FULL_LEVEL, 2000, 4000, 17000) for i in range(8)]
    with fake_head(tmp_path) as (ports, control):
        client = HeadClient([SerialLink(port) for port in ports], (0, 64000))
        client.connect(motion)
        client.home()
        client.move_to(24000, Motion(approach_up=False, settle_s=0.0))      # off by the backlash
        slider = control.command('state')['slider_counts']
        df_tilt = client.set_df_tilt(1.25).df_tilt
        with FakeCamera(HEAD, 'plate', tmp_path / 'trigger.sock', scale=0.05,
                        noise=False) as camera:
            camera.arm([0.004] * 8)
            records = client.run_program(ring).records
            frames = camera.collect(8, 5.0)
            own = camera.renderer
        client.disconnect()
    assert slider != pytest.approx(24000, abs=50)
    tilt = float(BrightFieldKinematics(HEAD).tilt(slider))
    for i, (frame, record) in enumerate(zip(frames, records, strict=True)):
        assert frame.trigger_counter == record.trigger_counter
        assert frame.device_time_ns == record.time_us * 1000
        levels = np.eye(8)[i]
        expected = own.render(tilt, df_tilt, levels[:4], levels[4:])
        assert np.abs(frame.image.astype(int) - expected).max() <= 1


def test_cancel_ends_collect_early(camera):
    camera.arm([0.004])
    threading.Timer(0.2, camera.cancel).start()
    start = time.monotonic()
    assert camera.collect(1, 30.0) == []
    assert time.monotonic() - start < 5.0
    camera.arm([0.004])
    assert camera.collect(1, 0.1) == []     # the cancel is over, this is the timeout


def test_a_lost_head_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr('ps_head_driver.cameras.fake._CONNECT_TIMEOUT_S', 0.2)
    path = tmp_path / 'trigger.sock'
    with FakeCamera(HEAD, 'plate', path, scale=0.05) as camera:
        with pytest.raises(PsError, match='fake_hardware') as never_there:
            camera.arm([0.004])
        assert never_there.value.code == ErrorCode.SEQUENCER_CAMERA_LOST
        board = Board(path)
        camera.arm([0.004])
        end = threading.Timer(0.2, board.close)
        end.start()
        with pytest.raises(PsError, match='has gone') as lost:
            camera.collect(1, 30.0)
        assert lost.value.code == ErrorCode.SEQUENCER_CAMERA_LOST
        end.join()                  # the socket is gone after its clients
        board = Board(path)         # the head is back
        try:
            camera.arm([0.004])
            board.strobe()
            assert len(camera.collect(1, 5.0)) == 1
        finally:
            board.close()


def test_a_picture_that_cannot_be_rendered_is_an_error(camera, board, monkeypatch):
    monkeypatch.setattr(camera.renderer, 'render', lambda *_: 1 / 0)
    camera.arm([0.004])
    board.strobe()
    with pytest.raises(PsError, match='rendering failed'):
        camera.collect(1, 5.0)
    monkeypatch.undo()
    camera.arm([0.004])
    board.strobe()
    assert len(camera.collect(1, 5.0)) == 1


def test_unknown_scene_is_refused_on_open(tmp_path):
    with pytest.raises(PsError, match='there is no scene'):
        FakeCamera(HEAD, 'moon', tmp_path / 'trigger.sock').open()
