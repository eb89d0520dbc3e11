"""Node head_driver: owns the serial link(s) to motor and panels."""
from contextlib import suppress
import math
from pathlib import Path
from typing import Any

from rclpy._rclpy_pybind11 import RCLError
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.exceptions import InvalidHandle
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from ps_head_driver import convergence_radius, ros_support, strobe_program
from ps_head_driver.calibration_file import apply
from ps_head_driver.conversions import light_to_message, message_to_calibration
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.fake.child import EmulatorChild
from ps_head_driver.fake.trigger_socket import default_path
from ps_head_driver.frames import PLANE_FRAME
from ps_head_driver.head_client import PANEL_NAMES, HeadClient, HeadState, Motion
from ps_head_driver.head_frames import BRIGHT_FIELD_JOINT, DARK_FIELD_JOINT
from ps_head_driver.head_model import (
    APPROACHES,
    Approach,
    HeadModel,
    load_head,
    nominal_head_path,
)
from ps_head_driver.head_supervisor import HeadSupervisor, Phase, Settings, Snapshot
from ps_head_driver.kinematics import BrightFieldKinematics, lights_at
from ps_head_driver.ros_support import Parameter, answers
from ps_head_driver.serial_link import SerialLink
from ps_head_driver.stack import Light
from ps_interfaces import msg as ps
from ps_interfaces.srv import RunStrobeProgram, SetIllumination

PARAMETERS = [
    Parameter('autostart', True, 'Configure and activate by itself', read_only=True),
    Parameter('port', '/dev/ttyUSB0', 'Serial port or pyserial URL of the board with the motor',
              read_only=True),
    Parameter('lights_port', '', 'Port of a second board with the lights; empty: there is one '
              'board', read_only=True),
    Parameter('baud', 115200, 'Speed of the port', 'bit/s', 1200, 4000000, read_only=True),
    Parameter('boot_time', 0.0, 'Silence of a board that restarts when its port is opened', 's',
              0.0, 10.0, read_only=True),
    Parameter('fake_hardware', False, 'Start a firmware emulator and use it instead of port',
              read_only=True),
    Parameter('trigger_socket', '', 'Fake hardware: where strobes are announced to the fake '
              'camera; empty: derived from namespace and domain', read_only=True),
    Parameter('head_file', '', 'Head geometry (YAML); empty: the nominal head', read_only=True),
    Parameter('true_head_file', '', 'Fake hardware: the head as it really is; empty: head_file',
              read_only=True),
    Parameter('home_on_activation', True, 'Home by itself whenever the board does not know its '
              'position'),
    Parameter('approach', 'up', 'Last direction of every move', choices=APPROACHES),
    Parameter('overshoot', 400, 'Way beyond the target when coming from the wrong side; more than '
              'the backlash', 'counts', 0, 5000, read_only=True),
    Parameter('in_position', 4, 'Allowed error of a finished move', 'counts', 0, 1000),
    Parameter('speed', 0, 'Speed of moves; 0: as fast as the board can', 'counts/s', 0, 10000000),
    Parameter('settle_time', 0.02, 'Rest after a move', 's', 0.0, 5.0),
    Parameter('move_timeout', 20.0, 'Longest move or homing', 's', 1.0, 120.0),
    Parameter('status_period', 0.5, 'Period of head_status without a change', 's', 0.05, 10.0),
    Parameter('reconnect_period', 0.25, 'Wait between attempts to connect', 's', 0.05, 10.0),
]


