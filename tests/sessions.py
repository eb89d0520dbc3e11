"""Sessions made without a graph, for several test files."""
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
import numpy as np
from rclpy.serialization import serialize_message

from ps_head_driver.conversions import stack_to_message
from ps_head_driver.errors import ErrorCode
from ps_head_driver.fake.renderer import make_renderer
from ps_head_driver.head_model import load_head, nominal_head_path
from ps_head_driver.kinematics import BrightFieldKinematics, lights_at
from ps_head_driver.stack import Pose, Stack
from ps_inspection.session_writer import SessionWriter, WriterOptions
from ps_interfaces.msg import AcquisitionDone, HeadCalibration, HeadStatus
from ps_reconstruction.conversions import info_to_message
from ps_reconstruction.pipeline import reconstruct, warm_up
from ps_reconstruction.session_format import STACK_TYPE, TOPICS, Topic, message_definition

MOTOR_COUNTS, DARK_FIELD_TILT = 20_000, 1.3


@cache
def rendered(scene: str = 'boss', scale: float = 0.15) -> Stack:
    """Four bright-field frames of a scene."""
    head = load_head(nominal_head_path())
    renderer = make_renderer(scene, head, scale=scale)
    tilt = float(BrightFieldKinematics(head).tilt(MOTOR_COUNTS))
    return Stack(
        [renderer.render(tilt, DARK_FIELD_TILT, np.eye(4)[i], frame=i) for i in range(4)],
        lights_at(head, MOTOR_COUNTS, DARK_FIELD_TILT)[:4], renderer.camera, stack_id=scene,
        part_id='part 7', session_id='shift-1', stamp_ns=1_700_000_000_123_456_789,
        head_pose=Pose('base', (0.1, 0.2, 0.3), (0.0, 1.0, 0.0, 0.0)), convergence_radius=0.06,
        light_height=0.15)


def record(folder: Path, stacks: Sequence[Stack | bytes],
           provenance: dict[str, dict[str, str]] | None = None) -> Path:
    """Write a session of stacks, or of bytes in their place; returns its folder."""
    definition, type_hash = message_definition(STACK_TYPE)
    topic = Topic('/ps_head/stack', STACK_TYPE, definition=definition, type_hash=type_hash)
    writer = SessionWriter(folder, [topic], WriterOptions(min_free_bytes=0, sync=False),
                           provenance or {})
    for number, stack in enumerate(stacks):
        data = stack if isinstance(stack, bytes) else bytes(
            serialize_message(stack_to_message(stack)))
        assert writer.write(topic.name, data, number, number)
    writer.close()
    assert writer.error is None
    return folder


def shift(folder: Path, scale: float = 0.15, scenes: Sequence[str] = (
        'boss', 'scratches', 'weld', 'orange_peel', 'copper', 'disc')) -> Path:
    """A session as a cell records one: a part a scene, a failed capture, a head at fault."""
    topics = []
    for topic in TOPICS:
        definition, type_hash = message_definition(topic.type)
        name = topic.name if topic.name.startswith('/') else f'/ps_head/{topic.name}'
        topics.append(replace(topic, name=name, definition=definition, type_hash=type_hash))
    writer = SessionWriter(
        folder, topics, WriterOptions(min_free_bytes=0, sync=False),
        {'session': {'session_id': folder.name, 'part_id': '', 'notes': 'Trial <1> & "first"',
                     'created': '2026-03-04T05:06:07+00:00', 'software': 'ps_inspection 0.1.0',
                     'namespace': '/ps_head'},
         'parameters/reconstruction': {'method': 'ls', 'smoothness': '1.0'}})
    warm_up()       # else the first time is that of the compiler
    now = 1_772_600_767_000_000_000

    def send(kind: str, message: object, seconds: float) -> None:
        nonlocal now
        now += round(seconds * 1e9)
        topic = next(topic for topic in topics if topic.type.endswith(f'/{kind}'))
        assert writer.write(topic.name, bytes(serialize_message(message)), now, now)

    def status(state: int, seconds: float, code: ErrorCode = ErrorCode.NONE,
               text: str = '') -> None:
        send('HeadStatus', HeadStatus(state=state, error_code=int(code), message=text), seconds)

    send('HeadCalibration', HeadCalibration(
        calibration_id='cal-7', head_serial='PS-0042', verdict=HeadCalibration.VERDICT_OK,
        target_name='half ring'), 0)
    status(HeadStatus.READY, 0)
    for number, scene in enumerate(scenes):
        stack = replace(rendered(scene, scale), stack_id=f'{number:04d}-{scene}', part_id=scene,
                        session_id=folder.name, calibration_id='cal-7',
                        head_pose=Pose('base', (0.1 * number, 0.25, 0.3), (0.0, 1.0, 0.0, 0.0)))
        status(HeadStatus.MOVING, 0.4)
        status(HeadStatus.STROBING, 0.3)
        if number == 2:
            send('AcquisitionDone', AcquisitionDone(
                stack_id='lost', success=False, error_code=int(ErrorCode.SEQUENCER_FRAME_MISSING),
                message='3 frames for 4 triggers'), 0.2)
            status(HeadStatus.FAULT, 0.1, ErrorCode.HEAD_LED_OPEN, 'panel BF_N draws no current')
            send('DiagnosticArray', DiagnosticArray(status=[DiagnosticStatus(
                level=b'\2', name='ps_head/head_driver: Head', message='panel BF_N open')]), 0.1)
            status(HeadStatus.READY, 1.2)
            send('DiagnosticArray', DiagnosticArray(status=[DiagnosticStatus(
                level=b'\0', name='ps_head/head_driver: Head', message='ok')]), 0.1)
        send('AcquisitionDone', AcquisitionDone(stack_id=stack.stack_id, success=True), 0.25)
        status(HeadStatus.READY, 0.01)
        message = stack_to_message(stack)
        send('PhotometricStack', message, 0.03)
        send('ReconstructionInfo', info_to_message(message, reconstruct(stack), None, 'ls', 0),
             0.3)
    writer.close()
    assert writer.error is None
    return folder
