"""Stacks on request from camera_sequencer, for code that may wait."""
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
import threading
import time
from typing import Any

from rclpy.action import ActionClient
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.task import Future

from ps_head_driver import ros_support
from ps_head_driver.conversions import message_to_stack
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.stack import Stack
from ps_interfaces import msg as ps
from ps_interfaces.action import AcquireStack

_POLL_S = 0.05
_ANSWER_S = 10.0      # for what needs no motion


class StackSource:
    """Asks for stacks and receives them.

    :param cancelled: when set, whatever waits ends with CALIBRATION_CANCELLED, the capture too.
    """

    def __init__(self, node: Node, cancelled: threading.Event) -> None:
        self._node, self._cancelled = node, cancelled
        self._group = ReentrantCallbackGroup()
        self._client = ActionClient(node, AcquireStack, 'acquire_stack',
                                    callback_group=self._group)
        self._stacks: dict[str, ps.PhotometricStack] = {}

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Receive stacks: only inside, so that no picture is sent here in vain at other times."""
        subscription = self._node.create_subscription(
            ps.PhotometricStack, 'stack', self._on_stack, ros_support.RELIABLE,
            callback_group=self._group)
        try:
            yield
        finally:
            self._node.destroy_subscription(subscription)
            self._stacks.clear()

    def _on_stack(self, message: ps.PhotometricStack) -> None:
        self._stacks[message.stack_id] = message

    def check_cancelled(self) -> None:
        """:raises PsError: CALIBRATION_CANCELLED."""
        if self._cancelled.is_set():
            raise PsError(ErrorCode.CALIBRATION_CANCELLED, 'cancelled; nothing has been changed')

    def take(self, steps: Sequence[ps.LightStep], timeout: float,
             on_feedback: Callable[[Any], None]) -> Stack:
        """Take one stack and wait for it.

        :param timeout: for motion and exposures, s.
        :raises PsError: CALIBRATION_CAPTURE_FAILED with the sequencer's reason, or
            CALIBRATION_CANCELLED.
        """
        failed = ErrorCode.CALIBRATION_CAPTURE_FAILED
        if not self._client.wait_for_server(timeout_sec=_ANSWER_S):
            raise PsError(failed, 'action acquire_stack is not there; is camera_sequencer '
                                  'running?')
        # it may be published before the two have found each other: then once more
        for _ in range(2):
            self.check_cancelled()
            sending = self._client.send_goal_async(
                AcquireStack.Goal(steps=list(steps), part_id='ring calibration'),
                feedback_callback=lambda message: on_feedback(message.feedback))
            if not _wait(sending, time.monotonic() + _ANSWER_S):
                raise PsError(failed, 'camera_sequencer did not answer')
            result = self._result(sending.result(), timeout)
            if not result.success:
                raise PsError(failed, f'camera_sequencer: {result.message}')
            deadline = time.monotonic() + _ANSWER_S
            while time.monotonic() < deadline:
                self.check_cancelled()
                if result.stack_id in self._stacks:
                    return message_to_stack(self._stacks.pop(result.stack_id))
                time.sleep(_POLL_S)
        raise PsError(failed, f'stack {result.stack_id} was taken but did not arrive here')

    def _result(self, goal: Any, timeout: float) -> Any:
        """Result of a running capture; a cancel is passed on, and waited for."""
        getting = goal.get_result_async()
        arrived = _wait(getting, time.monotonic() + timeout, self._cancelled)
        if not arrived:
            goal.cancel_goal_async()
            _wait(getting, time.monotonic() + _ANSWER_S)
            self.check_cancelled()
            raise PsError(ErrorCode.CALIBRATION_CAPTURE_FAILED,
                          f'no stack within {timeout:g} s')
        return getting.result().result


def _wait(future: Future, deadline: float, cancelled: threading.Event | None = None) -> bool:
    """Wait in a thread that is not the executor's only one; whether it is done."""
    done = threading.Event()
    future.add_done_callback(lambda _: done.set())
    while not done.wait(_POLL_S):
        if time.monotonic() > deadline or (cancelled is not None and cancelled.is_set()):
            return False
    return True