class HeadDriver(LifecycleNode):
    """See the README for topics, services and parameters."""

    def __init__(self) -> None:
        super().__init__('head_driver')
        self.parameters = ros_support.Parameters(
            self, PARAMETERS, ErrorCode.HEAD_BAD_REQUEST, self._on_parameters)
        self._head: HeadModel | None = None           # nominal
        # with the active calibration, by the side from which the motor has arrived
        self._calibrated: dict[Approach, HeadModel] = {}
        self._arrived: Approach = self.parameters['approach']
        self._calibration: ps.HeadCalibration | None = None
        self._emulator: EmulatorChild | None = None
        self._links: list[SerialLink] = []
        self._supervisor: HeadSupervisor | None = None
        self._settings = Settings()
        self._position: tuple[HeadModel, int, float, float] | None = None
        self._last_logged = ''
        self._refusal: PsError | None = None

        parallel = ReentrantCallbackGroup()
        self._status = self.create_publisher(ps.HeadStatus, 'head_status', ros_support.LATCHED)
        self._joints = self.create_publisher(JointState, 'joint_states', ros_support.RELIABLE)
        self.create_subscription(
            ps.HeadCalibration, 'calibration', self._on_calibration, ros_support.LATCHED)
        for name, handler in (('home', self._on_home), ('stop', self._on_stop),
                              ('reconnect', self._on_reconnect),
                              ('clear_fault', self._on_clear_fault)):
            self.create_service(Trigger, f'~/{name}', handler, callback_group=parallel)
        self.create_service(SetIllumination, 'set_illumination', self._on_set_illumination,
                            callback_group=parallel)
        self.create_service(RunStrobeProgram, '~/run_strobe_program', self._on_run_program,
                            callback_group=parallel)
        ros_support.Diagnostics(
            self, {'Link': self._diagnose_link, 'Motor': self._diagnose_motor,
                   'Panels': self._diagnose_panels}, self._serial_number)
        self._publish(Snapshot(Phase.DISCONNECTED, None, _not_active(), ()))
        if self.parameters['autostart']:
            for transition in (self.trigger_configure, self.trigger_activate):
                if transition() != TransitionCallbackReturn.SUCCESS:
                    raise self._refusal or PsError(
                        ErrorCode.HEAD_INTERNAL, 'head_driver could not be activated')

    # ------------------------------------------------------------------ life cycle

    def on_configure(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Read the head file."""
        try:
            self._head = load_head(self._head_file())
            BrightFieldKinematics(self._head)
            self._use_calibration()
        except PsError as error:
            self._refusal = error
            self.get_logger().error(error.message)
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to connect. An absent head is no failure: the driver keeps trying."""
        assert self._head is not None
        names = [self.parameters['port'], self.parameters['lights_port']]
        if self.parameters['fake_hardware']:
            socket = self.parameters['trigger_socket'] or default_path(self.get_namespace())
            self._emulator = EmulatorChild(
                Path(socket), self.parameters['true_head_file'] or str(self._head_file()))
            names = [str(self._emulator.port), '']
        self._links = [
            SerialLink(name, self.parameters['baud'], self.parameters['boot_time'])
            for i, name in enumerate(names) if name or i == 0]
        client = HeadClient(self._links, BrightFieldKinematics(self._head).limits_counts)
        self._settings = self._read_settings({})
        self._supervisor = HeadSupervisor(
            client, self._settings, self._publish,
            self._emulator.ensure if self._emulator else lambda: None)
        self._supervisor.start()
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Everything off, disconnect."""
        self.close()
        return super().on_deactivate(state)

    def on_cleanup(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Forget the head file."""
        self._head, self._calibrated = None, {}
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Everything off, from any state."""
        self.close()
        return TransitionCallbackReturn.SUCCESS

    def close(self) -> None:
        """Panels off, motor stopped, link closed, emulator ended."""
        supervisor, self._supervisor = self._supervisor, None
        if supervisor is not None:
            supervisor.close()
            self._publish(Snapshot(Phase.DISCONNECTED, None, _not_active(), ()))
        if self._emulator is not None:
            self._emulator.stop()
            self._emulator = None

    # ------------------------------------------------------------------ inputs

    def _head_file(self) -> Path:
        return Path(self.parameters['head_file'] or nominal_head_path())

    def _read_settings(self, changes: dict[str, Any]) -> Settings:
        values = {**self.parameters, **changes}
        return Settings(
            Motion(values['speed'], values['overshoot'], values['approach'] == 'up',
                   values['in_position'], values['settle_time']),
            values['home_on_activation'], values['status_period'], values['reconnect_period'],
            values['move_timeout'])

    def _on_parameters(self, changes: dict[str, Any]) -> None:
        if self._supervisor is not None:
            self._supervisor.settings = self._settings = self._read_settings(changes)

    def _on_calibration(self, message: ps.HeadCalibration) -> None:
        self._calibration = message
        try:
            self._use_calibration()
        except PsError as error:
            self.get_logger().error(f'calibration refused: {error.message}')

    def _use_calibration(self) -> None:
        if self._head is not None:
            calibration = message_to_calibration(self._calibration) if self._calibration else None
            self._calibrated = {side: apply(self._head, calibration, side) for side in APPROACHES}

    def _active(self) -> tuple[HeadSupervisor, HeadModel]:
        if self._supervisor is None or not self._calibrated:
            raise _not_active()
        return self._supervisor, self._calibrated[self._arrived]

    # ------------------------------------------------------------------ requests

    @answers(ErrorCode.HEAD_INTERNAL)
    def _on_home(self, _request: Trigger.Request, _response: Trigger.Response) -> str:
        state = self._active()[0].home(self.parameters['move_timeout'])
        return f'homed; motor at {state.motor_counts} counts'

    @answers(ErrorCode.HEAD_INTERNAL)
    def _on_stop(self, _request: Trigger.Request, _response: Trigger.Response) -> str:
        self._active()[0].stop()
        return 'panels off, motor stopped'

    @answers(ErrorCode.HEAD_INTERNAL)
    def _on_reconnect(self, _request: Trigger.Request, _response: Trigger.Response) -> str:
        self._active()[0].reconnect()
        return 'connected'

    @answers(ErrorCode.HEAD_INTERNAL)
    def _on_clear_fault(self, _request: Trigger.Request, _response: Trigger.Response) -> str:
        self._active()[0].clear_fault()
        return 'no fault'

    @answers(ErrorCode.HEAD_INTERNAL)
    def _on_set_illumination(self, request: SetIllumination.Request,
                             response: SetIllumination.Response) -> str:
        supervisor, head = self._active()
        strobe_program.check_intensities(request.intensities)
        tilt = request.dark_field_tilt
        low, high = head.dark_field.tilt_range
        if tilt and not low <= tilt <= high:
            raise PsError(ErrorCode.HEAD_BAD_REQUEST,
                          f'dark_field_tilt: {tilt} is not within {low} to {high} rad')
        motion = self._settings.motion
        side: Approach = 'up' if motion.approach_up else 'down'
        target = self._target_of(request, self._calibrated[side])
        with supervisor.operation(homed=True) as client:
            if target is not None:
                self._arrived, head = side, self._calibrated[side]
                client.move_to(target, motion, self.parameters['move_timeout'])
            if tilt:
                client.set_df_tilt(tilt)
            if request.intensities:
                client.set_gains(request.intensities)
            state, gains = client.state(), client.gains
        panels = self._panels(head, state)
        response.motor_counts, response.tilt = state.motor_counts, panels[0].tilt
        response.dark_field_tilt = state.df_tilt
        response.convergence_radius, response.light_height = self._reached(
            head, state.motor_counts, request.light_height)
        response.lights = [light_to_message(light) for light in panels]
        for light, gain in zip(response.lights, gains, strict=True):
            light.intensity *= gain
        return f'motor at {state.motor_counts} counts'

    def _target_of(self, request: SetIllumination.Request, head: HeadModel) -> int | None:
        """Motor counts that a request asks for; None to stay."""
        kind = SetIllumination.Request
        if request.by == kind.KEEP:
            return None
        if request.by == kind.BY_MOTOR_COUNTS:
            return int(request.motor_counts)
        if request.by == kind.BY_TILT:
            if not math.isfinite(request.tilt):
                raise PsError(ErrorCode.HEAD_BAD_REQUEST, f'tilt: {request.tilt}')
            return BrightFieldKinematics(head).motor_counts(request.tilt)
        if request.by != kind.BY_CONVERGENCE_RADIUS:
            raise PsError(ErrorCode.HEAD_BAD_REQUEST, f'by: {request.by} is not known')
        branches = convergence_radius.Branch
        if request.branch not in (branches.ANY, branches.UNCROSSED, branches.CROSSED):
            raise PsError(ErrorCode.HEAD_BAD_REQUEST,
                          f'branch: {request.branch} is not ANY, UNCROSSED or CROSSED')
        return convergence_radius.inverse(
            head, request.convergence_radius, request.light_height,
            branches(request.branch)).motor_counts

    @answers(ErrorCode.HEAD_INTERNAL)
    def _on_run_program(self, request: RunStrobeProgram.Request,
                        response: RunStrobeProgram.Response) -> str:
        supervisor, head = self._active()
        steps = [
            strobe_program.parse_step(i, step.mode, step.panel, step.intensity, step.settle,
                                      step.strobe_duration, step.period)
            for i, step in enumerate(request.steps)]
        with supervisor.operation(homed=True) as client:
            before = client.state()
            result = client.run_program(strobe_program.encode_steps(steps))
        response.first_strobe_counter = before.strobe_counter + 1
        response.steps_done = len(result.records)
        panels = self._panels(head, before)
        response.lights = [
            light_to_message(strobe_program.light_of(step, record, panels))
            for step, record in zip(steps, result.records, strict=False)]
        if result.error is not None:
            raise result.error
        return f'{len(result.records)} steps'

    # ------------------------------------------------------------------ outputs

    @staticmethod
    def _panels(head: HeadModel, state: HeadState) -> list[Light]:
        """The eight panels where the head stands."""
        low, high = BrightFieldKinematics(head).limits_counts     # in-position error at the ends
        return lights_at(head, min(max(state.motor_counts, low), high), state.df_tilt)

    @staticmethod
    def _reached(head: HeadModel, counts: int, light_height: float = 0.0) -> tuple[float, float]:
        """(CR, h) at a position, m; NaN where the axes do not meet the plane."""
        try:
            solution = convergence_radius.forward(head, counts, light_height or None)
        except PsError:
            return math.nan, math.nan
        return solution.convergence_radius, solution.light_height

    def _geometry(self, state: HeadState) -> tuple[float, float]:
        """(tilt, CR) of a state; computed when the motor has moved."""
        head = self._calibrated.get(self._arrived)
        if head is None or not state.homed:
            return math.nan, math.nan
        if self._position is None or self._position[:2] != (head, state.motor_counts):
            tilt = math.nan
            with suppress(PsError):
                tilt = float(BrightFieldKinematics(head).tilt(state.motor_counts))
            self._position = (head, state.motor_counts, tilt,
                              self._reached(head, state.motor_counts)[0])
        return self._position[2:]

    def _publish(self, snapshot: Snapshot) -> None:
        """Head status; called from the threads that use the head."""
        status = ps.HeadStatus(
            state=int(snapshot.phase), fake=bool(self.parameters['fake_hardware']),
            tilt=math.nan, dark_field_tilt=math.nan, convergence_radius=math.nan)
        status.header.frame_id = PLANE_FRAME
        status.header.stamp = self.get_clock().now().to_msg()
        error, state = snapshot.error, snapshot.state
        if error is not None:
            status.error_code, status.message = int(error.code), error.message
        if state is not None:
            status.homed, status.motor_counts = state.homed, state.motor_counts
            status.tilt, status.convergence_radius = self._geometry(state)
            status.dark_field_tilt = state.df_tilt
            status.panel_temperatures = list(state.temperatures)
            status.strobe_counter = state.strobe_counter
            status.trigger_counter = state.trigger_counter
        if snapshot.boards:
            status.firmware_version = '.'.join(map(str, snapshot.boards[-1].firmware))
            status.serial_number = snapshot.boards[0].serial
        if error is not None:
            self._log(f'{snapshot.phase.name}: {error.message}', True)
        elif snapshot.phase in (Phase.CONNECTED, Phase.READY):
            self._log(f'{snapshot.phase.name}: head {status.serial_number}', False)
        # after a signal the context is gone before this node is closed
        with suppress(RCLError, InvalidHandle):
            self._status.publish(status)
            known = [(name, angle) for name, angle in (
                (BRIGHT_FIELD_JOINT, status.tilt), (DARK_FIELD_JOINT, status.dark_field_tilt))
                if math.isfinite(angle)]
            if known:
                joints = JointState(header=status.header)
                joints.name, joints.position = zip(*known, strict=True)
                self._joints.publish(joints)

    def _log(self, text: str, is_error: bool) -> None:
        """Say what is not routine, once."""
        if text != self._last_logged and self._supervisor and self.context.ok():
            self._last_logged = text
            if is_error:
                self.get_logger().warning(text)
            else:
                self.get_logger().info(text)

    # ------------------------------------------------------------------ diagnostics

    def _serial_number(self) -> str:
        boards = self._supervisor.client.boards if self._supervisor else ()
        return boards[0].serial if boards else ''

    def _diagnose_link(self) -> ros_support.Report:
        values: dict[str, Any] = {}
        for link in self._links:
            counts = link.statistics
            values |= {f'{link.url} {name}': value for name, value in vars(counts).items()}
        if self._supervisor is None:
            return ros_support.STALE, 'not active', values
        snapshot = self._supervisor.snapshot()
        if snapshot.phase is Phase.DISCONNECTED:
            reason = snapshot.error.message if snapshot.error else 'not connected'
            return ros_support.ERROR, reason, values
        board = snapshot.boards[0]
        values |= {'firmware': '.'.join(map(str, board.firmware)), 'protocol': board.version,
                   'fake': self.parameters['fake_hardware']}
        return ros_support.OK, 'connected', values

    def _diagnose_motor(self) -> ros_support.Report:
        snapshot = self._supervisor.snapshot() if self._supervisor else None
        if snapshot is None or snapshot.state is None:
            return ros_support.STALE, 'not connected', {}
        state = snapshot.state
        values = {'homed': state.homed, 'motor_counts': state.motor_counts,
                  'activity': state.activity.name}
        if snapshot.phase is Phase.FAULT and snapshot.error:
            return ros_support.ERROR, snapshot.error.message, values
        if not state.homed:
            return ros_support.WARN, 'not homed', values
        return ros_support.OK, snapshot.phase.name.lower(), values

    def _diagnose_panels(self) -> ros_support.Report:
        snapshot = self._supervisor.snapshot() if self._supervisor else None
        if snapshot is None or snapshot.state is None:
            return ros_support.STALE, 'not connected', {}
        state = snapshot.state
        values: dict[str, Any] = {
            f'{name} temperature [K]': f'{kelvin:.1f}'
            for name, kelvin in zip(PANEL_NAMES, state.temperatures, strict=True)}
        values |= {'strobes': state.strobe_counter, 'triggers': state.trigger_counter}
        if state.fault_panels:
            return ros_support.ERROR, ', '.join(state.fault_panels) + ': fault', values
        return ros_support.OK, 'on' if state.panels_on else 'off', values


def _not_active() -> PsError:
    return PsError(ErrorCode.HEAD_NOT_ACTIVE, 'head_driver is not active; activate it first')


def main() -> None:
    """Run the node."""
    ros_support.run_node(HeadDriver)


if __name__ == '__main__':
    main()
