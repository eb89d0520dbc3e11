"""What the running cell really has: rights in the access policy, topics in the viewers' files."""
from collections.abc import Callable, Iterator
import importlib
import json
from pathlib import Path
import re
import subprocess
import sys
import time
from typing import Any

import pytest
import yaml

pytest.importorskip('rclpy')

from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState

from ps_head_driver.ros_support import LATCHED, RELIABLE
from ps_inspection.access_policy import (
    ON_DEMAND,
    Rights,
    from_xml,
    running_rights,
    with_on_demand,
)
from ps_inspection.graph import NODES
from ps_inspection.runner import Cell
from ps_interfaces.msg import HeadCalibration, HeadStatus

pytestmark = [pytest.mark.graph, pytest.mark.usefixtures('ros_domain')]
CONFIG = Path(__file__).resolve().parents[1] / 'ros2_ws/src/ps_inspection/config'
LAYOUT = json.loads((CONFIG / 'foxglove_layout.json').read_text())
RVIZ = yaml.safe_load((CONFIG / 'ps_head.rviz').read_text())
POLICY = from_xml((CONFIG / 'security' / 'cell.policy.xml').read_text())
CLIENTS = from_xml((CONFIG / 'security' / 'clients.policy.xml').read_text())
# of ROS itself, or of robot_state_publisher, which only a ROS installation has
OTHERS = {'/tf', '/tf_static', '/ps_head/robot_description', '/rosout', '/parameter_events'}


