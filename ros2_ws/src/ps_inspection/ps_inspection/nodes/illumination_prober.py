"""Runs an illumination search on the head: settings from the CR service, stacks from captures."""
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from std_srvs.srv import Trigger

from ps_head_driver.conversions import message_to_light
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.ros_support import call
from ps_head_driver.stack import Mode, Panel
from ps_head_driver.stack_source import Cancelled, StackSource, wait
from ps_inspection.illumination_score import Region
from ps_inspection.illumination_search import BUDGET, IlluminationSearch, Setting
from ps_interfaces import msg as ps
from ps_interfaces.action import AcquireStack
from ps_interfaces.srv import SetIllumination, SolveConvergenceRadius

RING = (Panel.E, Panel.N, Panel.W, Panel.S)
POSITIONS = 17           # of the motor that a search chooses from
_ANSWER_S, _MOVE_S = 10.0, 60.0
_ANY_CR = 0.06           # m; asked for only to learn what is reachable
_LEAST_CR = 0.001        # m; where nobody says, the steps of the motor are too coarse for less


@dataclass(frozen=True)
class Request:
    """What to search; the fields are those of SearchIllumination."""

    modes: Sequence[int] = ()
    cr_min: float = 0.0
    cr_max: float = 0.0
    budget: int = 0
    exposure_time: float = 0.0
    region: Region = Region()  # noqa: RUF009


def ring_steps(mode: int, convergence_radius: float, exposure_time: float) -> list[ps.LightStep]:
    """The four panels of a ring as steps of acquire_stack."""
    return [ps.LightStep(mode=mode, panel=int(panel), convergence_radius=convergence_radius,
                         exposure_time=exposure_time) for panel in RING]


class IlluminationProber:
    """Searches with real captures.

    :param source: takes the stacks.
    """

    def __init__(self, node: Node, source: StackSource) -> None:
        self._source = source
        clients = MutuallyExclusiveCallbackGroup()
        self._solve = node.create_client(
            SolveConvergenceRadius, 'solve_convergence_radius', callback_group=clients)
        self._illuminate = node.create_client(
            SetIllumination, 'set_illumination', callback_group=clients)
        self._stop = node.create_client(Trigger, 'head_driver/stop', callback_group=clients)

    def search(self, request: Request, timeout: float, cancelled: Cancelled,
               on_probe: Callable[[IlluminationSearch], None] = lambda _: None
               ) -> IlluminationSearch:
        """Search; the head stays where the last probe was.

        :param timeout: for each capture, s.
        :param on_probe: called after each probe.
        :raises PsError: INSPECTION_BAD_REQUEST, _CANCELLED or _CAPTURE_FAILED, CR_* for an
            interval that is not reachable, RECONSTRUCTION_* for pictures that cannot be used.
        """
        search = IlluminationSearch(self._settings(request), request.budget or BUDGET,
                                    request.region)
        with self._source.listening():
            while (setting := search.next()) is not None:
                bright = setting.mode == Mode.BRIGHT_FIELD
                goal = AcquireStack.Goal(part_id='illumination search', steps=ring_steps(
                    int(setting.mode), setting.convergence_radius if bright else 0.0,
                    request.exposure_time))
                search.add(setting, self._source.take(goal, timeout, cancelled))
                on_probe(search)
        return search

    def move_to(self, setting: Setting, cancelled: Cancelled) -> None:
        """Move the panels to a setting.

        :raises PsError: HEAD_* or INSPECTION_CANCELLED.
        """
        moving = self._illuminate.call_async(SetIllumination.Request(
            by=SetIllumination.Request.BY_CONVERGENCE_RADIUS,
            convergence_radius=setting.convergence_radius))
        if not wait(moving, _MOVE_S, cancelled):
            if self._stop.service_is_ready():
                self._stop.call_async(Trigger.Request())
            self._source.check(cancelled)
            raise PsError(ErrorCode.INSPECTION_CAPTURE_FAILED,
                          'set_illumination did not answer')
        _checked(moving.result())

    def _settings(self, request: Request) -> list[Setting]:
        modes = sorted(set(request.modes)) or [int(Mode.BRIGHT_FIELD), int(Mode.DARK_FIELD)]
        if not set(modes) <= {int(Mode.BRIGHT_FIELD), int(Mode.DARK_FIELD)}:
            raise PsError(ErrorCode.INSPECTION_BAD_REQUEST,
                          f'modes: {modes} must be BRIGHT_FIELD (0) or DARK_FIELD (1)')
        settings = []
        if Mode.BRIGHT_FIELD in modes:
            settings += self._bright(request.cr_min, request.cr_max)
        if Mode.DARK_FIELD in modes:
            now = _checked(self._ask(self._illuminate, SetIllumination.Request(
                by=SetIllumination.Request.KEEP)))
            settings.append(Setting(Mode.DARK_FIELD, now.convergence_radius, now.dark_field_tilt,
                                    tuple(map(message_to_light, now.lights[4:]))))
        return settings

    def _bright(self, cr_min: float, cr_max: float) -> list[Setting]:
        """Settings evenly spaced in motor counts."""
        kind = SolveConvergenceRadius.Request
        if cr_min == cr_max == 0:
            reach = self._ask(self._solve, kind(
                mode=kind.INVERSE, convergence_radius=_ANY_CR, branch=kind.BRANCH_UNCROSSED))
            cr_min, cr_max = max(reach.reachable_min, _LEAST_CR), reach.reachable_max
        if not (np.isfinite([cr_min, cr_max]).all() and 0 <= cr_min <= cr_max and cr_max > 0):
            raise PsError(ErrorCode.INSPECTION_BAD_REQUEST,
                          f'cr_min, cr_max: {cr_min:g} to {cr_max:g} m is no interval')
        ends = [_checked(self._ask(self._solve, kind(
            mode=kind.INVERSE, convergence_radius=cr, branch=kind.BRANCH_UNCROSSED))).motor_counts
            for cr in (cr_min, cr_max)]
        found = []
        first, last = ends
        for counts in np.unique(np.linspace(first, last, POSITIONS).round().astype(int)):
            answer = self._ask(self._solve, kind(mode=kind.FORWARD, motor_counts=int(counts)))
            # the very end may lie on the other branch, by rounding
            if answer.success and answer.branch == kind.BRANCH_UNCROSSED:
                found.append(Setting(Mode.BRIGHT_FIELD, answer.convergence_radius, answer.tilt,
                                     tuple(map(message_to_light, answer.lights))))
        return found

    @staticmethod
    def _ask(client: Any, request: Any) -> Any:
        return call(client, request, _ANSWER_S, ErrorCode.INSPECTION_CAPTURE_FAILED)


def _checked(answer: Any) -> Any:
    if not answer.success:
        raise PsError(answer.error_code, answer.message)
    return answer
