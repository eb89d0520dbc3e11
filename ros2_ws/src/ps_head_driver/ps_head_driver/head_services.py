"""The head driver's services and status as an acquisition wants them."""
from collections.abc import Callable, Sequence
import threading
import time
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from std_srvs.srv import Trigger

from ps_head_driver.conversions import message_to_light
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.ros_support import LATCHED, call, wait_for_future
from ps_head_driver.stack import Light
from ps_head_driver.strobe_program import StrobeStep
from ps_interfaces import msg as ps
from ps_interfaces.srv import RunStrobeProgram, SetIllumination

_SERVICE_S = 10.0           # for a service to appear
_LIGHT_ON_S = 2.0           # from the request of a program to the status that says so


class HeadServices:
    """See acquisition.Head.

    :param node: must spin in several threads; calls wait in its callbacks.
    :param timeouts: longest move, and longest wait for a program beyond its own duration, s; asked
        for at each call.
    """

    def __init__(self, node: Node, timeouts: Callable[[], tuple[float, float]]) -> None:
        self._timeouts = timeouts
        # replies and status must be able to arrive while a capture waits for them
        group = MutuallyExclusiveCallbackGroup()
        self._illuminate = node.create_client(
            SetIllumination, 'set_illumination', callback_group=group)
        self._run_program = node.create_client(
            RunStrobeProgram, 'head_driver/run_strobe_program', callback_group=group)
        self._stop = node.create_client(Trigger, 'head_driver/stop', callback_group=group)
        self._changed = threading.Condition()
        self._strobing = False
        node.create_subscription(
            ps.HeadStatus, 'head_status', self._on_status, LATCHED,
            callback_group=MutuallyExclusiveCallbackGroup())

    def _on_status(self, status: ps.HeadStatus) -> None:
        with self._changed:
            self._strobing = status.state == ps.HeadStatus.STROBING
            self._changed.notify_all()

    def set_convergence_radius(self, radius: float) -> None:
        """Move the bright-field panels to a CR, m."""
        self._ask(self._illuminate, SetIllumination.Request(
            by=SetIllumination.Request.BY_CONVERGENCE_RADIUS, convergence_radius=radius),
            self._timeouts()[0])

    def run(self, steps: Sequence[StrobeStep]) -> list[Light]:
        """Run a program; the lights as they really were."""
        answer = self._ask(self._run_program, _program(steps), self._longest(steps))
        return [message_to_light(light) for light in answer.lights]

    def start(self, step: StrobeStep) -> 'RunningProgram':
        """Run a program of one step; returns when its light is on."""
        with self._changed:      # a status of the program before this one must not be taken for it
            self._changed.wait_for(lambda: not self._strobing, _LIGHT_ON_S)
        if not self._run_program.wait_for_service(timeout_sec=_SERVICE_S):
            raise PsError(ErrorCode.SEQUENCER_HEAD_UNAVAILABLE,
                          f'service {self._run_program.srv_name} is not there; is its node '
                          'running?')
        lit_until_ns = time.time_ns() + round((step.settle + step.strobe_duration) * 1e9)
        future = self._run_program.call_async(_program([step]))
        future.add_done_callback(lambda _: self._wake())
        with self._changed:
            self._changed.wait_for(lambda: self._strobing or future.done(), _LIGHT_ON_S)
            lit = self._strobing
        running = RunningProgram(self, future, lit_until_ns, self._longest([step]))
        if not lit:
            if future.done():
                running.finish()      # says why
            self.stop()
            raise PsError(ErrorCode.SEQUENCER_HEAD_UNAVAILABLE,
                          f'head_status did not say within {_LIGHT_ON_S:g} s that light '
                          f'{step.name} is on')
        return running

    def stop(self) -> None:
        """Panels off and motor stopped; does not wait for the answer."""
        if self._stop.service_is_ready():
            self._stop.call_async(Trigger.Request())

    def _wake(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def _longest(self, steps: Sequence[StrobeStep]) -> float:
        return self._timeouts()[1] + sum(
            s.settle + s.strobe_duration + s.period for s in steps)

    def _ask(self, client: Any, request: Any, timeout: float) -> Any:
        try:
            answer = call(client, request, timeout, ErrorCode.SEQUENCER_HEAD_UNAVAILABLE)
        except PsError:
            self.stop()      # it may still be moving or flashing
            raise
        return _checked(answer)


class RunningProgram:
    """See acquisition.RunningProgram."""

    def __init__(self, head: HeadServices, future: Any, lit_until_ns: int, timeout: float) -> None:
        self._head, self._future, self._timeout = head, future, timeout
        self.lit_until_ns = lit_until_ns

    def finish(self) -> Light:
        """Wait for the end of the program; the light as it really was."""
        answer = wait_for_future(self._future, self._timeout)
        if answer is None:
            self._head.stop()
            raise PsError(ErrorCode.SEQUENCER_HEAD_UNAVAILABLE,
                          f'run_strobe_program did not answer within {self._timeout:g} s')
        return message_to_light(_checked(answer).lights[0])


def _program(steps: Sequence[StrobeStep]) -> RunStrobeProgram.Request:
    return RunStrobeProgram.Request(steps=[
        ps.StrobeStep(mode=int(s.mode), panel=int(s.panel), intensity=s.intensity,
                      settle=s.settle, strobe_duration=s.strobe_duration, period=s.period)
        for s in steps])


def _checked(answer: Any) -> Any:
    """The answer, or its refusal as an error."""
    if not answer.success:
        known = answer.error_code in ErrorCode._value2member_map_
        name = ErrorCode(answer.error_code).name if known else answer.error_code
        raise PsError(ErrorCode.SEQUENCER_HEAD_FAILED, f'head: {name}: {answer.message}')
    return answer
