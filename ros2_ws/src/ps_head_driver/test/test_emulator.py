"""The firmware emulator as a reference of the protocol, on a virtual clock."""
import itertools
import math

from hypothesis import given, settings
from hypothesis import strategies as st
import pytest

from ps_head_driver import protocol
from ps_head_driver.fake.emulator import Board
from ps_head_driver.fake.lights import MAX_STEPS
from ps_head_driver.fake.motor import Motor
from ps_head_driver.fake.trigger_socket import StrobeEvent
from ps_head_driver.protocol import (
    FULL_LEVEL,
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
    Step,
    StepRecord,
)

MS = 1_000_000


class Bench:
    """A board, a host and a clock."""

    def __init__(self, backlash: float = 120.0, capabilities: int = 3) -> None:
        self.now = 1_000 * MS
        self.events: list[StrobeEvent] = []
        self.motor = Motor(backlash=backlash)
        self.board = Board(self.motor, lambda m: m * 1e-5, self.events.append,
                           capabilities=Capability(capabilities))
        self.board.reset(self.now)
        self.session, self.sequence = 77, 0
        self.ask(Command.HELLO, protocol.HELLO_REQUEST.pack(protocol.VERSION))

    def send(self, packet: Packet) -> list[Packet]:
        wire = self.board.receive(protocol.encode(packet), self.now)
        return FrameDecoder().feed(wire)

    def ask(self, command: int, body: bytes = b'') -> tuple[Result, bytes]:
        self.sequence = (self.sequence + 1) % 256
        reply, = self.send(Packet(command, self.sequence, self.session, body))
        assert reply.type == command | protocol.REPLY
        assert reply.sequence == self.sequence
        return Result(reply.body[0]), reply.body[1:]

    def status(self) -> Status:
        return Status.parse(self.ask(Command.STATUS)[1])

    def wait(self, ms: float, poll: bool = True) -> Status:
        for _ in range(max(1, round(ms / 10))):
            self.now += 10 * MS
            if poll:
                self.status()
        return self.status()

    def wait_idle(self) -> Status:
        for _ in range(2000):
            status = self.wait(10)
            if status.activity is Activity.IDLE:
                return status
        raise AssertionError('never idle')

    def home(self) -> None:
        self.ask(Command.LIMITS, protocol.LIMITS_REQUEST.pack(-600, 64000))
        assert self.ask(Command.HOME)[0] is Result.OK
        assert StatusFlag.HOMED in self.wait_idle().flags

    def move(self, target: int, speed: int = 0) -> Result:
        return self.ask(Command.MOVE, protocol.MOVE_REQUEST.pack(target, speed))[0]

    def program(self, steps: list[Step]) -> Result:
        for body in protocol.pack_steps(steps):
            assert self.ask(Command.STEPS, body)[0] is Result.OK
        return self.ask(Command.START, protocol.START_REQUEST.pack(len(steps)))[0]

    def records(self) -> list[StepRecord]:
        return [StepRecord.parse(self.ask(Command.RECORD, bytes([i]))[1])
                for i in range(self.status().steps_done)]


def ring(strobe_ms: float = 4, period_ms: float = 17) -> list[Step]:
    return [Step(1 << i, FULL_LEVEL, 2000, round(strobe_ms * 1000), round(period_ms * 1000))
            for i in range(4)]


# ---------------------------------------------------------------------------- link

def test_hello_says_who_it_is() -> None:
    bench = Bench()
    result, body = bench.ask(Command.HELLO, protocol.HELLO_REQUEST.pack(protocol.VERSION))
    assert result is Result.OK
    info = BoardInfo.parse(body)
    assert info.serial == 'FAKE-0001'
    assert info.capabilities == 3
    assert bench.ask(Command.HELLO, b'\x63')[0] is Result.WRONG_VERSION


def test_a_retry_is_answered_again_but_not_done_again() -> None:
    bench = Bench()
    bench.home()
    for body in protocol.pack_steps(ring()):
        bench.ask(Command.STEPS, body)
    start = Packet(Command.START, 200, bench.session, b'\4')
    first = bench.send(start)
    bench.wait_idle()
    assert bench.status().strobe_counter == 4
    bench.send(start)           # another sequence was last: this is a new request
    bench.wait_idle()
    assert bench.status().strobe_counter == 8
    assert bench.send(start) == bench.send(start) == first
    bench.wait_idle()
    assert bench.status().strobe_counter == 12


def test_other_sessions_and_a_restart_are_refused() -> None:
    bench = Bench()
    bench.home()
    reply, = bench.send(Packet(Command.MOVE, 9, 78, protocol.MOVE_REQUEST.pack(5000, 0)))
    assert reply.body == bytes([Result.WRONG_SESSION])
    bench.board.reset(bench.now)
    assert bench.ask(Command.STATUS)[0] is Result.WRONG_SESSION
    bench.ask(Command.HELLO, protocol.HELLO_REQUEST.pack(protocol.VERSION))
    assert StatusFlag.HOMED not in bench.status().flags
    assert bench.move(5000) is Result.NOT_HOMED


