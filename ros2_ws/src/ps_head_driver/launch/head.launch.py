"""Starts the head: driver, convergence radius and camera sequencer.

All arguments: ``ros2 launch ps_head_driver head.launch.py --show-args``.
"""
from launch import LaunchDescription

from ps_head_driver.graph import NODES
from ps_head_driver.launch_support import describe


def generate_launch_description() -> LaunchDescription:
    return describe(NODES, with_frames=True)