@pytest.fixture(scope='module')
def cell(ros_domain: int, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    folder = tmp_path_factory.mktemp('cell')
    with Cell({'fake_hardware': 'true', 'session_folder': str(folder / 'sessions')},
              log_folder=folder / 'logs', ready_timeout=180.0) as running:
        yield running
        running.check()


@pytest.fixture(scope='module')
def observer(cell: Cell) -> Iterator[Node]:
    context = Context()
    context.init()
    node = Node('policy_observer', context=context, enable_rosout=False,
                start_parameter_services=False)
    yield node
    node.destroy_node()
    context.try_shutdown()


@pytest.fixture(scope='module')
def rights(cell: Cell, observer: Node) -> dict[str, Rights]:
    names = [node.name for node in cell.processes]
    return {each.node: each for each in running_rights(observer, names)}


@pytest.fixture(scope='module')
def published(rights: dict[str, Rights]) -> set[str]:
    return {name for each in rights.values() for name in each.absolute('publish')} | OTHERS


@pytest.mark.parametrize('node', [node.executable for node in NODES])
def test_policy_allows_exactly_what_the_node_uses(rights: dict[str, Rights], node: str) -> None:
    allowed = {each.node: each for each in POLICY}
    assert set(allowed) == set(rights), 'run scripts/security_policy.py'
    assert allowed[node] == with_on_demand(rights[node]), 'run scripts/security_policy.py'
    assert rights[node].enclave == f'/ps_head/{node}'


def test_rights_on_demand_are_used_by_the_camera_on_a_topic(
        observer: Node, tmp_path: Path) -> None:
    """In a namespace of its own, beside the cell."""
    (sequencer,) = (spec for spec in NODES if spec.executable == 'camera_sequencer')
    with Cell({'camera': 'topic', 'namespace': 'other'}, [sequencer], tmp_path):
        (found,) = running_rights(observer, ['camera_sequencer'], namespace='/other')
    wanted = {name for node, kind, name in ON_DEMAND if node == 'camera_sequencer'}
    assert wanted <= found.subscribe


@pytest.mark.parametrize('client', CLIENTS, ids=lambda client: client.node)
def test_clients_ask_for_what_there_is(
        rights: dict[str, Rights], published: set[str], client: Rights) -> None:
    served = {name for each in rights.values() for name in each.absolute('reply')}
    actions = {name for each in rights.values() for name in each.absolute('execute')}
    own = client.absolute('publish')
    assert client.absolute('subscribe') <= published | own | {'/ps_head/joint_states'}
    assert client.absolute('request') <= served
    assert client.absolute('call') <= actions


def received(observer: Node, kind: type, topic: str, profile: QoSProfile, wanted: Callable) -> Any:
    """First message that is wanted, within half a minute."""
    found: list[Any] = []
    subscription = observer.create_subscription(
        kind, topic, lambda message: found.append(message) if wanted(message) else None, profile)
    executor = SingleThreadedExecutor(context=observer.context)
    executor.add_node(observer)
    end = time.monotonic() + 30.0
    while not found and time.monotonic() < end:
        executor.spin_once(timeout_sec=0.1)
    executor.remove_node(observer)
    observer.destroy_subscription(subscription)
    assert found, f'nothing on {topic}'
    return found[0]


def test_joints_stand_where_the_head_says(observer: Node) -> None:
    status = received(observer, HeadStatus, '/ps_head/head_status', LATCHED,
                      lambda message: message.state == HeadStatus.READY)
    joints = received(observer, JointState, '/ps_head/joint_states', RELIABLE, lambda _: True)
    assert dict(zip(joints.name, joints.position, strict=True)) == pytest.approx({
        'ps_head_bf_e_tilt': status.tilt, 'ps_head_df_e_tilt': status.dark_field_tilt}, abs=1e-3)


def test_calibration_topic_has_the_frames_also_without_calibration(observer: Node) -> None:
    message = received(observer, HeadCalibration, '/ps_head/calibration', LATCHED, lambda _: True)
    assert message.calibration_id == ''
    assert [transform.child_frame_id for transform in message.transforms] == [
        'ps_head_camera_link', 'ps_head_camera_optical_frame', 'ps_head_plane']


def topic_paths() -> dict[str, str]:
    """Topics that the Foxglove layout shows: topic to the field that is read, or empty."""
    found = {}
    for content in LAYOUT['configById'].values():
        names = [content.get('topicPath'), content.get('topicToRender')]
        names += [content.get('imageMode', {}).get(key)
                  for key in ('imageTopic', 'calibrationTopic')]
        names += [path['value'] for path in content.get('paths', [])]
        names += [layer.get('topic') for layer in content.get('layers', {}).values()]
        for name in filter(None, names):
            topic, _, field = name.partition('.')
            found[name] = field
            assert topic.startswith('/')
    return found


def test_foxglove_shows_topics_and_fields_of_the_cell(observer: Node, published: set[str]) -> None:
    types = dict(observer.get_topic_names_and_types())
    for name, field in topic_paths().items():
        topic = name.partition('.')[0]
        assert topic in published, topic
        if field:
            package, _, kind = types[topic][0].split('/')
            message = getattr(importlib.import_module(f'{package}.msg'), kind)
            assert field in message.get_fields_and_field_types(), name


def test_rviz_shows_topics_of_the_cell(published: set[str]) -> None:
    topics = [display[key]['Value'] for display in RVIZ['Visualization Manager']['Displays']
              for key in ('Topic', 'Description Topic') if key in display]
    assert len(topics) > 3
    assert {f'/ps_head/{topic}' for topic in topics} <= published


def test_viewer_may_see_what_the_files_show(observer: Node) -> None:
    (viewer,) = (client for client in CLIENTS if client.node == 'viewer')
    shown = {name.partition('.')[0] for name in topic_paths()}
    shown |= {f'/ps_head/{display["Topic"]["Value"]}' for display in
              RVIZ['Visualization Manager']['Displays'] if 'Topic' in display}
    assert shown <= viewer.absolute('subscribe')


def test_program_of_the_readme_runs(cell: Cell, tmp_path: Path) -> None:
    readme = (CONFIG.parents[3] / 'README.md').read_text()
    blocks = re.findall(r'```python\n(.*?)```', readme, re.S)
    (program,) = (block for block in blocks if 'CellClient(' in block)
    script = tmp_path / 'program.py'
    script.write_text(program)
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=120,
                          check=False)
    assert done.returncode == 0, done.stderr
    assert re.fullmatch(r'1280 x 1024 pixels, \d+% valid\n', done.stdout)
