"""The head as typed operations over one or two serial links: home, move, run a strobe program.

Operations wait until they are done. ``stop`` may be called from another thread at any time and
makes a waiting operation end with HEAD_CANCELLED. Polling while waiting is the heartbeat that the
boards' watchdog wants.
"""
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
import math
import threading
import time

from ps_head_driver import protocol
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.protocol import (
    NO_MOTOR,
    NOT_MEASURED,
    PANELS,
    TEMPERATURE_UNIT,
    TILT_UNIT,
    Activity,
    BoardInfo,
    Capability,
    Command,
    End,
    Fault,
    Result,
    Status,
    StatusFlag,
    Step,
    StepRecord,
)
from ps_head_driver.serial_link import SerialLink

POLL_S = 0.02
PANEL_NAMES = tuple(f'{ring}_{name}' for ring in ('BF', 'DF') for name in 'ENWS')

_REFUSALS = {
    Result.BUSY: (ErrorCode.HEAD_BUSY, 'the board is busy'),
    Result.NOT_HOMED: (ErrorCode.HEAD_NOT_HOMED, 'home the motor first'),
    Result.OUT_OF_LIMITS: (ErrorCode.HEAD_OUT_OF_LIMITS, 'outside the soft limits'),
    Result.BAD_VALUE: (ErrorCode.HEAD_BAD_REQUEST, 'a value is out of range'),
    Result.REJECTED: (ErrorCode.HEAD_PROGRAM_REJECTED,
                      'strobe program beyond the on-time or duty limits of the panels'),
    Result.FAULT: (ErrorCode.HEAD_FAULT, 'a fault is latched; call head_driver/clear_fault'),
}
_FAULTS = {
    Fault.STALL: (ErrorCode.HEAD_STALL, 'the motor stalled or lost steps; clear the fault and '
                                        'home again'),
    Fault.LIMIT: (ErrorCode.HEAD_LIMIT_HIT, 'the motor ran into a limit switch'),
    Fault.OVER_TEMPERATURE: (ErrorCode.HEAD_OVER_TEMPERATURE, 'too hot'),
    Fault.LED_OPEN: (ErrorCode.HEAD_LED_OPEN, 'no current (LED or cable broken)'),
    Fault.WATCHDOG: (ErrorCode.HEAD_WATCHDOG, 'the board lost the host and switched everything '
                                              'off'),
}


@dataclass(frozen=True)
class HeadState:
    """State of the whole head, from one or two boards."""

    activity: Activity
    motor_end: End
    lights_end: End
    homed: bool
    panels_on: bool
    faults: Fault
    fault_panels: tuple[str, ...]
    motor_counts: int
    df_tilt: float                        # rad; NaN without lights
    temperatures: tuple[float, ...]       # K, in the order of PANEL_NAMES; NaN: not measured
    steps_done: int
    strobe_counter: int
    trigger_counter: int

    def fault_error(self) -> PsError | None:
        """The most important latched fault as an error; None if there is none."""
        for fault, (code, text) in _FAULTS.items():
            if fault in self.faults:
                panels = ', '.join(self.fault_panels)
                return PsError(code, f'{panels}: {text}' if panels else text)
        return None


@dataclass(frozen=True)
class Motion:
    """How moves are made.

    :param speed: counts/s; 0 is the motor's fastest.
    :param overshoot_counts: a move that would arrive from the wrong side goes this much beyond
        first; more than the backlash.
    :param approach_up: last direction of every move is towards higher counts.
    :param tolerance_counts: in-position check.
    :param settle_s: after the motor stands still.
    """

    speed: int = 0
    overshoot_counts: int = 400
    approach_up: bool = True
    tolerance_counts: int = 4
    settle_s: float = 0.02


@dataclass(frozen=True)
class ProgramResult:
    """What a strobe program did.

    :param records: of the steps done, in order.
    :param error: why it ended early, or None.
    """

    records: tuple[StepRecord, ...]
    error: PsError | None


