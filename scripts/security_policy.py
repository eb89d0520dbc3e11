"""Write the access policy of the cell from a running one on fake hardware.

Usage, after `. ./env.sh`: python scripts/security_policy.py. A test compares the file with the
running graph, so it cannot go stale.
"""
import os
from pathlib import Path
import tempfile
import time

from rclpy.context import Context
from rclpy.node import Node

from ps_inspection.access_policy import Rights, rights_of, to_xml, with_on_demand
from ps_inspection.runner import Cell

ROOT = Path(__file__).resolve().parents[1]
POLICY = ROOT / 'ros2_ws/src/ps_inspection/config/security/cell.policy.xml'
COMMENT = ('Rights of the nodes of a cell in the namespace /ps_head, as they use them. '
           'Made by scripts/security_policy.py; do not edit.')


def running_rights(cell: Cell, settle: float = 3.0) -> list[Rights]:
    """Rights of all nodes of a running cell, looked at until they no longer change."""
    context = Context()
    context.init()
    observer = Node('policy_observer', context=context, enable_rosout=False,
                    start_parameter_services=False)
    try:
        wanted = {process.start.executable: process.start for process in cell.processes}
        before: list[Rights] = []
        since = time.monotonic()
        while time.monotonic() - since < settle:
            enclaves = {name: (namespace, enclave) for name, namespace, enclave
                        in observer.get_node_names_and_namespaces_with_enclaves()
                        if name in wanted}
            now = [rights_of(observer, name, *enclaves[name]) for name in sorted(enclaves)]
            if now != before or len(now) < len(wanted):
                before, since = now, time.monotonic()
            time.sleep(0.1)
        return before
    finally:
        observer.destroy_node()
        context.try_shutdown()


def main() -> None:
    """Start a cell, look, write."""
    os.environ.setdefault('ROS_DOMAIN_ID', '101')
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    with tempfile.TemporaryDirectory() as folder, Cell(
            {'fake_hardware': 'true', 'session_folder': folder}) as cell:
        rights = [with_on_demand(each) for each in running_rights(cell)]
    POLICY.parent.mkdir(parents=True, exist_ok=True)
    POLICY.write_text(to_xml(rights, COMMENT), encoding='utf-8')
    print(f'{POLICY.relative_to(ROOT)}: {len(rights)} nodes')


if __name__ == '__main__':
    main()
