"""The reconstruction node as a process: stacks in over DDS, pictures and their report out."""
from collections.abc import Callable, Iterator
from dataclasses import replace
import time
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image

from ps_head_driver.camera_model import scaled_camera
from ps_head_driver.conversions import message_to_image, stack_to_message
from ps_head_driver.errors import ErrorCode
from ps_head_driver.frames import OPTICAL_FRAME, optical_to_plane
from ps_head_driver.head_model import load_head, nominal_head_path
from ps_head_driver.kinematics import lights_at
from ps_head_driver.ros_support import LATCHED, RELIABLE
from ps_head_driver.stack import Stack
from ps_inspection.graph import NODES
from ps_inspection.runner import Cell
from ps_interfaces.msg import PhotometricStack, ReconstructionInfo
from ps_reconstruction.pipeline import Options, reconstruct

pytestmark = pytest.mark.graph
OWN = [node for node in NODES if node.executable == 'reconstruction']


def make_stack(stack_id: str, shape: tuple[int, int] = (96, 120)) -> Stack:
    head = load_head(nominal_head_path())
    rng = np.random.default_rng(1)
    return Stack(
        [rng.integers(100, 140, shape, np.uint8) for _ in range(4)],
        lights_at(head, 20000, 1.3)[:4], scaled_camera(head.camera, shape[1], shape[0]),
        stack_id=stack_id, part_id='plate', stamp_ns=1_234_567_890_123_456_789)


class Peer:
    """Sends stacks and hears what becomes of them."""

    def __init__(self) -> None:
        self.context = Context()
        self.context.init()
        self.node = Node('peer', namespace='ps_head', context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.stack = self.node.create_publisher(PhotometricStack, 'stack', RELIABLE)
        self.heard: dict[str, list[Any]] = {}
        self.listen('reconstruction_info', ReconstructionInfo, LATCHED)
        self.node.create_subscription(
            DiagnosticArray, '/diagnostics',
            lambda m: self.heard.setdefault('diagnostics', []).extend(m.status), 10)
        self.setter = self.node.create_client(SetParameters, 'reconstruction/set_parameters')
        self.until(lambda: self.stack.get_subscription_count()
                   and self.setter.service_is_ready(), 60)

    def listen(self, topic: str, kind: type, qos: Any = RELIABLE) -> None:
        messages = self.heard.setdefault(topic, [])
        self.node.create_subscription(kind, topic, messages.append, qos)

    def until(self, condition: Callable[[], Any], seconds: float = 30.0) -> None:
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, f'timed out; heard {list(self.heard)}'
            self.executor.spin_once(timeout_sec=0.05)

    def reconstruct(self, message: PhotometricStack) -> ReconstructionInfo:
        self.stack.publish(message)
        infos = self.heard['reconstruction_info']
        self.until(lambda: infos and infos[-1].stack_id == message.stack_id)
        return infos[-1]

    def set(self, name: str, value: ParameterValue) -> Any:
        future = self.setter.call_async(SetParameters.Request(
            parameters=[Parameter(name=name, value=value)]))
        self.until(future.done)
        return future.result().results[0]

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()


def text(value: str) -> ParameterValue:
    return ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=value)


@pytest.fixture(scope='module')
def peer(tmp_path_factory: pytest.TempPathFactory, ros_domain: int) -> Iterator[Peer]:
    with Cell({}, nodes=OWN, log_folder=tmp_path_factory.mktemp('logs')):
        peer = Peer()
        yield peer
        peer.close()


def test_nothing_is_computed_that_nobody_listens_to(peer: Peer) -> None:
    info = peer.reconstruct(stack_to_message(make_stack('unheard')))
    assert info.success
    assert {d.stage for d in info.durations} == {'convert', 'lights', 'normals', 'publish'}
    peer.listen('slope/image', Image)
    time.sleep(1.0)       # discovery of the new subscription
    info = peer.reconstruct(stack_to_message(make_stack('slope only')))
    assert {d.stage for d in info.durations} == {
        'convert', 'lights', 'normals', 'slope', 'publish'}


