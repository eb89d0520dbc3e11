"""Node ring_calibration: makes, holds, saves and loads the active calibration."""
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
import threading
from typing import Any, TypeVar

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from std_srvs.srv import Trigger

from ps_calibration.calibrate import calibrate
from ps_calibration.catalogue import list_calibrations
from ps_calibration.motor_calibration import visits
from ps_calibration.motor_side import MotorSide
from ps_calibration.report import gather, report, write_report
from ps_calibration.ring_pictures import common_camera
from ps_calibration.ring_target import RingTarget, default_target_path, load_target
from ps_calibration.setup_hint import SetupHint, setup_hint
from ps_head_driver import ros_support
from ps_head_driver.calibration_file import HeadCalibration, read_calibration, write_calibration
from ps_head_driver.conversions import calibration_to_message
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.head_model import Approach, load_head, nominal_head_path
from ps_head_driver.paths import confined
from ps_head_driver.ros_support import Parameter, answers
from ps_head_driver.stack import Panel, Stack
from ps_head_driver.stack_folder_writer import write_stack
from ps_head_driver.stack_source import StackSource
from ps_interfaces import msg as ps
from ps_interfaces.action import AcquireStack, CalibrateRing
from ps_interfaces.srv import CalibrationFile

PARAMETERS = [
    Parameter('calibration_folder', '~/.ps_head/calibration',
              'Folder of calibration files: names in requests are in it', read_only=True),
    Parameter('calibration_file', '', 'Calibration made active at start; empty: none, nominal '
              'geometry', read_only=True),
    Parameter('head_serial', '', 'Refuse calibrations of other heads; empty: the serial number '
              'that head_status reports'),
    Parameter('head_file', '', 'Head geometry as designed (YAML); empty: the nominal head',
              read_only=True),
    Parameter('target_file', '', 'Half-ring target (YAML); empty: the one shipped',
              read_only=True),
    Parameter('convergence_radii', [0.05, 0.0685], 'Convergence radii at which a calibration '
              'takes its pictures', 'm'),
    Parameter('exposure', 0.003, 'Exposure of the pictures with one panel', 's', 1e-4, 1.0),
    Parameter('dark_field', True, 'Calibrate the dark-field panels, too'),
    Parameter('capture_timeout', 60.0, 'Longest wait for the pictures at one convergence radius',
              's', 1.0, 600.0),
]

_POLL_S = 0.05
Outcome = TypeVar('Outcome')