class HeadClient:
    """One head on one or two boards.

    :param links: not yet connected; one has the motor, one (the same or another) the lights.
    :param limits: soft limits of the motor, counts.
    """

    def __init__(self, links: Sequence[SerialLink], limits: tuple[int, int]) -> None:
        self.links, self.limits = tuple(links), limits
        # called with every state that was read, from the thread that read it
        self.on_state: Callable[[HeadState], None] = lambda _: None
        self._motor: SerialLink | None = None
        self._lights: SerialLink | None = None
        self._gains: tuple[int, ...] = (protocol.FULL_LEVEL,) * PANELS
        self._stops = 0
        self._stop_lock = threading.Lock()

    # ------------------------------------------------------------------ link

    @property
    def connected(self) -> bool:
        """Whether every board answers."""
        return self._lights is not None and all(link.connected for link in self.links)

    @property
    def boards(self) -> tuple[BoardInfo, ...]:
        """The boards that are connected."""
        return tuple(link.info for link in self.links if link.info is not None)

    def connect(self, motion: Motion) -> HeadState:
        """Open all links and set limits and intensities.

        A watchdog fault from the time without link is cleared: the link is back.

        :raises PsError: the link's errors; HEAD_PROTOCOL_MISMATCH if motor or lights are missing.
        """
        self._motor = self._lights = None
        for link in self.links:
            info = link.connect()
            if Capability.MOTOR in info.capabilities:
                self._motor = link
            if Capability.LIGHTS in info.capabilities:
                self._lights = link
        missing = [name for name, link in (('motor', self._motor), ('lights', self._lights))
                   if link is None]
        if missing:
            self.disconnect()
            raise PsError(ErrorCode.HEAD_PROTOCOL_MISMATCH,
                          f'no connected board has the {" and the ".join(missing)}')
        self._wait(Activity.IDLE, 5.0)
        low, high = self.limits
        beyond = motion.overshoot_counts
        self._ask(self._motor, Command.LIMITS, protocol.LIMITS_REQUEST.pack(
            low - beyond, high + beyond))     # the side of arrival can change later
        self._ask(self._lights, Command.GAINS, protocol.GAINS_REQUEST.pack(*self._gains))
        if self.state().faults is Fault.WATCHDOG:
            self.clear_fault()
        return self.state()

    def disconnect(self) -> None:
        """Close all links."""
        self._motor = self._lights = None
        for link in self.links:
            link.close()

    def state(self) -> HeadState:
        """Read the state of all boards.

        :raises PsError: the link's errors.
        """
        by_link = {id(link): Status.parse(self._ask(link, Command.STATUS)) for link in self.links}
        all_boards = tuple(by_link.values())
        motor = by_link.get(id(self._motor), all_boards[0])
        lights = by_link.get(id(self._lights), all_boards[-1])
        busy = next((s for s in all_boards if s.activity is not Activity.IDLE), None)
        faults, panels = Fault(0), 0
        for status in all_boards:
            faults |= status.faults
            panels |= status.fault_panels
        state = HeadState(
            activity=busy.activity if busy else Activity.IDLE,
            motor_end=motor.end, lights_end=lights.end, homed=StatusFlag.HOMED in motor.flags,
            panels_on=StatusFlag.PANELS_ON in lights.flags, faults=faults,
            fault_panels=tuple(n for i, n in enumerate(PANEL_NAMES) if panels >> i & 1),
            motor_counts=motor.motor_counts,
            df_tilt=math.nan if lights.df_tilt_units == NOT_MEASURED
            else lights.df_tilt_units * TILT_UNIT,
            temperatures=tuple(math.nan if t == NOT_MEASURED else t * TEMPERATURE_UNIT
                               for t in lights.temperatures),
            steps_done=lights.steps_done, strobe_counter=lights.strobe_counter,
            trigger_counter=lights.trigger_counter)
        self.on_state(state)
        return state

    def clear_fault(self) -> HeadState:
        """Clear the faults whose cause has gone.

        :returns: the state after it; look whether faults remain.
        """
        for link in self.links:
            self._ask(link, Command.CLEAR_FAULT)
        return self.state()

    # ------------------------------------------------------------------ operations

    def stop(self) -> None:
        """Motor stopped, program ended, panels off; any waiting operation is cancelled.

        :raises PsError: the link's errors, after every board was tried.
        """
        with self._stop_lock:
            self._stops += 1
        failure: PsError | None = None
        for link in self.links:
            try:
                self._ask(link, Command.STOP)
            except PsError as error:
                failure = error
        if failure is not None:
            raise failure

    def home(self, timeout: float = 20.0) -> HeadState:
        """Find the home switch; ends at count 0.

        :param timeout: s.
        :raises PsError: HEAD_CANCELLED, HEAD_STALL and other faults, the link's errors.
        """
        with self._operation() as start:
            start(self._motor, Command.HOME, b'')
            state = self._finish(timeout, 'homing')
        if not state.homed:
            raise PsError(ErrorCode.HEAD_NOT_HOMED, 'homing ended without a home position')
        return state

    def move_to(self, target: int, motion: Motion, timeout: float = 20.0) -> HeadState:
        """Move the motor, always arriving from the same side.

        :param target: counts.
        :param timeout: of each leg, s.
        :raises PsError: HEAD_OUT_OF_LIMITS, HEAD_NOT_HOMED, HEAD_NOT_IN_POSITION, HEAD_CANCELLED,
            HEAD_STALL and other faults, the link's errors.
        """
        low, high = self.limits
        if not low <= target <= high:
            raise PsError(ErrorCode.HEAD_OUT_OF_LIMITS,
                          f'motor counts {target} are outside the soft limits {low} to {high}')
        with self._operation() as start:
            state = self.state()
            if not state.homed:
                raise PsError(ErrorCode.HEAD_NOT_HOMED, 'home the motor first')
            sign = 1 if motion.approach_up else -1
            # also from a position nearer than the play: the slider may hang on either side of it
            if sign * (target - state.motor_counts) < motion.overshoot_counts:
                start(self._motor, Command.MOVE, protocol.MOVE_REQUEST.pack(
                    target - sign * motion.overshoot_counts, motion.speed))
                self._finish(timeout, 'the move')
            start(self._motor, Command.MOVE, protocol.MOVE_REQUEST.pack(target, motion.speed))
            self._finish(timeout, 'the move')
            time.sleep(motion.settle_s)
            state = self.state()
        off = state.motor_counts - target
        if abs(off) > motion.tolerance_counts:
            raise PsError(ErrorCode.HEAD_NOT_IN_POSITION,
                          f'the motor stands at {state.motor_counts}, {off:+d} counts from its '
                          f'target (allowed: {motion.tolerance_counts})')
        return state

    def set_df_tilt(self, tilt: float, timeout: float = 3.0) -> HeadState:
        """Turn the dark-field panels.

        :param tilt: rad.
        :param timeout: s.
        :raises PsError: HEAD_NOT_IN_POSITION if it does not arrive; the link's errors.
        """
        with self._operation() as start:
            start(self._lights, Command.SERVO, protocol.SERVO_REQUEST.pack(
                max(0, min(round(tilt / TILT_UNIT), 0xFFFF))))
            deadline = time.monotonic() + timeout
            while True:
                state = self.state()
                if abs(state.df_tilt - tilt) < 2 * TILT_UNIT:
                    return state
                if time.monotonic() > deadline:
                    raise PsError(ErrorCode.HEAD_NOT_IN_POSITION,
                                  f'the dark-field servo stands at {state.df_tilt:.4f} rad, asked '
                                  f'for {tilt:.4f}')
                time.sleep(POLL_S)

    def set_gains(self, gains: Sequence[float]) -> None:
        """Relative intensity of each panel (order of PANEL_NAMES, 0 to 1) for later programs."""
        levels = tuple(round(gain * protocol.FULL_LEVEL) for gain in gains)
        with self._operation() as start:
            start(self._lights, Command.GAINS, protocol.GAINS_REQUEST.pack(*levels))
            self._gains = levels

    @property
    def gains(self) -> tuple[float, ...]:
        """Relative intensity of each panel, as the board has it."""
        return tuple(level / protocol.FULL_LEVEL for level in self._gains)

    def run_program(self, steps: Sequence[Step]) -> ProgramResult:
        """Upload and run a strobe program; the board runs it by itself.

        :raises PsError: if it could not be started; HEAD_PROGRAM_REJECTED, HEAD_BUSY, HEAD_FAULT,
            the link's errors.
        """
        most = self._lights.info.max_steps if self._lights and self._lights.info else 0
        if not 1 <= len(steps) <= most:
            raise PsError(ErrorCode.HEAD_PROGRAM_REJECTED,
                          f'a strobe program has 1 to {most} steps, not {len(steps)}')
        duration = sum(max(s.settle_us + s.strobe_us, s.period_us) for s in steps) * 1e-6
        error: PsError | None = None
        with self._operation() as start:
            for body in protocol.pack_steps(steps):
                start(self._lights, Command.STEPS, body)
            start(self._lights, Command.START, protocol.START_REQUEST.pack(len(steps)))
            try:
                state = self._finish(duration + 2.0, 'the strobe program', lights=True)
            except PsError as failure:
                if not self.connected:
                    raise
                error, state = failure, self.state()
            records = tuple(
                StepRecord.parse(self._ask(self._lights, Command.RECORD, bytes([i])))
                for i in range(state.steps_done))
        if self._motor is not self._lights:       # the board with the lights knows no motor
            records = tuple(replace(record, motor_counts=state.motor_counts)
                            if record.motor_counts == NO_MOTOR else record for record in records)
        if error is None and len(records) != len(steps):
            error = PsError(ErrorCode.HEAD_PROGRAM_ABORTED,
                            f'the program ended after {len(records)} of {len(steps)} steps')
        return ProgramResult(records, error)

    # ------------------------------------------------------------------ helpers

    def _ask(self, link: SerialLink | None, command: Command, body: bytes = b'') -> bytes:
        """Request that must be answered with OK."""
        if link is None:
            raise PsError(ErrorCode.HEAD_DISCONNECTED, 'the head is not connected')
        result, answer = link.request(command, body)
        if result is Result.OK:
            return answer
        if result is Result.FAULT:
            known = self.state().fault_error()
            if known is not None:
                raise PsError(known.code, f'{known.message}; call head_driver/clear_fault')
        code, text = _REFUSALS.get(result, (
            ErrorCode.HEAD_INTERNAL, f'the board answered {command.name} with {result.name}'))
        raise PsError(code, text)

    @contextmanager
    def _operation(self) -> Iterator[Callable[[SerialLink | None, Command, bytes], bytes]]:
        """Give a function that sends commands, and refuses to once stop() was called."""
        begun = self._stops

        def start(link: SerialLink | None, command: Command, body: bytes) -> bytes:
            with self._stop_lock:         # a stop comes before the command, or after it
                if self._stops != begun:
                    raise PsError(ErrorCode.HEAD_CANCELLED, 'stopped on request')
                return self._ask(link, command, body)

        yield start

    def _wait(self, activity: Activity, timeout: float) -> HeadState:
        deadline = time.monotonic() + timeout
        while True:
            state = self.state()
            if state.activity is activity:
                return state
            if time.monotonic() > deadline:
                raise PsError(ErrorCode.HEAD_LINK_TIMEOUT,
                              f'the board is still {state.activity.name} after {timeout:g} s')
            time.sleep(POLL_S)

    def _finish(self, timeout: float, what: str, lights: bool = False) -> HeadState:
        """Wait for the end of what was started on the board with the motor, or the lights.

        :raises PsError: if it did not end by itself.
        """
        try:
            state = self._wait(Activity.IDLE, timeout)
        except PsError as error:
            if error.code is ErrorCode.HEAD_LINK_TIMEOUT and self.connected:
                self.stop()
            raise
        end = state.lights_end if lights else state.motor_end
        if end is End.STOPPED:
            raise PsError(ErrorCode.HEAD_CANCELLED, f'{what} was stopped; panels are off')
        if end is End.FAULT:
            raise state.fault_error() or PsError(
                ErrorCode.HEAD_FAULT, f'{what} was ended by a fault')
        return state
