"""The launch files against a stand-in for the launch system, which pip does not have.

The stand-in knows exactly the signatures that the files rely on, as documented for Jazzy:

* launch.LaunchDescription(initial_entities)
* launch.actions.DeclareLaunchArgument(name, *, default_value, description, choices)
* launch.actions.SetEnvironmentVariable(name, value)
* launch.actions.OpaqueFunction(*, function): function(context) -> list of actions
* launch.substitutions.LaunchConfiguration(variable_name).perform(context) -> str
* launch_ros.actions.Node(*, package, executable, namespace, parameters, output, arguments,
  ros_arguments)
* launch_ros.parameter_descriptions.ParameterValue(value, *, value_type)
"""
from dataclasses import dataclass, field
import importlib.util
from pathlib import Path
import sys
from types import ModuleType
from typing import Any

import pytest
import yaml

from ps_head_driver.graph import NodeSpec, arguments_of, resolve
from ps_head_driver.head_model import nominal_head_path
from ps_inspection.environment import cell_environment
from ps_inspection.graph import NODES

SOURCE = Path(__file__).resolve().parents[2]
NOMINAL_URDF = (SOURCE / 'ps_head_driver' / 'urdf' / 'ps_head.urdf').read_text()
LAUNCH_FILES = {
    'ps_head_driver/launch/head.launch.py': 'ps_head_driver.graph',
    'ps_reconstruction/launch/reconstruction.launch.py': 'ps_reconstruction.graph',
    'ps_calibration/launch/calibration.launch.py': 'ps_calibration.graph',
    'ps_inspection/launch/inspection.launch.py': 'ps_inspection.graph',
}


@dataclass
class LaunchContext:
    launch_configurations: dict[str, str] = field(default_factory=dict)


@dataclass
class LaunchDescription:
    initial_entities: list[Any]


@dataclass
class SetEnvironmentVariable:
    name: str
    value: str


class DeclareLaunchArgument:
    def __init__(self, name: str, *, default_value: str, description: str,
                 choices: list[str] | None = None) -> None:
        assert choices is None or default_value in choices
        self.name, self.default_value = name, default_value
        self.description, self.choices = description, choices


class OpaqueFunction:
    def __init__(self, *, function: Any) -> None:
        self.function = function


@dataclass
class LaunchConfiguration:
    variable_name: str

    def perform(self, context: LaunchContext) -> str:
        return context.launch_configurations[self.variable_name]


class ParameterValue:
    def __init__(self, value: Any, *, value_type: type) -> None:
        assert type(value) is value_type
        self.value = value


class Node:
    def __init__(self, *, package: str, executable: str, namespace: str, output: str,
                 parameters: list[Any] | None = None, arguments: list[str] | None = None,
                 ros_arguments: list[str] | None = None) -> None:
        assert output == 'screen'
        parameters = parameters or []
        self.package, self.executable, self.namespace = package, executable, namespace
        self.files = [p for p in parameters if isinstance(p, str)]
        self.values = {name: value.value for p in parameters if isinstance(p, dict)
                       for name, value in p.items()}
        self.arguments, self.ros_arguments = arguments or [], ros_arguments or []


@pytest.fixture
def launch_system(monkeypatch: pytest.MonkeyPatch) -> None:
    content: dict[str, tuple[type, ...]] = {
        'launch': (LaunchContext, LaunchDescription),
        'launch.actions': (DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable),
        'launch.substitutions': (LaunchConfiguration,),
        'launch_ros': (),
        'launch_ros.actions': (Node,),
        'launch_ros.parameter_descriptions': (ParameterValue,),
    }
    for name, classes in content.items():
        module = ModuleType(name)
        for member in classes:
            setattr(module, member.__name__, member)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.delitem(sys.modules, 'ps_head_driver.launch_support', raising=False)


