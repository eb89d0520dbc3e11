"""One goal of an action as plain blocking calls, for CellClient."""
from collections.abc import Callable
import threading
from typing import Any

from ps_head_driver.action_client import ActionClient
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.ros_support import wait_for_future


class RunningGoal:
    """A goal that has been sent; the node must be spun by another thread.

    :param on_feedback: called with each feedback, from the spinning thread.
    :raises PsError: INSPECTION_INTERNAL if nobody serves the action.
    """

    def __init__(self, client: ActionClient, name: str, goal: Any,
                 on_feedback: Callable[[Any], None] = lambda _: None,
                 timeout: float = 10.0) -> None:
        self.feedback: list[Any] = []
        self._name, self._on_feedback = name, on_feedback
        self._changed = threading.Condition()
        if not client.wait_for_server(timeout):
            raise PsError(ErrorCode.INSPECTION_INTERNAL,
                          f'action {name} is not there; is its node running?')
        self._handle = self._done(client.send_goal_async(goal, self._keep), timeout)
        if not self._handle.accepted:
            raise PsError(ErrorCode.INSPECTION_INTERNAL, f'action {name} rejected the goal')
        self._result = self._handle.get_result_async()

    def _keep(self, message: Any) -> None:
        with self._changed:
            self.feedback.append(message.feedback)
            self._changed.notify_all()
        self._on_feedback(message.feedback)

    def _done(self, future: Any, timeout: float) -> Any:
        answer = wait_for_future(future, timeout)
        if answer is None:
            raise PsError(ErrorCode.INSPECTION_INTERNAL,
                          f'action {self._name}: no answer within {timeout:g} s')
        return answer

    def wait_for(self, condition: Callable[[Any], bool], timeout: float) -> bool:
        """Wait for a feedback of a kind; whether one came, also before."""
        with self._changed:
            return self._changed.wait_for(lambda: any(map(condition, self.feedback)), timeout)

    def cancel(self, timeout: float = 10.0) -> None:
        """Ask for the end; the result then says CANCELLED."""
        self._done(self._handle.cancel_goal_async(), timeout)

    def result(self, timeout: float = 60.0) -> Any:
        """The result, also one without success.

        :raises PsError: INSPECTION_INTERNAL if it does not come in time.
        """
        return self._done(self._result, timeout).result
