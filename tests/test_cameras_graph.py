"""The camera back ends folder, topic and GenICam in a real graph."""
from collections.abc import Iterator
from contextlib import contextmanager
import fcntl
from pathlib import Path
import shutil
import subprocess
import tempfile
import threading

import cv2
import numpy as np
import pytest

pytest.importorskip('ps_interfaces.msg', reason='needs the built workspace (make setup)')

from sensor_msgs.msg import Image

from ps_head_driver.cameras import aravis
from ps_head_driver.conversions import (
    ENCODINGS,
    image_to_message,
    message_to_image,
    time_to_message,
)
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.fake.trigger_socket import TriggerListener, default_path
from ps_head_driver.stack import Geometry, Panel
from ps_inspection.cell_client import CellClient
from ps_inspection.graph import NODES
from ps_inspection.runner import Cell

pytestmark = [pytest.mark.graph, pytest.mark.usefixtures('ros_domain')]
FAKE_GIGE = 'arv-fake-gv-camera-0.8'
NEEDED = [node for node in NODES if node.executable in (
    'head_driver', 'camera_sequencer', 'reconstruction')]


@pytest.fixture(scope='module')
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four pictures of a plate with a step in the middle, and the flat board."""
    folder = tmp_path_factory.mktemp('pictures')
    for i, ending in enumerate(('000', '090', '180', '270')):
        image = np.full((48, 64), 100, np.uint8)
        image[:, 32] = 60 + 40 * i
        cv2.imwrite(str(folder / f'part_{ending}.png'), image)
        cv2.imwrite(str(folder / f'flat_{ending}.png'), np.full((48, 64), 200, np.uint8))
    return folder


def test_folder_camera_plays_pictures_through_the_graph(pictures: Path, tmp_path: Path):
    arguments = {'fake_hardware': 'true', 'camera': 'folder', 'input_folder': str(pictures)}
    with (Cell(arguments, nodes=NEEDED, log_folder=tmp_path),
          CellClient(outputs=['shape']) as client):
        client.home()
        stack_id = client.capture()
        message = client.stack(stack_id)
        assert message.geometry == Geometry.ASSUMED
        assert [light.panel for light in message.lights] == [Panel.E, Panel.N, Panel.W, Panel.S]
        assert [int(message_to_image(image)[0, 32]) for image in message.images] == [
            100, 140, 180, 60]
        assert len(message.gain_maps) == 4
        info, _ = client.reconstruction(stack_id)
        assert info.success
        assert info.geometry == Geometry.ASSUMED
        with pytest.raises(PsError) as error:
            client.capture('dark_field')
        assert error.value.code == ErrorCode.SEQUENCER_BAD_REQUEST
        assert client.capture()


def test_folder_camera_without_a_folder_ends_with_one_clear_line(tmp_path: Path):
    arguments = {'fake_hardware': 'true', 'camera': 'folder'}
    with pytest.raises(PsError, match='parameter input_folder: empty'):
        Cell(arguments, nodes=NEEDED, log_folder=tmp_path).start()


class TopicDriver:
    """A camera driver: one picture for each trigger pulse, stamped with its exposure's start."""

    def __init__(self, client: CellClient) -> None:
        self.lose = 0
        self.encoding = 'bgr8'
        self._node = client.node
        self._publisher = client.node.create_publisher(Image, 'camera/image_raw', 8)
        self._listener = TriggerListener(default_path('ps_head'))
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.is_set():
            event = self._listener.get(0.1)
            if event is None:
                continue
            if self.lose:
                self.lose -= 1
                continue
            dtype, channels = ENCODINGS[self.encoding]
            image = np.full((24, 32, channels), 10 + np.argmax(event.bf_levels), dtype)
            message = image_to_message(image[..., 0] if channels == 1 else image,
                                       encoding=self.encoding)
            message.header.stamp = time_to_message(10**18 + event.device_time_ns)
            self._publisher.publish(message)

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._listener.close()
        self._node.destroy_publisher(self._publisher)


@pytest.fixture(scope='module')
def topic_cell(ros_domain: int, tmp_path_factory: pytest.TempPathFactory) -> Iterator[CellClient]:
    folder = tmp_path_factory.mktemp('topic')
    settings = folder / 'settings.yaml'
    settings.write_text('/**:\n  ros__parameters:\n    frame_timeout: 2.0\n')
    arguments = {'fake_hardware': 'true', 'camera': 'topic', 'params_file': str(settings)}
    with Cell(arguments, nodes=NEEDED, log_folder=folder), CellClient() as client:
        client.home()
        yield client