def describe(file: str) -> LaunchDescription:
    spec = importlib.util.spec_from_file_location('launch_file', SOURCE / file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.generate_launch_description()


def execute(description: LaunchDescription, **given: str) -> tuple[list[Node], dict[str, str]]:
    """What launch does: (nodes, environment) of one launch with these arguments."""
    context, nodes, environment = LaunchContext(dict(given)), [], {}
    for entity in description.initial_entities:
        if isinstance(entity, DeclareLaunchArgument):
            value = context.launch_configurations.setdefault(entity.name, entity.default_value)
            assert entity.choices is None or value in entity.choices
        elif isinstance(entity, SetEnvironmentVariable):
            environment[entity.name] = entity.value
        else:
            nodes += entity.function(context)
    return nodes, environment


def with_config(nodes: tuple[NodeSpec, ...], tmp_path: Path) -> dict[str, str]:
    """A configuration file for every node, whatever is installed."""
    values = {}
    for node in nodes:
        path = tmp_path / f'{node.executable}.yaml'
        path.write_text('{}')
        values[node.config_argument] = str(path)
    return values


@pytest.mark.parametrize(('file', 'module'), LAUNCH_FILES.items())
@pytest.mark.parametrize('extra', [{}, {'namespace': 'left/head', 'params_file': __file__}])
def test_launch_starts_what_ps_cell_starts(
        launch_system: None, tmp_path: Path, file: str, module: str,
        extra: dict[str, str]) -> None:
    nodes = importlib.import_module(module).NODES
    given = with_config(nodes, tmp_path) | extra
    started, environment = execute(describe(file), **given)
    started = [node for node in started if node.package.startswith('ps_')]
    expected = resolve(nodes, given)
    assert [(n.package, n.executable, n.namespace, n.files, n.values) for n in started] == [
        (e.package, e.executable, e.namespace, [str(f) for f in e.parameter_files], e.parameters)
        for e in expected]
    assert [n.ros_arguments for n in started] == [['--enclave', e.enclave] for e in expected]
    assert environment == (cell_environment() if 'inspection' in file else {})


@pytest.mark.parametrize(('file', 'module'), LAUNCH_FILES.items())
def test_launch_declares_every_argument(launch_system: None, file: str, module: str) -> None:
    nodes = importlib.import_module(module).NODES
    declared = [(e.name, e.default_value) for e in describe(file).initial_entities
                if isinstance(e, DeclareLaunchArgument)]
    more = [('publish_frames', 'true')] if 'head.' in file or 'inspection' in file else []
    more += [('rviz', 'false')] if 'inspection' in file else []
    assert declared == [*((a.name, a.default) for a in arguments_of(nodes)), *more]


@pytest.mark.parametrize('file', [f for f in LAUNCH_FILES if 'head.' in f or 'inspection' in f])
def test_frames_follow_the_head_file(launch_system: None, tmp_path: Path, file: str) -> None:
    head_file = tmp_path / 'longer.yaml'
    head_file.write_text(nominal_head_path().read_text().replace('0.080', '0.123'))
    for given, expected in (({}, NOMINAL_URDF),
                            ({'head_file': str(head_file)}, 'xyz="0.123 0 0"')):
        nodes, _ = execute(describe(file), namespace='left/head', **given)
        publisher = next(n for n in nodes if n.package == 'robot_state_publisher')
        assert publisher.namespace == '/left/head'
        assert publisher.ros_arguments == ['--enclave', '/left/head/robot_state_publisher']
        assert expected in publisher.values['robot_description']
    nodes, _ = execute(describe(file), publish_frames='false')
    assert all(node.package.startswith('ps_') for node in nodes)


def test_rviz_is_started_in_the_namespace_of_the_cell(launch_system: None) -> None:
    nodes, _ = execute(describe('ps_inspection/launch/inspection.launch.py'), rviz='true')
    (rviz,) = (node for node in nodes if node.package == 'rviz2')
    assert rviz.namespace == '/ps_head'
    assert rviz.arguments[0] == '--display-config'
    assert Path(rviz.arguments[1]).is_file()


def test_arguments_reach_their_nodes(tmp_path: Path) -> None:
    given = with_config(NODES, tmp_path) | {
        'fake_hardware': 'True', 'camera': 'folder', 'input_folder': '/pictures', 'port': '12'}
    starts = {start.executable: start for start in resolve(NODES, given)}
    assert starts['head_driver'].parameters == {'fake_hardware': True, 'port': '12'}
    assert starts['camera_sequencer'].parameters == {
        'camera': 'folder', 'input_folder': '/pictures'}
    assert starts['session_recorder'].parameters == {}
    assert {start.namespace for start in starts.values()} == {'ps_head'}


def test_real_hardware_is_the_default(tmp_path: Path) -> None:
    starts = {s.executable: s for s in resolve(NODES, with_config(NODES, tmp_path))}
    assert starts['head_driver'].parameters == {'fake_hardware': False}


@pytest.mark.parametrize(('given', 'named'), [
    ({'nonsense': '1'}, 'nonsense'), ({'camera': 'usb'}, 'camera'),
    ({'fake_hardware': 'maybe'}, 'fake_hardware'), ({'namespace': 'a b'}, 'namespace'),
    ({'namespace': '1st'}, 'namespace'), ({'params_file': '/missing.yaml'}, 'params_file'),
    ({'head_driver_config': '/missing.yaml'}, 'head_driver_config')])
def test_wrong_arguments_are_named(tmp_path: Path, given: dict[str, str], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        resolve(NODES, with_config(NODES, tmp_path) | given)


@pytest.mark.parametrize('node', NODES, ids=lambda node: node.executable)
def test_configuration_file_fits_its_node(node: NodeSpec) -> None:
    """It exists, addresses the node in any namespace, and knows the arguments handed on."""
    content = yaml.safe_load(
        (SOURCE / node.package / 'config' / f'{node.executable}.yaml').read_text())
    parameters = content['/**'][node.executable]['ros__parameters']
    assert set(node.arguments) <= set(parameters)
    assert list(content) == ['/**']
    assert list(content['/**']) == [node.executable]


def test_executables_are_installed_under_their_names() -> None:
    for node in NODES:
        setup = (SOURCE / node.package / 'setup.py').read_text()
        assert f"'{node.executable} = {node.package}.nodes.{node.executable}:main'" in setup
