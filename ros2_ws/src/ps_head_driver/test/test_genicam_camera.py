"""The GenICam back end against Aravis' own fake GigE Vision camera on the loopback interface."""
from collections.abc import Iterator
import fcntl
import os
from pathlib import Path
import shutil
import subprocess
import tempfile
import time

import numpy as np
import pytest

from ps_head_driver.cameras import aravis
from ps_head_driver.cameras.genicam import GenicamCamera, frames_between
from ps_head_driver.errors import ErrorCode, PsError

FAKE = 'arv-fake-gv-camera-0.8'
needs_aravis = pytest.mark.skipif(
    not (aravis.is_installed() and shutil.which(FAKE)),
    reason=f'needs Aravis and its {FAKE}: sudo apt install libaravis-0.8-0 aravis-tools')


class FakeGigE:
    """Aravis' fake camera as a process; it can be switched off and on."""

    def __init__(self) -> None:
        self.serial = f'PS{os.getpid()}'
        self._process: subprocess.Popen | None = None

    def on(self) -> None:
        self._process = subprocess.Popen([FAKE, '-i', '127.0.0.1', '-s', self.serial],
                                         stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        time.sleep(0.5)
        assert self._process.poll() is None, 'the fake camera has ended'

    def off(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None


@pytest.fixture(scope='module')
def fake() -> Iterator[FakeGigE]:
    # there can be one on an address: its port is fixed
    with open(Path(tempfile.gettempdir()) / 'ps_test_gige.lock', 'w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        camera = FakeGigE()
        camera.on()
        yield camera
        camera.off()


@pytest.fixture
def camera(fake: FakeGigE) -> Iterator[GenicamCamera]:
    with GenicamCamera('127.0.0.1') as camera:
        yield camera


def take(camera: GenicamCamera, exposure: float = 0.004, gain: float = 0.0):
    camera.arm([exposure], gain=gain, software_trigger=True)
    camera.trigger()
    frame, = camera.collect(1, 2.0)
    camera.disarm()
    return frame


@needs_aravis
def test_one_frame_for_each_software_trigger_with_exposure_and_gain(camera: GenicamCamera):
    begin_ns = time.time_ns()
    frames = [take(camera, exposure, gain) for exposure, gain in (
        (0.004, 0.0), (0.001, 0.0), (0.004, 3.0))]
    assert [frame.frame_counter for frame in frames] == [1, 2, 3]
    assert [frame.exposure_time for frame in frames] == pytest.approx([0.004, 0.001, 0.004])
    assert [frame.gain for frame in frames] == [0.0, 0.0, 3.0]
    for frame in frames:
        assert frame.image.dtype == np.uint8
        assert frame.image.shape == (512, 512)
        assert begin_ns - 10**7 < frame.host_time_ns < time.time_ns()
    # the fake camera's pattern is brighter with more exposure and gain
    means = [frame.image.mean() for frame in frames]
    assert means[1] < means[0] < means[2]
    assert not camera.collect(2, 0.2)[1:]          # and none without a trigger


@needs_aravis
def test_on_the_trigger_line_no_frame_comes_by_software(camera: GenicamCamera):
    camera.arm([0.002] * 2)
    assert camera._device is not None
    assert camera._device.trigger_source == 'Line0'
    assert camera._device.exposure == pytest.approx(0.002)
    assert camera.collect(2, 0.3) == []            # nobody pulses the line
    assert take(camera).image.any()                # and back to software


@needs_aravis
@pytest.mark.parametrize(('name', 'shape', 'dtype'), [
    ('Mono8', (512, 512), np.uint8), ('Mono16', (512, 512), np.uint16),
    ('RGB8', (512, 512, 3), np.uint8), ('BayerRG8', (512, 512, 3), np.uint8)])
def test_pixel_formats(fake: FakeGigE, name, shape, dtype):
    with GenicamCamera(f'Aravis-Fake-{fake.serial}', pixel_format=name) as camera:
        image = take(camera).image
    assert image.shape == shape
    assert image.dtype == dtype
    assert image.std() > 0


@needs_aravis
@pytest.mark.parametrize(('setting', 'words'), [
    ({'pixel_format': 'Mono99'}, 'pixel_format.*Mono8'), ({'trigger_line': 'Line77'}, 'Line0')])
def test_a_setting_the_camera_has_not_got_names_those_it_has(fake: FakeGigE, setting, words):
    with pytest.raises(PsError, match=words) as error:
        GenicamCamera('127.0.0.1', **setting).open()
    assert error.value.code == ErrorCode.SEQUENCER_BAD_REQUEST


@needs_aravis
def test_values_out_of_range_are_refused(camera: GenicamCamera):
    for settings, words in (({'exposure': 60.0}, 'exposure 60 s'), ({'gain': 40.0}, 'gain 40 dB')):
        with pytest.raises(PsError, match=words) as error:
            take(camera, **settings)
        assert error.value.code == ErrorCode.SEQUENCER_BAD_REQUEST
    with pytest.raises(PsError, match='one exposure time'):
        camera.arm([0.001, 0.002])
    assert take(camera).image.any()


@needs_aravis
def test_a_camera_that_is_not_there(fake: FakeGigE):
    with pytest.raises(PsError, match='no-such-camera') as error:
        GenicamCamera('no-such-camera').open()
    assert error.value.code == ErrorCode.SEQUENCER_CAMERA_LOST


@needs_aravis
def test_lost_while_waiting_for_a_frame_and_found_again(fake: FakeGigE, camera: GenicamCamera):
    camera.arm([0.002] * 2)
    fake.off()
    with pytest.raises(PsError, match='does not answer') as error:
        camera.collect(2, 20.0)
    assert error.value.code == ErrorCode.SEQUENCER_CAMERA_LOST
    with pytest.raises(PsError) as error:      # still away
        take(camera)
    assert error.value.code == ErrorCode.SEQUENCER_CAMERA_LOST
    fake.on()
    assert take(camera).image.any()


@pytest.mark.parametrize(('last', 'now', 'step'), [
    (1, 2, 1), (7, 10, 3), (65535, 1, 1), (65535, 0, 1), (0, 1, 1), (65534, 2, 3),
    (2**40, 2**40 + 1, 1)])
def test_frame_numbers_go_on_beyond_16_bits(last, now, step):
    assert frames_between(last, now) == step
