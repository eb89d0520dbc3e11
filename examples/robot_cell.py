"""A robot program: positions over a part, one inspection at each, the robot never waits in vain.

It uses nothing but the cell's public interface, the action `inspect`, so it can be copied as it
is. Start a cell, then the program; replace Robot by your robot's driver:

    ps_cell fake_hardware:=true scene:=weld
    python examples/robot_cell.py --positions 12
"""
import argparse
from contextlib import suppress
import json
from pathlib import Path
import threading
import time

from geometry_msgs.msg import PoseStamped
import rclpy
from rclpy.action import ActionClient
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from ps_interfaces.action import Inspect


class Robot:
    """Stands in for a robot: every move takes the same time."""

    def __init__(self, move_time: float) -> None:
        self.move_time = move_time

    def move_to(self, number: int) -> PoseStamped:
        """Bring the head over a position; returns where the head is then."""
        time.sleep(self.move_time)
        pose = PoseStamped()
        pose.header.frame_id = 'base_link'
        pose.pose.position.x, pose.pose.position.y = 0.04 * (number % 4), 0.03 * (number // 4)
        pose.pose.orientation.w = 1.0
        return pose


class Inspection:
    """One goal on its way."""

    def __init__(self, node: Node, client: ActionClient, goal: Inspect.Goal) -> None:
        self.started = time.monotonic()
        self.may_move, self.finished = threading.Event(), threading.Event()
        # sent by the thread that spins: rclpy can lose an answer that overtakes the sender
        node.executor.create_task(lambda: client.send_goal_async(
            goal, self._on_feedback).add_done_callback(self._on_accepted))

    def _on_feedback(self, message: object) -> None:
        if message.feedback.safe_to_move:
            self.may_move.set()

    def _on_accepted(self, future: object) -> None:
        future.result().get_result_async().add_done_callback(self._on_result)

    def _on_result(self, future: object) -> None:
        self.result, self.ended = future.result().result, time.monotonic()
        self.may_move.set()          # also after an error before the end of the exposures
        self.finished.set()


def run(node: Node, client: ActionClient, robot: Robot, positions: int) -> list[dict]:
    """Inspect all positions; one row a position, times in s."""
    inspections, rows, begin = [], [], time.monotonic()
    for number in range(positions):
        pose = robot.move_to(number)
        inspections.append(Inspection(node, client, Inspect.Goal(
            part_id=f'part-7/{number + 1}', head_pose=pose, outputs=['shape'],
            illumination=Inspect.Goal.GIVEN, convergence_radius=0.03)))
        if not inspections[-1].may_move.wait(120):
            raise TimeoutError(f'position {number + 1}: the cell does not answer')
        # the robot is off to the next position while this one is being reconstructed
        now = time.monotonic()
        rows.append({'position': number + 1, 'still': now - inspections[-1].started,
                     'cycle': now - begin})
        begin = now
    for row, inspection in zip(rows, inspections, strict=True):
        if not inspection.finished.wait(120):
            raise TimeoutError(f'position {row["position"]}: no result')
        result = inspection.result
        row |= {'result': inspection.ended - inspection.started, 'success': result.success,
                'message': result.message, 'stack_id': result.stack_id,
                'valid': result.info.valid_fraction, 'files': list(result.uris)}
    return rows


def main() -> int:
    """Run the program and print its times."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--positions', type=int, default=12)
    parser.add_argument('--move-time', type=float, default=0.8, help='of the robot, s')
    parser.add_argument('--namespace', default='ps_head', help='of the cell')
    parser.add_argument('--json', type=Path, help='write the rows to this file')
    options = parser.parse_args()
    rclpy.init()
    node = rclpy.create_node('robot_program', namespace=options.namespace)
    client = ActionClient(node, Inspect, 'inspect')

    def spin() -> None:
        with suppress(ExternalShutdownException):
            rclpy.spin(node)
    spinner = threading.Thread(target=spin)
    spinner.start()
    try:
        if not client.wait_for_server(timeout_sec=30):
            print('no cell: the action inspect is not there')
            return 1
        rows = run(node, client, Robot(options.move_time), options.positions)
    finally:
        rclpy.shutdown()
        spinner.join()
    print('position  still s  cycle s  result after s  valid')
    for row in rows:
        print(f'{row["position"]:8}{row["still"]:9.2f}{row["cycle"]:9.2f}{row["result"]:16.2f}'
              f'{row["valid"]:7.1%}  {row["message"]}')
    cycle = sum(row['cycle'] for row in rows) / len(rows)
    still = sum(row['still'] for row in rows) / sum(row['cycle'] for row in rows)
    print(f'{cycle:.2f} s a position; the robot stands still for {still:.0%} of the time')
    if options.json:
        options.json.write_text(json.dumps(rows, indent=2) + '\n')
    return 0 if all(row['success'] for row in rows) else 1


if __name__ == '__main__':
    raise SystemExit(main())
