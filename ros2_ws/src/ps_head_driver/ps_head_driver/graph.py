"""Nodes and their launch arguments as plain data, stated once.

Launch files and the ps_cell runner both start what ``resolve`` returns, so they cannot drift
apart. Each package names its own nodes (``NODES``); ps_inspection.graph puts them together.
"""
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
import importlib.util
from pathlib import Path
import re
from typing import Any

DEFAULT_NAMESPACE = 'ps_head'


@dataclass(frozen=True)
class Argument:
    """One ``name:=value`` of a launch file or of ps_cell.

    An empty value means: as the node's configuration file says.
    """

    name: str
    default: str
    description: str
    choices: tuple[str, ...] = ()
    kind: type = str


@dataclass(frozen=True)
class NodeSpec:
    """One node: ``executable`` is its name, its module in ``package.nodes`` and its config file.

    :param arguments: those handed on as parameters of the same name.
    """

    package: str
    executable: str
    arguments: tuple[str, ...] = ()

    @property
    def config_argument(self) -> str:
        """Name of the argument that replaces the node's configuration file."""
        return f'{self.executable}_config'


@dataclass(frozen=True)
class NodeStart:
    """A node with everything decided: what a launcher has to start.

    :param parameter_files: YAML files, a later one wins.
    :param parameters: win over the files.
    """

    package: str
    executable: str
    namespace: str
    parameter_files: tuple[Path, ...]
    parameters: dict[str, Any] = field(default_factory=dict)

    @property
    def enclave(self) -> str:
        """Security enclave (SROS2) of the node: its own, so that its rights can be the least."""
        return f'/{self.namespace}/{self.executable}'.replace('//', '/')


HEAD_DRIVER = NodeSpec('ps_head_driver', 'head_driver', ('fake_hardware', 'port', 'head_file'))
NODES = (
    HEAD_DRIVER,
    NodeSpec('ps_head_driver', 'convergence_radius', ('head_file',)),
    NodeSpec('ps_head_driver', 'camera_sequencer',
             ('camera', 'input_folder', 'scene', 'head_file')),
)

_COMMON = (
    Argument('namespace', DEFAULT_NAMESPACE, 'namespace of all nodes'),
    Argument('params_file', '', 'one parameter file applied to every node, after its own'),
)
_HANDED_ON = {argument.name: argument for argument in (
    Argument('fake_hardware', 'false',
             'true: a firmware emulator instead of the head; false: the head on the serial port',
             ('true', 'false', 'True', 'False'), bool),
    Argument('port', '', 'serial port of the head'),
    Argument('head_file', '', 'description of the head (YAML)'),
    Argument('camera', '', 'camera back end: fake renders what the emulated head lights, folder '
             'plays pictures from input_folder, topic uses any ROS camera driver, genicam a GigE '
             'or USB3 Vision camera', ('', 'fake', 'folder', 'topic', 'genicam')),
    Argument('input_folder', '', 'stack or four-direction folder that camera:=folder plays'),
    Argument('scene', '', 'scene that camera:=fake renders'),
    Argument('calibration_file', '', 'head calibration that is active from the start'),
    Argument('session_folder', '', 'folder that sessions are recorded into'),
    Argument('output_folder', '', 'folder that files of inspections are written into'),
)}


def arguments_of(nodes: Sequence[NodeSpec]) -> tuple[Argument, ...]:
    """All arguments that a launch of these nodes takes, in the order of the nodes."""
    names = dict.fromkeys(name for node in nodes for name in node.arguments)
    configs = (Argument(node.config_argument, '',
                        f'parameter file of {node.executable} instead of the one installed')
               for node in nodes)
    return (*_COMMON, *(_HANDED_ON[name] for name in names), *configs)


def config_file(package: str, name: str) -> Path:
    """Path of a configuration file of one of our packages, installed or in the source tree.

    :raises ValueError: if the package or the file is not there.
    """
    spec = importlib.util.find_spec(package)
    if spec is None or spec.origin is None:
        raise ValueError(f'Python package {package} is not installed')
    folder = Path(spec.origin).resolve().parent
    for candidate in (folder.parent / 'config' / name, *(
            parent / 'share' / package / 'config' / name for parent in folder.parents)):
        if candidate.is_file():
            return candidate
    raise ValueError(f'{name} is not installed with {package}')


def resolve(nodes: Sequence[NodeSpec], values: Mapping[str, str]) -> list[NodeStart]:
    """Decide files and parameters of every node.

    :param values: argument name to value as text; a missing one has its default.
    :raises ValueError: unknown argument, value not among the choices, file that is not there; the
        message names the argument.
    """
    arguments = {argument.name: argument for argument in arguments_of(nodes)}
    unknown = sorted(set(values) - set(arguments))
    if unknown:
        raise ValueError(f'unknown argument {unknown[0]}; known: {", ".join(arguments)}')
    chosen = {name: values.get(name, argument.default) for name, argument in arguments.items()}
    for name, value in chosen.items():
        choices = arguments[name].choices
        if choices and value not in choices:
            allowed = ', '.join(choice for choice in choices if choice)
            raise ValueError(f'argument {name}: {value!r} is not one of {allowed}')
    namespace = chosen['namespace'].strip('/')
    if namespace and not re.fullmatch(r'[A-Za-z_]\w*(/[A-Za-z_]\w*)*', namespace, re.ASCII):
        raise ValueError(f'argument namespace: {namespace!r} is not a ROS name')

    starts = []
    for node in nodes:
        own = chosen[node.config_argument]
        files = [_existing(node.config_argument, own) if own
                 else config_file(node.package, f'{node.executable}.yaml')]
        if chosen['params_file']:
            files.append(_existing('params_file', chosen['params_file']))
        parameters: dict[str, Any] = {}
        for name in node.arguments:
            if chosen[name]:
                is_flag = arguments[name].kind is bool
                parameters[name] = chosen[name].lower() == 'true' if is_flag else chosen[name]
        starts.append(NodeStart(
            node.package, node.executable, namespace, tuple(files), parameters))
    return starts


def _existing(argument: str, path: str) -> Path:
    file = Path(path).expanduser().absolute()
    if not file.is_file():
        raise ValueError(f'argument {argument}: no file {file}')
    return file