class RingCalibration(Node):
    """See the README for topics, services, the action and parameters."""

    def __init__(self) -> None:
        super().__init__('ring_calibration')
        self.parameters = ros_support.Parameters(
            self, PARAMETERS, ErrorCode.CALIBRATION_BAD_REQUEST)
        self.folder = Path(self.parameters['calibration_folder']).expanduser()
        self.active: HeadCalibration | None = None
        self.reported_serial = ''
        self.refused = ''      # why the calibration of the start was dropped
        self.head = load_head(self.parameters['head_file'] or nominal_head_path())
        self._busy, self._computing = threading.Lock(), threading.Lock()
        self._cancelled = threading.Event()
        self._running: ServerGoalHandle | None = None
        self._source = StackSource(self, ErrorCode.CALIBRATION_CAPTURE_FAILED,
                                   ErrorCode.CALIBRATION_CANCELLED)
        self._motor_side = MotorSide(self)
        self._publisher = self.create_publisher(
            ps.HeadCalibration, 'calibration', ros_support.LATCHED)
        self.create_subscription(
            ps.HeadStatus, 'head_status', self._on_head_status, ros_support.LATCHED)
        self.create_service(CalibrationFile, '~/save', self._on_save)
        self.create_service(CalibrationFile, '~/load', self._on_load)
        self.create_service(Trigger, '~/list', self._on_list)
        self._action = ActionServer(
            self, CalibrateRing, 'calibrate_ring', self._on_calibrate,
            callback_group=ReentrantCallbackGroup(),
            goal_callback=lambda _: GoalResponse.ACCEPT, cancel_callback=self._on_cancel)
        ros_support.Diagnostics(self, {'Calibration': self._diagnose},
                                hardware_id=lambda: self.reported_serial)
        if self.parameters['calibration_file']:
            # a parameter is the owner's, other than a request: it may name any file
            self._activate(self.folder / Path(self.parameters['calibration_file']).expanduser())
        self._publish()

    def _on_head_status(self, message: ps.HeadStatus) -> None:
        self.reported_serial = message.serial_number or self.reported_serial
        try:
            if self.active is not None:
                self._check_serial(self.active)
        except PsError as error:
            # loaded before the head had said who it is
            self.get_logger().error(f'{error.message}; nominal geometry is active instead')
            self.active, self.refused = None, error.message
            self._publish()

    def _path(self, name: str, field: str = 'file') -> Path:
        """File that a request names.

        :raises PsError: CALIBRATION_BAD_REQUEST for an empty name or one outside the folder.
        """
        return confined(self.folder, name, field, ErrorCode.CALIBRATION_BAD_REQUEST)

    @answers(ErrorCode.CALIBRATION_INTERNAL)
    def _on_save(self, request: CalibrationFile.Request,
                 response: CalibrationFile.Response) -> str:
        if self.active is None:
            raise PsError(ErrorCode.CALIBRATION_NONE_ACTIVE,
                          'no calibration is active; calibrate or load one first')
        path = self._path(request.file)
        write_calibration(self.active, path)
        response.calibration_id = self.active.calibration_id
        return f'written to {path}'

    @answers(ErrorCode.CALIBRATION_INTERNAL)
    def _on_load(self, request: CalibrationFile.Request,
                 response: CalibrationFile.Response) -> str:
        path = self._path(request.file)
        self._activate(path)
        self._publish()
        assert self.active is not None
        response.calibration_id = self.active.calibration_id
        return f'{path} is active'

    @answers(ErrorCode.CALIBRATION_INTERNAL)
    def _on_list(self, _: Trigger.Request, response: Trigger.Response) -> str:
        active = self.active.calibration_id if self.active else ''
        return '\n'.join(
            entry.text + ('  (active)' if entry.calibration is not None
                          and entry.calibration.calibration_id == active else '')
            for entry in list_calibrations(self.folder)) or f'{self.folder}: no calibrations'

    def _activate(self, path: Path) -> None:
        """Read a file and make it active; what was active before stays if it is refused.

        :raises PsError: CALIBRATION_* with the reason.
        """
        calibration = read_calibration(path)
        self._check_serial(calibration)
        if calibration.verdict == 'FAILED':
            raise PsError(ErrorCode.CALIBRATION_FILE_INVALID,
                          f'{path}: this calibration failed: {calibration.verdict_reason}')
        self.active, self.refused = calibration, ''

    def _check_serial(self, calibration: HeadCalibration) -> None:
        ours = self.parameters['head_serial'] or self.reported_serial
        if ours and calibration.head_serial != ours:
            raise PsError(ErrorCode.CALIBRATION_WRONG_HEAD,
                          f'calibration {calibration.calibration_id} was made for head '
                          f'{calibration.head_serial!r}, this is {ours!r}')

    # ------------------------------------------------------------------ the action

    def _on_cancel(self, goal: ServerGoalHandle) -> CancelResponse:
        # a goal that is not running yet looks at its own flag when it gets its turn
        if self._running is not None and self._running.goal_id == goal.goal_id:
            self._cancelled.set()
        return CancelResponse.ACCEPT

    @contextmanager
    def _exclusive(self, goal: ServerGoalHandle) -> Iterator[None]:
        if not self._busy.acquire(blocking=False):
            raise PsError(ErrorCode.CALIBRATION_BUSY, 'another calibration is running')
        try:
            self._cancelled.clear()
            self._running = goal
            if goal.is_cancel_requested:
                self._cancelled.set()
            yield
        finally:
            self._running = None
            self._busy.release()

    def _on_calibrate(self, goal: ServerGoalHandle) -> CalibrateRing.Result:
        result = CalibrateRing.Result(verdict=ps.HeadCalibration.VERDICT_FAILED)
        result.calibration = calibration_to_message(None, self.head)
        try:
            with self._exclusive(goal):
                self._calibrate(goal, result)
            result.success = True
            goal.succeed()
        except Exception as error:
            known = ros_support.as_ps_error(self, error, ErrorCode.CALIBRATION_INTERNAL)
            self.get_logger().warning(f'calibrate_ring: {known.message}')
            ros_support.fill_error(result, known)
            result.reason = result.reason or known.message
            if goal.is_cancel_requested:
                goal.canceled()
            else:
                goal.abort()
        return result

    def _calibrate(self, goal: ServerGoalHandle, result: CalibrateRing.Result) -> None:
        """Fill the result.

        :raises PsError: CALIBRATION_* with the reason, also for a verdict FAILED.
        """
        request = goal.request
        target = load_target(
            self._path(request.target_file, 'target_file') if request.target_file
            else self.parameters['target_file'] or default_target_path())
        radii = list(request.convergence_radii or self.parameters['convergence_radii'])
        if not radii or min(radii) <= 0:
            raise PsError(ErrorCode.CALIBRATION_BAD_REQUEST,
                          f'convergence_radii: {radii} must be positive, at least one')
        keep = (self._path(request.working_directory, 'working_directory')
                if request.working_directory else None)
        stops = visits(radii)
        stacks = self._take_stacks(goal, stops, target, keep)
        done = len(stops)
        self._feedback(goal, CalibrateRing.Feedback.FITTING, done, done)
        fitted = self._in_worker(lambda: calibrate(stacks, target, self.head))
        result.verdict = getattr(ps.HeadCalibration, f'VERDICT_{fitted.verdict}')
        result.reason = fitted.full_reason
        if fitted.fit is not None:
            result.residuals_px = [float(edge) for edges in fitted.fit.edge_px for edge in edges]
        self._feedback(goal, CalibrateRing.Feedback.REPORTING, done, done)
        serial = self.parameters['head_serial'] or self.reported_serial
        evidence = self._in_worker(lambda: gather(
            fitted, stacks, [f'position_{k + 1}' for k in range(done)], target, self.head, serial,
            [side for _, side in stops]))
        text = self._in_worker(lambda: report(evidence))
        # the name has the serial number in it, which came over the network
        path = self._path(f'{evidence.name}.yaml', 'serial number')
        write_report(text, path.with_suffix('.html'))
        calibration = evidence.calibration
        if calibration is None:
            raise PsError(ErrorCode.CALIBRATION_POOR_FIT,
                          f'{fitted.reason}; report: {path.with_suffix(".html")}')
        write_calibration(calibration, path)
        result.calibration = calibration_to_message(calibration, self.head)
        result.message = f'{calibration.verdict}, written to {path}, report beside it'
        if request.apply and calibration.verdict == 'OK':
            self._source.check(self._cancelled.is_set)
            self.active, self.refused = calibration, ''
            self._publish()
            result.message += ', and active'
        elif request.apply:
            result.message += '; not made active, load it with ring_calibration/load to do so'
        if fitted.dark.verdict != 'OK':
            result.message += f'; dark field {fitted.dark.verdict}: {fitted.dark.reason}'
        if evidence.motor is not None:
            result.message += (f'; motor: backlash {evidence.motor.backlash_counts:.0f} counts, '
                               f'repeats to {evidence.motor.repeatability_counts:.0f}')

    def _take_stacks(self, goal: ServerGoalHandle, stops: Sequence[tuple[float, Approach | None]],
                     target: RingTarget, keep: Path | None) -> list[Stack]:
        """One stack per stop; the first also tells how well the target lies."""
        state = CalibrateRing.Feedback
        stacks: list[Stack] = []
        hint: SetupHint | None = None
        with self._source.listening(), self._motor_side.restored():
            for number, (radius, side) in enumerate(stops):
                if side is not None:
                    self._motor_side.choose(side)

                def on_feedback(capture: Any, number: int = number,
                                hint: SetupHint | None = hint) -> None:
                    moving = capture.state == AcquireStack.Feedback.MOVING
                    self._feedback(goal, state.MOVING if moving else state.CAPTURING, number,
                                   len(stops), hint)
                stack = self._source.take(
                    AcquireStack.Goal(steps=self._steps(radius, number == 0),
                                      part_id='ring calibration'),
                    self.parameters['capture_timeout'], self._cancelled.is_set, on_feedback)
                if keep is not None:
                    _keep(stack, keep / f'position_{number + 1}', side)
                hint = setup_hint(stack, target, common_camera([stack], self.head))
                self._feedback(goal, state.DETECTING, number + 1, len(stops), hint)
                stacks.append(stack)
        return stacks

    def _steps(self, radius: float, first: bool) -> list[ps.LightStep]:
        """Frames of one position; all panels together get a quarter of the exposure.

        The dark field does not move with the motor: it is taken at the first position alone.
        """
        exposure, singles = self.parameters['exposure'], (Panel.E, Panel.N, Panel.W, Panel.S)
        bright, dark = ps.Panel.BRIGHT_FIELD, ps.Panel.DARK_FIELD
        frames = [*((bright, panel, exposure) for panel in singles),
                  (bright, Panel.ALL, exposure / 4), (bright, Panel.NONE, exposure)]
        if first and self.parameters['dark_field']:
            frames += [(dark, panel, exposure) for panel in singles]
        return [ps.LightStep(mode=mode, panel=int(panel), convergence_radius=float(radius),
                             exposure_time=time) for mode, panel, time in frames]

    def _in_worker(self, compute: Callable[[], Outcome]) -> Outcome:
        """Compute in a thread of its own: a cancel does not wait for it."""
        outcome: list[Outcome | Exception] = []

        def work() -> None:
            try:
                # not beside one that a cancel left behind: numba's kernels take one caller
                with self._computing:
                    outcome.append(compute())
            except Exception as error:
                outcome.append(error)

        worker = threading.Thread(target=work, name='calibration', daemon=True)
        worker.start()
        while worker.is_alive():
            self._source.check(self._cancelled.is_set)
            worker.join(_POLL_S)
        if isinstance(outcome[0], Exception):
            raise outcome[0]
        return outcome[0]

    @staticmethod
    def _feedback(goal: ServerGoalHandle, state: int, step: int, total: int,
                  hint: SetupHint | None = None) -> None:
        message = CalibrateRing.Feedback(state=state, step=step, total=total)
        if hint is not None:
            message.hint_shift_x, message.hint_shift_y = hint.shift
            message.hint_tilt_x, message.hint_tilt_y = hint.tilt
            message.hint = hint.text
        goal.publish_feedback(message)

    # ------------------------------------------------------------------ outputs

    def _publish(self) -> None:
        self._publisher.publish(calibration_to_message(self.active, self.head))

    def _diagnose(self) -> ros_support.Report:
        if self.refused:
            return ros_support.ERROR, self.refused, {}
        if self.active is None:
            return ros_support.WARN, 'not calibrated: nominal geometry', {}
        level = ros_support.OK if self.active.verdict == 'OK' else ros_support.WARN
        return level, f'{self.active.verdict} {self.active.verdict_reason}'.strip(), {
            'calibration': self.active.calibration_id, 'created': self.active.created,
            'target': self.active.target_name, 'head': self.active.head_serial}


def _keep(stack: Stack, folder: Path, side: Approach | None) -> None:
    """:raises PsError: CALIBRATION_WRITE_FAILED."""
    try:
        write_stack(stack, folder, approach=side)
    except PsError as error:
        raise PsError(ErrorCode.CALIBRATION_WRITE_FAILED,
                      f'working_directory: {error.message}') from error


def main() -> None:
    """Run the node."""
    ros_support.run_node(RingCalibration)


if __name__ == '__main__':
    main()
