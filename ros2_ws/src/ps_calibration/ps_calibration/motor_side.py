"""From which side head_driver's motor arrives, chosen over ROS."""
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.ros_support import wait_for_future

_NAME = 'approach'
_ANSWER_S = 10.0


class MotorSide:
    """Parameter ``approach`` of head_driver.

    :param node: must spin in several threads; calls wait in its callbacks.
    """

    def __init__(self, node: Node) -> None:
        self._node, self._before = node, ''
        self._client = AsyncParameterClient(
            node, 'head_driver', callback_group=ReentrantCallbackGroup())

    @contextmanager
    def restored(self) -> Iterator[None]:
        """Whatever is chosen inside, afterwards the motor arrives from the same side as before."""
        self._before = ''
        try:
            yield
        finally:
            if self._before:
                try:
                    self._set(self._before)
                except PsError as error:      # what ended the calibration matters more
                    self._node.get_logger().error(
                        f'{error.message}; set it to {self._before!r} again')

    def choose(self, side: str) -> None:
        """Arrive from there from now on; only inside :meth:`restored`.

        :param side: up or down, the last direction of a move.
        :raises PsError: CALIBRATION_CAPTURE_FAILED if head_driver is not there or refuses.
        """
        if not self._before:
            if not self._client.wait_for_services(_ANSWER_S):
                raise _failed('is not there; is it running?')
            self._before = self._answer(
                self._client.get_parameters([_NAME])).values[0].string_value
        self._set(side)

    def _set(self, side: str) -> None:
        answer = self._answer(self._client.set_parameters([Parameter(_NAME, value=side)]))
        if not answer.results[0].successful:
            raise _failed(answer.results[0].reason)

    @staticmethod
    def _answer(future: Any) -> Any:
        answer = wait_for_future(future, _ANSWER_S)
        if answer is None:
            raise _failed(f'does not answer within {_ANSWER_S:g} s')
        return answer


def _failed(reason: str) -> PsError:
    return PsError(ErrorCode.CALIBRATION_CAPTURE_FAILED,
                   f'head_driver, parameter {_NAME}: {reason}')