def test_bad_requests_have_an_answer() -> None:
    bench = Bench()
    assert bench.ask(0x7E)[0] is Result.UNKNOWN_COMMAND
    assert bench.ask(Command.MOVE, b'\1')[0] is Result.BAD_LENGTH
    assert bench.ask(Command.STEPS, b'\0')[0] is Result.BAD_LENGTH
    assert bench.ask(Command.RECORD, b'\0')[0] is Result.BAD_VALUE
    assert bench.ask(Command.LIMITS, protocol.LIMITS_REQUEST.pack(5, 5))[0] is Result.BAD_VALUE
    assert bench.ask(Command.SERVO, b'\xff\xff')[0] is Result.BAD_VALUE
    assert bench.ask(Command.START, b'\1')[0] is Result.REJECTED
    one = protocol.STEPS_HEAD.pack(3) + ring()[0].pack()
    assert bench.ask(Command.STEPS, one)[0] is Result.REJECTED       # a gap
    lights = Bench(capabilities=2)
    assert lights.ask(Command.HOME)[0] is Result.UNSUPPORTED
    assert lights.status().motor_counts == protocol.NO_MOTOR


@settings(max_examples=200, deadline=None)
@given(st.lists(st.one_of(
    st.binary(max_size=80),
    st.tuples(st.integers(0, 255), st.binary(max_size=56)))))
def test_no_bytes_crash_or_hang_the_board(messages: list) -> None:
    bench = Bench()
    for i, message in enumerate(messages):
        bench.now += 7 * MS
        if isinstance(message, bytes):
            bench.board.receive(message, bench.now)
        else:
            bench.send(Packet(message[0], i % 256, bench.session, message[1]))
    bench.now += 5000 * MS
    bench.board.receive(b'\0', bench.now)
    assert bench.status().activity in Activity


# ---------------------------------------------------------------------------- motion

def test_homing_and_moving_reach_their_target() -> None:
    bench = Bench()
    bench.home()
    assert bench.status().motor_counts == 0
    start = bench.now
    assert bench.move(64000) is Result.OK
    assert bench.wait(50).activity is Activity.MOVING
    status = bench.wait_idle()
    assert (status.end, status.motor_counts) == (End.DONE, 64000)
    travel_s = (bench.now - start) * 1e-9
    assert 64000 / 120_000 < travel_s < 0.8
    assert bench.move(64001) is Result.OUT_OF_LIMITS
    assert bench.move(-601) is Result.OUT_OF_LIMITS


def test_backlash_shows_after_a_reversal_only() -> None:
    bench = Bench(backlash=120)
    bench.home()
    for target, slider in ((20000, 20000), (30000, 30000), (25000, 25120), (24000, 24120),
                           (25000, 25000)):
        bench.move(target)
        assert bench.wait_idle().motor_counts == target
        assert bench.motor.slider == pytest.approx(slider, abs=1e-6)


def test_stop_and_speed() -> None:
    bench = Bench()
    bench.home()
    bench.move(60000, 10000)
    counts = bench.wait(500).motor_counts
    assert 3500 < counts < 5500
    assert bench.move(100) is Result.BUSY
    assert bench.ask(Command.STOP)[0] is Result.OK
    status = bench.wait_idle()
    assert status.end is End.STOPPED
    assert StatusFlag.HOMED in status.flags
    assert status.motor_counts < counts + 500


def test_stall_is_noticed_latched_and_needs_homing() -> None:
    bench = Bench()
    bench.home()
    bench.move(40000)
    bench.wait(50)
    bench.motor.stalled = True
    status = bench.wait_idle()
    assert (status.end, status.faults) == (End.FAULT, Fault.STALL)
    assert StatusFlag.HOMED not in status.flags
    bench.motor.stalled = False
    assert bench.ask(Command.HOME)[0] is Result.FAULT
    assert bench.ask(Command.CLEAR_FAULT)[0] is Result.OK
    bench.home()


# ---------------------------------------------------------------------------- strobes

def test_program_runs_at_exact_times() -> None:
    bench = Bench()
    assert bench.program(ring()) is Result.OK
    status = bench.wait_idle()
    assert (status.end, status.steps_done) == (End.DONE, 4)
    records = bench.records()
    assert [record.strobe_counter for record in records] == [1, 2, 3, 4]
    assert [b.time_us - a.time_us for a, b in itertools.pairwise(records)] == [
        17000] * 3
    assert all(record.strobe_us == 4000 for record in records)
    for i, (record, event) in enumerate(zip(records, bench.events, strict=True)):
        assert event.bf_levels == tuple(float(k == i) for k in range(4))
        assert event.df_levels == (0, 0, 0, 0)
        assert event.device_time_ns == record.time_us * 1000
        assert event.strobe_counter == event.trigger_counter == record.strobe_counter


