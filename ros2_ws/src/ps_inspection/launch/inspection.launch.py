"""Starts the whole cell, with the settings that large messages need.

``ros2 launch ps_inspection inspection.launch.py fake_hardware:=true``; all arguments:
``ros2 launch ps_inspection inspection.launch.py --show-args``.
"""
from launch import LaunchDescription

from ps_head_driver.graph import config_file
from ps_head_driver.launch_support import describe
from ps_inspection.environment import cell_environment
from ps_inspection.graph import NODES


def generate_launch_description() -> LaunchDescription:
    return describe(
        NODES, cell_environment(), with_frames=True,
        rviz_config=config_file('ps_inspection', 'ps_head.rviz'))