def test_topic_camera_without_a_driver_is_refused(topic_cell: CellClient):
    with pytest.raises(PsError, match='nobody publishes') as error:
        topic_cell.capture()
    assert error.value.code == ErrorCode.SEQUENCER_CAMERA_LOST


def test_topic_camera_matches_frames_by_their_stamps(topic_cell: CellClient):
    driver = TopicDriver(topic_cell)
    try:
        stack_id = capture_when_found(topic_cell)
        message = topic_cell.stack(stack_id)
        assert [int(message_to_image(image)[0, 0, 0]) for image in message.images] == [
            10, 11, 12, 13]
        driver.lose = 1
        with pytest.raises(PsError) as error:
            topic_cell.capture()
        assert error.value.code == ErrorCode.SEQUENCER_FRAME_MISSING
        assert topic_cell.capture() in topic_cell.done
    finally:
        driver.close()


def test_topic_camera_lost_and_found_with_pictures_of_every_kind(topic_cell: CellClient):
    # the driver of the test before has gone; frames are missing until the cell has heard of it
    for _ in range(20):
        with pytest.raises(PsError) as error:
            topic_cell.capture()
        if error.value.code != ErrorCode.SEQUENCER_FRAME_MISSING:
            break
    assert error.value.code == ErrorCode.SEQUENCER_CAMERA_LOST
    driver = TopicDriver(topic_cell)
    try:
        capture_when_found(topic_cell)
        for encoding, published in (('mono8', 'mono8'), ('mono16', 'mono16'), ('rgb8', 'rgb8'),
                                    ('rgb16', 'rgb16'), ('bayer_rggb8', 'rgb8'),
                                    ('bayer_gbrg16', 'rgb16')):
            driver.encoding = encoding
            message = topic_cell.stack(topic_cell.capture())
            assert [image.encoding for image in message.images] == [published] * 4
            for i, image in enumerate(message.images):
                np.testing.assert_array_equal(message_to_image(image), 10 + i)
    finally:
        driver.close()


@pytest.mark.skipif(
    not (aravis.is_installed() and shutil.which(FAKE_GIGE)),
    reason=f'needs Aravis and its {FAKE_GIGE}: sudo apt install libaravis-0.8-0 aravis-tools')
def test_genicam_camera_stepped_by_the_host_lost_and_found(tmp_path: Path):
    settings = tmp_path / 'settings.yaml'
    settings.write_text('/**:\n  ros__parameters:\n    sequencing: host\n'
                        '    camera_id: 127.0.0.1\n    max_motion: 0.0\n')
    # a namespace of its own: the cell of the topic camera is still there
    arguments = {'fake_hardware': 'true', 'camera': 'genicam', 'params_file': str(settings),
                 'namespace': 'ps_genicam'}
    with open(Path(tempfile.gettempdir()) / 'ps_test_gige.lock', 'w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)      # the fake camera's port is fixed
        with Cell(arguments, nodes=NEEDED, log_folder=tmp_path), \
                CellClient('ps_genicam') as client:
            client.home()
            with pytest.raises(PsError) as error:
                client.capture()
            assert error.value.code == ErrorCode.SEQUENCER_CAMERA_LOST
            with fake_gige():
                check_host_stepped(client)
            with pytest.raises(PsError) as error:
                client.capture()
            assert error.value.code == ErrorCode.SEQUENCER_CAMERA_LOST
            with fake_gige():
                check_host_stepped(client)


def check_host_stepped(client: CellClient) -> None:
    """One capture, with the exposures inside the lights."""
    message = client.stack(client.capture())
    assert [image.encoding for image in message.images] == ['mono8'] * 4
    assert [light.panel for light in message.lights] == [Panel.E, Panel.N, Panel.W, Panel.S]
    first = message.lights[0].frame_counter
    for i, light in enumerate(message.lights):
        assert light.exposure_time == pytest.approx(0.004)
        assert light.strobe_duration > light.exposure_time
        assert light.frame_counter == first + i


@contextmanager
def fake_gige() -> Iterator[subprocess.Popen]:
    """Aravis' own GigE Vision camera on the loopback interface."""
    process = subprocess.Popen([FAKE_GIGE, '-i', '127.0.0.1', '-s', 'GRAPH'],
                               stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def capture_when_found(client: CellClient) -> str:
    """The first capture, once the sequencer has discovered the driver's topic."""
    for _ in range(20):
        try:
            return client.capture()
        except PsError as error:
            if error.code not in (ErrorCode.SEQUENCER_CAMERA_LOST,
                                  ErrorCode.SEQUENCER_FRAME_MISSING):
                raise
    pytest.fail('the driver was never found')
