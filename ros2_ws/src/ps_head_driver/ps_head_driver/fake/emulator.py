"""Firmware emulator: one board as docs/protocol.md describes it, driven by an injected clock.

Pure: bytes in, bytes out, strobe events to a callback. The process around it is
emulator_process.py.
"""
from collections.abc import Callable

from ps_head_driver.fake.lights import MAX_STEPS, MAX_TILT_UNITS, Lights
from ps_head_driver.fake.motor import TICK_S, Motor, Phase
from ps_head_driver.fake.trigger_socket import StrobeEvent
from ps_head_driver.protocol import (
    FULL_LEVEL,
    GAINS_REQUEST,
    HELLO_REQUEST,
    LIMITS_REQUEST,
    MOVE_REQUEST,
    NO_MOTOR,
    NOT_MEASURED,
    PANELS,
    RECORD_REQUEST,
    REPLY,
    SERVO_REQUEST,
    START_REQUEST,
    STEP,
    STEPS_HEAD,
    STEPS_PER_PACKET,
    TILT_UNIT,
    VERSION,
    Activity,
    BoardInfo,
    Capability,
    Command,
    End,
    Fault,
    FrameDecoder,
    Packet,
    Result,
    Status,
    StatusFlag,
    StepRecord,
    encode,
    parse_steps,
)

FIRMWARE = (0, 1, 0)
WATCHDOG_US = 350_000
TICK_US = round(TICK_S * 1e6)
BOTH = Capability.MOTOR | Capability.LIGHTS

_LENGTHS = {
    Command.HELLO: HELLO_REQUEST.size, Command.STATUS: 0, Command.LIMITS: LIMITS_REQUEST.size,
    Command.HOME: 0, Command.MOVE: MOVE_REQUEST.size, Command.STOP: 0,
    Command.SERVO: SERVO_REQUEST.size, Command.GAINS: GAINS_REQUEST.size,
    Command.START: START_REQUEST.size, Command.RECORD: RECORD_REQUEST.size,
    Command.CLEAR_FAULT: 0}
_STEPS_LENGTHS = tuple(
    STEPS_HEAD.size + count * STEP.size for count in range(1, STEPS_PER_PACKET + 1))
_NEEDS = {
    Command.LIMITS: Capability.MOTOR, Command.HOME: Capability.MOTOR,
    Command.MOVE: Capability.MOTOR, Command.SERVO: Capability.LIGHTS,
    Command.GAINS: Capability.LIGHTS, Command.STEPS: Capability.LIGHTS,
    Command.START: Capability.LIGHTS, Command.RECORD: Capability.LIGHTS}
_ONLY_IDLE = (Command.LIMITS, Command.HOME, Command.MOVE, Command.SERVO, Command.GAINS,
              Command.STEPS, Command.START)
_NOT_IN_FAULT = (Command.HOME, Command.MOVE, Command.START)
_ACTIVITIES = {
    Phase.IDLE: Activity.IDLE, Phase.MOVING: Activity.MOVING, Phase.STOPPING: Activity.STOPPING,
    Phase.HOMING_DOWN: Activity.HOMING, Phase.HOMING_UP: Activity.HOMING,
    Phase.HOMING_ZERO: Activity.HOMING}


