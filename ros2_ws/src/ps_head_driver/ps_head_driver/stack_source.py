"""Stacks on request from camera_sequencer, for code that may wait."""
from collections.abc import Callable, Iterator
from contextlib import contextmanager
import threading
import time
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.task import Future

from ps_head_driver import ros_support
from ps_head_driver.action_client import ActionClient
from ps_head_driver.conversions import message_to_stack
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.stack import Stack
from ps_interfaces import msg as ps
from ps_interfaces.action import AcquireStack

_POLL_S = 0.05
_ANSWER_S = 10.0      # for what needs no motion


Cancelled = Callable[[], bool]     # asked again and again; once true, whatever waits ends


class StackSource:
    """Asks for stacks and receives them.

    :param failed: code of a capture that did not succeed.
    :param stopped: code of one that was cancelled; panels are off then.
    """

    def __init__(self, node: Node, failed: ErrorCode, stopped: ErrorCode) -> None:
        self._node, self._failed, self._stopped = node, failed, stopped
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

    def check(self, cancelled: Cancelled) -> None:
        """:raises PsError: stopped, once cancelled."""
        if cancelled():
            raise PsError(self._stopped, 'cancelled; nothing has been changed')

    def capture(self, goal: AcquireStack.Goal, timeout: float, cancelled: Cancelled,
                on_feedback: Callable[[Any], None] = lambda _: None) -> AcquireStack.Result:
        """Take one stack and wait until it has been published.

        :param timeout: for motion and exposures, s.
        :raises PsError: failed, with the sequencer's reason, or stopped.
        """
        if not self._client.wait_for_server(timeout_sec=_ANSWER_S):
            raise PsError(self._failed, 'action acquire_stack is not there; is camera_sequencer '
                                        'running?')
        self.check(cancelled)
        sending = self._client.send_goal_async(
            goal, feedback_callback=lambda message: on_feedback(message.feedback))
        if not wait(sending, _ANSWER_S):
            raise PsError(self._failed, 'camera_sequencer did not answer')
        getting = sending.result().get_result_async()
        if not wait(getting, timeout, cancelled):
            sending.result().cancel_goal_async()
            wait(getting, _ANSWER_S)
            self.check(cancelled)
            raise PsError(self._failed, f'no stack within {timeout:g} s')
        result = getting.result().result
        if not result.success:
            raise PsError(self._failed, f'camera_sequencer: {result.message}')
        return result

    def take(self, goal: AcquireStack.Goal, timeout: float, cancelled: Cancelled,
             on_feedback: Callable[[Any], None] = lambda _: None) -> Stack:
        """Take one stack and receive it; only inside :meth:`listening`. As :meth:`capture`."""
        # it may be published before the two have found each other: then once more
        for _ in range(2):
            result = self.capture(goal, timeout, cancelled, on_feedback)
            deadline = time.monotonic() + _ANSWER_S
            while time.monotonic() < deadline:
                self.check(cancelled)
                if result.stack_id in self._stacks:
                    return message_to_stack(self._stacks.pop(result.stack_id))
                time.sleep(_POLL_S)
        raise PsError(self._failed, f'stack {result.stack_id} was taken but did not arrive here')


def wait(future: Future, timeout: float, cancelled: Cancelled = lambda: False) -> bool:
    """Wait in a thread that is not the executor's only one; whether it is done.

    :param timeout: s.
    """
    done, deadline = threading.Event(), time.monotonic() + timeout
    future.add_done_callback(lambda _: done.set())
    while not done.wait(_POLL_S):
        if time.monotonic() > deadline or cancelled():
            return False
    return True
