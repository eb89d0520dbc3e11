"""Starts the ring calibration.

All arguments: ``ros2 launch ps_calibration calibration.launch.py --show-args``.
"""
from launch import LaunchDescription

from ps_calibration.graph import NODES
from ps_head_driver.launch_support import describe


def generate_launch_description() -> LaunchDescription:
    return describe(NODES)