def test_images_are_those_of_the_pipeline(peer: Peer) -> None:
    for topic in ('slope', 'normal', 'albedo', 'height', 'curvature', 'shape', 'confidence',
                  'reason'):
        peer.listen(f'{topic}/image', Image)
        peer.listen(f'{topic}/camera_info', CameraInfo)
    peer.listen('normal/preview', Image)
    time.sleep(1.0)       # discovery of the new subscriptions
    stack = make_stack('first')
    message = stack_to_message(stack)
    info = peer.reconstruct(message)
    assert info.success, info.message
    assert (info.part_id, info.method, info.near_field) == ('plate', 'ls', True)
    assert info.header.stamp == message.header.stamp
    assert {'lights', 'normals', 'height', 'publish'} <= {d.stage for d in info.durations}
    peer.until(lambda: all(messages for topic, messages in peer.heard.items()
                           if topic.endswith(('/image', '/camera_info', '/preview'))))
    expected = reconstruct(stack, Options())
    for name, encoding in {
            'slope': '32FC2', 'normal': '32FC3', 'albedo': '32FC1', 'height': '32FC1',
            'curvature': '32FC1', 'shape': 'mono8', 'confidence': 'mono8',
            'reason': 'mono8'}.items():
        image = peer.heard[f'{name}/image'][-1]
        assert image.encoding == encoding
        assert image.header.stamp == message.header.stamp
        assert image.header.frame_id == OPTICAL_FRAME
        values = message_to_image(image)
        if name == 'normal':
            assert (values[..., 2] < 0).all()      # optical frame: towards the camera
            values = optical_to_plane(values)
        np.testing.assert_array_equal(values, getattr(expected, name), err_msg=name)
        camera = peer.heard[f'{name}/camera_info'][-1]
        assert camera.header == image.header
        assert camera.k[0] == stack.camera.fx    # type: ignore[union-attr]
    assert peer.heard['normal/preview'][-1].encoding == 'rgb8'


@pytest.mark.parametrize(('spoil', 'code'), [
    (lambda s: s.subset([0, 1]), ErrorCode.RECONSTRUCTION_TOO_FEW_LIGHTS),
    (lambda s: replace(s, lights=[s.lights[0]] * 4), ErrorCode.RECONSTRUCTION_DEGENERATE_LIGHTS),
    (lambda s: replace(s, mask=np.zeros(s.shape, bool)), ErrorCode.RECONSTRUCTION_BAD_STACK),
])
def test_bad_stack_is_answered_and_the_node_lives(
    peer: Peer, spoil: Callable[[Stack], Stack], code: ErrorCode,
) -> None:
    bad = peer.reconstruct(stack_to_message(spoil(make_stack(f'bad {int(code)}'))))
    assert not bad.success
    assert bad.error_code == code
    assert bad.message
    assert peer.reconstruct(stack_to_message(make_stack(f'good {int(code)}'))).success


def test_empty_message_is_answered(peer: Peer) -> None:
    answer = peer.reconstruct(PhotometricStack(stack_id='nothing'))
    assert answer.error_code == ErrorCode.RECONSTRUCTION_BAD_STACK


def test_parameters_hold_from_the_next_stack_on(peer: Peer) -> None:
    assert peer.set('outputs', text('roughness')).successful
    info = peer.reconstruct(stack_to_message(make_stack('rough')))
    assert info.roughness_sdq > 0
    assert peer.set('method', text('stv')).successful
    assert peer.reconstruct(stack_to_message(make_stack('robust'))).method == 'stv'
    assert peer.set('method', text('ls')).successful
    refused = peer.set('patch', ParameterValue(
        type=ParameterType.PARAMETER_INTEGER, integer_value=4))
    assert not refused.successful
    assert 'odd' in refused.reason
    refused = peer.set('method', text('guess'))
    assert not refused.successful
    assert 'ls, stv' in refused.reason
    refused = peer.set('outputs', text('gloss'))
    assert not refused.successful
    assert 'gloss' in refused.reason
    assert peer.set('outputs', text('')).successful
    assert np.isnan(peer.reconstruct(stack_to_message(make_stack('plain'))).roughness_sdq)


def test_newest_stack_wins_and_the_others_are_counted(peer: Peer) -> None:
    infos = peer.heard['reconstruction_info']
    before, count = len(infos), 8
    for number in range(count):
        peer.stack.publish(stack_to_message(make_stack(f'burst {number}', (1024, 1280))))
    peer.until(lambda: infos and infos[-1].stack_id == f'burst {count - 1}', 90)
    done = [info for info in infos[before:] if info.stack_id.startswith('burst')]
    assert all(info.success for info in done)
    assert infos[-1].dropped_stacks > 0
    peer.heard['diagnostics'].clear()
    peer.until(lambda: any(
        value.key == 'stacks dropped' and int(value.value) == infos[-1].dropped_stacks
        for status in peer.heard['diagnostics'] for value in status.values))
