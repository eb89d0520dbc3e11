"""Starts the reconstruction.

All arguments: ``ros2 launch ps_reconstruction reconstruction.launch.py --show-args``.
"""
from launch import LaunchDescription

from ps_head_driver.launch_support import describe
from ps_reconstruction.graph import NODES


def generate_launch_description() -> LaunchDescription:
    return describe(NODES)
