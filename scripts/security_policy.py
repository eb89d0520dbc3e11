"""Write the access policy of the cell from a running one on fake hardware.

Usage, after `. ./env.sh`: python scripts/security_policy.py. A test compares the file with the
running graph, so it cannot go stale.
"""
import os
from pathlib import Path
import tempfile

from rclpy.context import Context
from rclpy.node import Node

from ps_inspection.access_policy import running_rights, to_xml, with_on_demand
from ps_inspection.runner import Cell

ROOT = Path(__file__).resolve().parents[1]
POLICY = ROOT / 'ros2_ws/src/ps_inspection/config/security/cell.policy.xml'
COMMENT = ('Rights of the nodes of a cell in the namespace /ps_head, as they use them. '
           'Made by scripts/security_policy.py; do not edit.')


def main() -> None:
    """Start a cell, look, write."""
    os.environ.setdefault('ROS_DOMAIN_ID', '101')
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    with tempfile.TemporaryDirectory() as folder, Cell(
            {'fake_hardware': 'true', 'session_folder': folder}) as cell:
        context = Context()
        context.init()
        observer = Node('policy_observer', context=context, enable_rosout=False,
                        start_parameter_services=False)
        try:
            rights = running_rights(observer, [node.name for node in cell.processes])
        finally:
            observer.destroy_node()
            context.try_shutdown()
    POLICY.write_text(to_xml(map(with_on_demand, rights), COMMENT), encoding='utf-8')
    print(f'{POLICY.relative_to(ROOT)}: {len(rights)} nodes')


if __name__ == '__main__':
    main()
