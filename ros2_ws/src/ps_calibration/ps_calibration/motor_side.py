"""From which side head_driver's motor arrives, chosen over ROS."""
from collections.abc import Iterator
from contextlib import contextmanager

from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.parameter import Parameter

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.ros_support import call

_NAME = 'approach'
_ANSWER_S = 10.0
_FAILED = ErrorCode.CALIBRATION_CAPTURE_FAILED


class MotorSide:
    """Parameter ``approach`` of head_driver.

    :param node: must spin in several threads; calls wait in its callbacks.
    """

    def __init__(self, node: Node) -> None:
        self._node, self._before = node, ''
        group = ReentrantCallbackGroup()
        self._reader = node.create_client(
            GetParameters, 'head_driver/get_parameters', callback_group=group)
        self._writer = node.create_client(
            SetParameters, 'head_driver/set_parameters', callback_group=group)

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
                        f"{error.message}; set head_driver's {_NAME} to {self._before} again")

    def choose(self, side: str) -> None:
        """Arrive from there from now on; only inside :meth:`restored`.

        :param side: up or down, the last direction of a move.
        :raises PsError: CALIBRATION_CAPTURE_FAILED if head_driver is not there or refuses.
        """
        if not self._before:
            request = GetParameters.Request(names=[_NAME])
            self._before = call(self._reader, request, _ANSWER_S, _FAILED).values[0].string_value
        self._set(side)

    def _set(self, side: str) -> None:
        request = SetParameters.Request(
            parameters=[Parameter(_NAME, value=side).to_parameter_msg()])
        result, = call(self._writer, request, _ANSWER_S, _FAILED).results
        if not result.successful:
            raise PsError(_FAILED, f'head_driver: parameter {_NAME}: {result.reason}')
