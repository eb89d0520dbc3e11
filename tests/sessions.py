"""Sessions made without a graph, for several test files."""
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
from rclpy.serialization import serialize_message

from ps_head_driver.conversions import stack_to_message
from ps_head_driver.fake.renderer import make_renderer
from ps_head_driver.head_model import load_head, nominal_head_path
from ps_head_driver.kinematics import BrightFieldKinematics, lights_at
from ps_head_driver.stack import Pose, Stack
from ps_inspection.session_writer import SessionWriter, WriterOptions
from ps_reconstruction.session_format import STACK_TYPE, Topic, message_definition

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