class Board:
    """One board, with motor, lights or both.

    :param motor: the model it drives; two boards of one head share motor and lights.
    :param tilt_of: slider position (counts) to bright-field tilt (rad), for strobe events.
    :param on_strobe: gets every strobe as it really was.
    """

    def __init__(
        self, motor: Motor, tilt_of: Callable[[float], float],
        on_strobe: Callable[[StrobeEvent], None], serial: str = 'FAKE-0001',
        capabilities: Capability = BOTH,
    ) -> None:
        self.motor = motor
        self.lights = Lights(self._strobe_ended, self._counts)
        self.boot = 0
        self.info = BoardInfo(VERSION, FIRMWARE, capabilities, MAX_STEPS, serial)
        self._tilt_of, self._on_strobe = tilt_of, on_strobe
        self._power_up_ns = 0
        self._time_us = 0
        self._power_up()

    def _power_up(self) -> None:
        self.boot += 1
        self._time_us = 0
        self._decoder = FrameDecoder()
        self._session = 0
        self._last: tuple[Packet, bytes] | None = None   # request and the reply to it
        self._heard_us = 0
        self._next_tick_us = 0
        self._limits = (0, 0)
        self._end = End.NONE
        self._faults, self._fault_panels = Fault(0), 0

    def reset(self, now_ns: int) -> None:
        """Restart, as after a brown-out: panels off, motor dead, position unknown."""
        self.advance(now_ns)
        self.lights.abort(self._time_us)
        if Capability.MOTOR in self.info.capabilities:
            self.motor.kill()
        self.lights.reset()
        self._power_up()
        self._power_up_ns = now_ns

    # ------------------------------------------------------------------ time

    def advance(self, now_ns: int) -> None:
        """Let everything happen that is due until now, at its exact time and in order."""
        now_us = max((now_ns - self._power_up_ns) // 1000, self._time_us)
        while True:
            due = {self._watchdog: self._heard_us + WATCHDOG_US} if self._active else {}
            if self._moving:
                due[self._tick] = self._next_tick_us
            strobe_us = self.lights.next_us()
            if strobe_us is not None:
                due[self._strobe] = strobe_us
            action = min(due, key=due.__getitem__, default=None)
            if action is None or due[action] > now_us:
                break
            self._time_us = max(self._time_us, due[action])
            action()
        self._time_us = now_us
        self._check_heat()

    def next_event_ns(self) -> int | None:
        """When advance() should be called next; None if nothing is going on."""
        times = [time for time in (
            self.lights.next_us(), self._heard_us + WATCHDOG_US if self._active else None)
            if time is not None]
        return self._power_up_ns + min(times) * 1000 if times else None

    @property
    def _moving(self) -> bool:
        return self.motor.busy and Capability.MOTOR in self.info.capabilities

    @property
    def _active(self) -> bool:
        return self.lights.running or (self._moving and self.motor.phase is not Phase.STOPPING)

    def _watchdog(self) -> None:
        self._fail(Fault.WATCHDOG)

    def _tick(self) -> None:
        self._next_tick_us = self._time_us + TICK_US
        outcome = self.motor.tick()
        if outcome == 'done':
            self._end = End.DONE
        elif outcome in ('stall', 'limit'):
            self._fail(Fault.STALL if outcome == 'stall' else Fault.LIMIT)

    def _strobe(self) -> None:
        open_panels = self.lights.step()
        if open_panels:
            self._fail(Fault.LED_OPEN, open_panels)
        elif not self.lights.running:
            self._end = End.DONE
        self._check_heat()

    def _check_heat(self) -> None:
        hot = self.lights.hot_panels(self._time_us)
        if hot and Capability.LIGHTS in self.info.capabilities:
            self._fail(Fault.OVER_TEMPERATURE, hot)

    def _fail(self, fault: Fault, panels: int = 0) -> None:
        if fault not in self._faults or self.activity is not Activity.IDLE:
            self._end = End.FAULT
        self._faults |= fault
        self._fault_panels |= panels
        self._halt(End.FAULT)

    def _halt(self, end: End) -> None:
        if self.lights.running or self._moving:
            self._end = end
        self.lights.abort(self._time_us)
        if Capability.MOTOR in self.info.capabilities:
            self.motor.stop()

    def _strobe_ended(self, record: StepRecord) -> None:
        lit = tuple(
            0.0 if self.lights.open_panels >> i & 1 else level / FULL_LEVEL
            for i, level in enumerate(record.levels))
        self._on_strobe(StrobeEvent(
            strobe_counter=record.strobe_counter, trigger_counter=record.trigger_counter,
            device_time_ns=record.time_us * 1000, strobe_s=record.strobe_us * 1e-6,
            bf_levels=(lit[0], lit[1], lit[2], lit[3]), df_levels=(lit[4], lit[5], lit[6], lit[7]),
            motor_counts=self.motor.slider, tilt=self._tilt_of(self.motor.slider),
            df_tilt=self.lights.tilt(record.time_us), boot=self.boot))

    def _counts(self) -> int:
        return self.motor.counts if Capability.MOTOR in self.info.capabilities else NO_MOTOR

    # ------------------------------------------------------------------ requests

    def receive(self, data: bytes, now_ns: int) -> bytes:
        """Take bytes from the host.

        :returns: bytes to the host.
        """
        self.advance(now_ns)
        return b''.join(map(self._answer, self._decoder.feed(data)))

    def _answer(self, packet: Packet) -> bytes:
        if packet.type & REPLY:                 # an echo of a reply; never answered
            return b''
        if packet.type == Command.HELLO:
            reply = self._hello(packet)
        elif packet.session != self._session or not packet.session:
            return self._reply(packet, Result.WRONG_SESSION)
        else:
            self._heard_us = self._time_us
            if self._last is not None and self._last[0] == packet:
                return self._last[1]            # a retry: say it again, do not do it again
            reply = self._execute(packet)
        self._last = (packet, reply)
        return reply

    def _hello(self, packet: Packet) -> bytes:
        if len(packet.body) != HELLO_REQUEST.size or not packet.session:
            return self._reply(packet, Result.BAD_LENGTH)
        if packet.session != self._session:     # a new host finds everything off
            self._halt(End.STOPPED)
        self._session, self._heard_us = packet.session, self._time_us
        wanted, = HELLO_REQUEST.unpack(packet.body)
        result = Result.OK if wanted == VERSION else Result.WRONG_VERSION
        return self._reply(packet, result, self.info.pack())

    def _execute(self, packet: Packet) -> bytes:
        try:
            command = Command(packet.type)
        except ValueError:
            return self._reply(packet, Result.UNKNOWN_COMMAND)
        if len(packet.body) not in (
                _STEPS_LENGTHS if command is Command.STEPS else (_LENGTHS[command],)):
            return self._reply(packet, Result.BAD_LENGTH)
        if command in _NEEDS and _NEEDS[command] not in self.info.capabilities:
            return self._reply(packet, Result.UNSUPPORTED)
        if command in _ONLY_IDLE and self.activity is not Activity.IDLE:
            return self._reply(packet, Result.BUSY)
        if command in _NOT_IN_FAULT and self._faults:
            return self._reply(packet, Result.FAULT)
        result, body = getattr(self, f'_do_{command.name.lower()}')(packet.body)
        return self._reply(packet, result, body)

    def _reply(self, packet: Packet, result: Result, body: bytes = b'') -> bytes:
        return encode(Packet(packet.type | REPLY, packet.sequence, packet.session,
                             bytes([result]) + body))

    @property
    def activity(self) -> Activity:
        """What the board is doing."""
        if self.lights.running:
            return Activity.STROBING
        return _ACTIVITIES[self.motor.phase] if self._moving else Activity.IDLE

    def status(self) -> Status:
        """What STATUS answers."""
        motor, now_us = Capability.MOTOR in self.info.capabilities, self._time_us
        lights = Capability.LIGHTS in self.info.capabilities
        flags = StatusFlag(0)
        if motor and self.motor.homed:
            flags |= StatusFlag.HOMED
        if motor and self.motor.at_switch:
            flags |= StatusFlag.HOME_SWITCH
        if any(self.lights.levels):
            flags |= StatusFlag.PANELS_ON
        return Status(
            self.activity, self._end, flags, self._faults, self._fault_panels,
            self._counts(),
            round(self.lights.tilt(now_us) / TILT_UNIT) if lights else NOT_MEASURED,
            len(self.lights.records), self.lights.strobe_counter, self.lights.trigger_counter,
            now_us, self.lights.temperatures(now_us) if lights else (NOT_MEASURED,) * PANELS)

    def _do_status(self, _body: bytes) -> tuple[Result, bytes]:
        return Result.OK, self.status().pack()

    def _do_limits(self, body: bytes) -> tuple[Result, bytes]:
        low, high = LIMITS_REQUEST.unpack(body)
        if low >= high:
            return Result.BAD_VALUE, b''
        self._limits = (low, high)
        return Result.OK, b''

    def _do_home(self, _body: bytes) -> tuple[Result, bytes]:
        self._begin()
        self.motor.home()
        return Result.OK, b''

    def _do_move(self, body: bytes) -> tuple[Result, bytes]:
        target, speed = MOVE_REQUEST.unpack(body)
        if not self.motor.homed:
            return Result.NOT_HOMED, b''
        if not self._limits[0] <= target <= self._limits[1]:
            return Result.OUT_OF_LIMITS, b''
        self._begin()
        self.motor.move(target, float(speed))
        return Result.OK, b''

    def _do_stop(self, _body: bytes) -> tuple[Result, bytes]:
        self._halt(End.STOPPED)
        return Result.OK, b''

    def _do_servo(self, body: bytes) -> tuple[Result, bytes]:
        units, = SERVO_REQUEST.unpack(body)
        if units > MAX_TILT_UNITS:
            return Result.BAD_VALUE, b''
        self.lights.set_tilt(units, self._time_us)
        return Result.OK, b''

    def _do_gains(self, body: bytes) -> tuple[Result, bytes]:
        self.lights.gains = GAINS_REQUEST.unpack(body)
        return Result.OK, b''

    def _do_steps(self, body: bytes) -> tuple[Result, bytes]:
        first, steps = parse_steps(body)
        program = [] if first == 0 else self.lights.program
        if first != len(program) or first + len(steps) > MAX_STEPS:
            return Result.REJECTED, b''
        self.lights.program = [*program, *steps]
        return Result.OK, b''

    def _do_start(self, body: bytes) -> tuple[Result, bytes]:
        count, = START_REQUEST.unpack(body)
        if not self.lights.acceptable(count, self._time_us):
            return Result.REJECTED, b''
        self._begin()
        self.lights.start(self._time_us)
        return Result.OK, b''

    def _do_record(self, body: bytes) -> tuple[Result, bytes]:
        index, = RECORD_REQUEST.unpack(body)
        if index >= len(self.lights.records):
            return Result.BAD_VALUE, b''
        return Result.OK, self.lights.records[index].pack()

    def _do_clear_fault(self, _body: bytes) -> tuple[Result, bytes]:
        hot = self.lights.hot_panels(self._time_us)
        self._faults = self._faults & Fault.OVER_TEMPERATURE if hot else Fault(0)
        self._fault_panels = hot if self._faults else 0
        return Result.OK, b''

    def _begin(self) -> None:
        self._end = End.NONE
        self._next_tick_us = self._time_us + TICK_US
