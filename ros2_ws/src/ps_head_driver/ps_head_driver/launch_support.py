"""What the launch files of all packages share: nodes as data to a LaunchDescription.

The only module that needs the launch system, which the pip installation of ROS 2 does not have.
"""
from collections.abc import Mapping, Sequence

from launch import LaunchContext, LaunchDescription  # type: ignore[attr-defined]
from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from ps_head_driver.graph import NodeSpec, arguments_of, resolve


def describe(
    nodes: Sequence[NodeSpec], environment: Mapping[str, str] | None = None,
) -> LaunchDescription:
    """Launch description that starts ``nodes`` with the arguments of ``arguments_of(nodes)``.

    :param environment: variables set for the nodes.
    """
    arguments = arguments_of(nodes)

    def start(context: LaunchContext) -> list[Node]:
        # resolved here and not by substitutions: an argument left empty must leave the
        # configuration file's value alone, which a parameter dictionary cannot express
        values = {argument.name: LaunchConfiguration(argument.name).perform(context)
                  for argument in arguments}
        return [
            Node(
                package=node.package, executable=node.executable,
                namespace=node.namespace or '/', output='screen',
                parameters=[
                    *map(str, node.parameter_files),
                    # typed: launch would read a text like 'on' or '0012' as YAML otherwise
                    *({name: ParameterValue(value, value_type=type(value))}
                      for name, value in node.parameters.items()),
                ])
            for node in resolve(nodes, values)
        ]

    return LaunchDescription([
        *(SetEnvironmentVariable(name, value) for name, value in (environment or {}).items()),
        *(DeclareLaunchArgument(
            argument.name, default_value=argument.default, description=argument.description,
            **({'choices': list(argument.choices)} if argument.choices else {}))
          for argument in arguments),
        OpaqueFunction(function=start),
    ])
