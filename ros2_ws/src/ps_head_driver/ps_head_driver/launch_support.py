"""What the launch files of all packages share: nodes as data to a LaunchDescription.

The only module that needs the launch system, which the pip installation of ROS 2 does not have.
"""
from collections.abc import Mapping, Sequence
from pathlib import Path

from launch import LaunchContext, LaunchDescription  # type: ignore[attr-defined]
from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from ps_head_driver.graph import Argument, NodeSpec, arguments_of, resolve
from ps_head_driver.head_model import load_head, nominal_head_path
from ps_head_driver.urdf import head_urdf

# only for launch files: these need packages that the pip installation of ROS 2 does not have
FRAMES_ARGUMENT = Argument(
    'publish_frames', 'true', 'start robot_state_publisher with the description of the head; '
    'false where the description of the cell includes the head', ('true', 'false'))
RVIZ_ARGUMENT = Argument('rviz', 'false', 'start RViz with the display of the cell',
                         ('true', 'false'))


def describe(
    nodes: Sequence[NodeSpec], environment: Mapping[str, str] | None = None,
    with_frames: bool = False, rviz_config: Path | None = None,
) -> LaunchDescription:
    """Launch description that starts ``nodes`` with the arguments of ``arguments_of(nodes)``.

    :param environment: variables set for the nodes.
    :param with_frames: also declare ``publish_frames``: the frames of the head on /tf, /tf_static.
    :param rviz_config: also declare ``rviz``: RViz with this configuration.
    """
    arguments = [*arguments_of(nodes), *([FRAMES_ARGUMENT] if with_frames else []),
                 *([RVIZ_ARGUMENT] if rviz_config else [])]

    def start(context: LaunchContext) -> list[Node]:
        # resolved here and not by substitutions: an argument left empty must leave the
        # configuration file's value alone, which a parameter dictionary cannot express
        values = {argument.name: LaunchConfiguration(argument.name).perform(context)
                  for argument in arguments}
        publish_frames = values.pop(FRAMES_ARGUMENT.name, 'false') == 'true'
        rviz = values.pop(RVIZ_ARGUMENT.name, 'false') == 'true'
        starts = resolve(nodes, values)
        actions = [
            Node(
                package=node.package, executable=node.executable,
                namespace=node.namespace or '/', output='screen',
                parameters=[
                    *map(str, node.parameter_files),
                    # typed: launch would read a text like 'on' or '0012' as YAML otherwise
                    *({name: ParameterValue(value, value_type=type(value))}
                      for name, value in node.parameters.items()),
                ],
                ros_arguments=['--enclave', node.enclave])
            for node in starts
        ]
        namespace = f'/{starts[0].namespace}'
        if publish_frames:
            actions.append(_state_publisher(namespace, values['head_file']))
        if rviz:
            # relative topic names of the configuration are then those of the cell
            actions.append(Node(
                package='rviz2', executable='rviz2', namespace=namespace, output='screen',
                arguments=['--display-config', str(rviz_config)],
                ros_arguments=['--enclave', f'{namespace.rstrip("/")}/viewer']))
        return actions

    return LaunchDescription([
        *(SetEnvironmentVariable(name, value) for name, value in (environment or {}).items()),
        *(DeclareLaunchArgument(
            argument.name, default_value=argument.default, description=argument.description,
            **({'choices': list(argument.choices)} if argument.choices else {}))
          for argument in arguments),
        OpaqueFunction(function=start),
    ])


def _state_publisher(namespace: str, head_file: str) -> Node:
    path = Path(head_file or nominal_head_path())
    description = head_urdf(load_head(path), path.name)
    return Node(
        package='robot_state_publisher', executable='robot_state_publisher', namespace=namespace,
        output='screen', parameters=[
            {'robot_description': ParameterValue(description, value_type=str)}],
        ros_arguments=['--enclave', f'{namespace.rstrip("/")}/robot_state_publisher'])