def test_gains_dim_panels_and_ambient_is_dark() -> None:
    bench = Bench()
    gains = [FULL_LEVEL] * 8
    gains[4] = FULL_LEVEL // 2
    bench.ask(Command.GAINS, protocol.GAINS_REQUEST.pack(*gains))
    steps = [Step(1 << 4, FULL_LEVEL, 0, 1000, 2000), Step(0, 0, 0, 1000, 2000),
             Step(0xFF, FULL_LEVEL // 4, 0, 1000, 2000, trigger=False)]
    assert bench.program(steps) is Result.OK
    bench.wait_idle()
    assert bench.events[0].df_levels[0] == pytest.approx(0.5, abs=1e-4)
    assert bench.events[1].bf_levels + bench.events[1].df_levels == (0.0,) * 8
    assert bench.events[2].bf_levels == pytest.approx([0.25] * 4, abs=1e-4)
    assert [event.trigger_counter for event in bench.events] == [1, 2, 2]


def test_on_time_and_duty_limits() -> None:
    bench = Bench()
    assert bench.program([Step(1, FULL_LEVEL, 0, 4_500_000, 0)]) is Result.REJECTED
    assert bench.program([Step(0, 0, 0, 4_500_000, 0)]) is Result.OK      # dark: no limit
    bench.ask(Command.STOP)
    busy = [Step(1, FULL_LEVEL, 0, 100_000, 100_000)] * MAX_STEPS
    assert bench.program(busy) is Result.REJECTED
    rested = [Step(1, FULL_LEVEL, 0, 100_000, 400_000)] * MAX_STEPS
    assert bench.program(rested) is Result.OK
    assert bench.wait_idle().steps_done == MAX_STEPS


def test_abort_ends_the_strobe_and_tells_the_truth() -> None:
    bench = Bench()
    bench.program([Step(1, FULL_LEVEL, 0, 500_000, 0)] * 2)
    assert StatusFlag.PANELS_ON in bench.wait(100).flags
    bench.ask(Command.STOP)
    status = bench.status()
    assert status.activity is Activity.IDLE
    assert (status.end, status.steps_done, status.strobe_counter) == (End.STOPPED, 0, 1)
    assert StatusFlag.PANELS_ON not in status.flags
    assert bench.events[0].strobe_s == pytest.approx(0.1, abs=0.011)


@pytest.mark.parametrize('activity', ['moving', 'strobing'])
def test_watchdog_acts_within_half_a_second(activity: str) -> None:
    bench = Bench()
    bench.home()
    if activity == 'moving':
        bench.move(60000, 5000)
    else:
        bench.program([Step(1, FULL_LEVEL, 0, 1_900_000, 0)])
    silent_from = bench.now
    bench.now += 500 * MS
    bench.board.advance(bench.now)
    state = bench.board.status()
    assert state.activity is Activity.IDLE
    assert StatusFlag.PANELS_ON not in state.flags
    assert state.faults == Fault.WATCHDOG
    if activity == 'strobing':
        assert bench.events[0].strobe_s < 0.36
    else:
        assert bench.motor.counts < 5000 * 0.4
    assert bench.now - silent_from == 500 * MS


def test_led_open_and_over_temperature_stop_the_program() -> None:
    bench = Bench()
    bench.board.lights.open_panels = 1 << 2
    bench.program(ring())
    status = bench.wait_idle()
    assert (status.faults, status.fault_panels, status.steps_done) == (Fault.LED_OPEN, 4, 2)
    assert bench.program(ring()) is Result.FAULT
    bench.board.lights.open_panels = 0
    bench.ask(Command.CLEAR_FAULT)
    assert bench.program(ring()) is Result.OK
    bench.wait(20)
    bench.board.lights.extra_heat[5] = 80.0
    status = bench.wait_idle()
    assert (status.end, status.faults) == (End.FAULT, Fault.OVER_TEMPERATURE)
    assert status.fault_panels == 1 << 5
    bench.ask(Command.CLEAR_FAULT)
    assert bench.status().faults is Fault.OVER_TEMPERATURE        # still hot
    bench.board.lights.extra_heat[5] = 0.0
    bench.ask(Command.CLEAR_FAULT)
    assert bench.status().faults == 0


def test_panels_warm_up_and_cool_down() -> None:
    bench = Bench()
    cold = bench.status().temperatures[0]
    bench.program([Step(1, FULL_LEVEL, 0, 1_900_000, 0)])
    warm = bench.wait_idle().temperatures[0]
    assert 10 < (warm - cold) * protocol.TEMPERATURE_UNIT < 16
    assert bench.wait(60_000).temperatures[0] < warm


def test_servo_takes_its_time() -> None:
    bench = Bench()
    bench.ask(Command.SERVO, protocol.SERVO_REQUEST.pack(15000))
    assert bench.wait(10).df_tilt_units < 15000
    assert bench.wait(100).df_tilt_units == 15000
    assert math.isclose(bench.board.lights.tilt(10**9), 1.5)
