"""Reference firmware: the C core against the vectors, the emulator's tests and the real link."""
from collections.abc import Callable, Iterator
import ctypes
from dataclasses import replace
import os
from pathlib import Path
import random
import shutil
import struct
import subprocess
import threading
import time
import tty

from firmware_vectors import FIRMWARE, VECTORS, vectors
import pytest
import test_emulator

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.head_client import HeadClient, Motion
from ps_head_driver.protocol import (
    FULL_LEVEL,
    VERSION,
    Activity,
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
    encode,
)
from ps_head_driver.serial_link import SerialLink

MOTION = Motion(settle_s=0.0)
RING = [Step(1 << i, FULL_LEVEL, 2000, 4000, 17000) for i in range(4)]


def test_vectors_are_those_of_the_protocol_module() -> None:
    assert VECTORS.read_text() == vectors(), 'run test/firmware_vectors.py'


@pytest.fixture(scope='module')
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with what `make host` builds."""
    if shutil.which('make') is None or shutil.which('cc') is None:
        pytest.skip('no C compiler: firmware not tested')
    folder = tmp_path_factory.mktemp('firmware')
    made = subprocess.run(['make', '-s', 'host', f'BUILD={folder}'], cwd=FIRMWARE,
                          capture_output=True, text=True, timeout=120)
    assert made.returncode == 0, made.stderr
    return folder


def test_vectors_and_noise_with_sanitizers(built: Path) -> None:
    run = subprocess.run([built / 'unit_test', VECTORS, '20000'], capture_output=True, text=True,
                         timeout=60)
    assert run.returncode == 0, run.stdout + run.stderr
    assert f'{len(vectors().splitlines()) - 1} vectors' in run.stdout


# ---------------------------------------------------------------------------- virtual clock

class Host(ctypes.Structure):
    """struct host of firmware/host/board_host.h."""

    _fields_ = [
        ('time_us', ctypes.c_uint64), ('real_time', ctypes.c_bool),
        ('capabilities', ctypes.c_uint8), ('input', ctypes.c_uint8 * 8192),
        ('output', ctypes.c_uint8 * 8192), ('input_length', ctypes.c_uint32),
        ('input_read', ctypes.c_uint32), ('output_length', ctypes.c_uint32),
        ('stalled', ctypes.c_bool), ('open_panels', ctypes.c_uint8), ('heat', ctypes.c_uint16),
        ('position', ctypes.c_int32), ('lit', ctypes.c_uint8), ('triggers', ctypes.c_uint32),
        ('dark_since_us', ctypes.c_uint64)]


class FirmwareBoard:
    """The C core with the interface of ps_head_driver.fake.emulator.Board that its tests use."""

    def __init__(self, library: Path, capabilities: int) -> None:
        self._library = ctypes.CDLL(str(library))
        self._library.host_advance.argtypes = [ctypes.c_uint64]
        self.host = Host.in_dll(self._library, 'host')
        self._capabilities, self._power_up_ns = capabilities, 0

    def reset(self, now_ns: int) -> None:
        self._library.host_power_up(self._capabilities, 9000)
        self._power_up_ns = now_ns

    def advance(self, now_ns: int) -> None:
        self._library.host_advance((now_ns - self._power_up_ns) // 1000)

    def receive(self, data: bytes, now_ns: int) -> bytes:
        self.advance(now_ns)
        return bytes(self.host.output[:self._library.host_receive(data, len(data))])


class FirmwareBench(test_emulator.Bench):
    """The bench of the emulator's tests with the C core on it."""

    library: Path

    def __init__(self, backlash: float = 0.0, capabilities: int = 3) -> None:
        self.now = 1_000_000_000
        self.board = FirmwareBoard(self.library, capabilities)  # type: ignore[assignment]
        self.host = self.board.host                             # type: ignore[attr-defined]
        self.board.reset(self.now)
        self.session, self.sequence = 77, 0
        self.ask(Command.HELLO, bytes([VERSION]))


@pytest.fixture
def bench(built: Path, monkeypatch: pytest.MonkeyPatch) -> FirmwareBench:
    monkeypatch.setattr(FirmwareBench, 'library', built / 'libhead.so', raising=False)
    monkeypatch.setattr(test_emulator, 'Bench', FirmwareBench)
    return FirmwareBench()


@pytest.mark.parametrize('test', [
    test_emulator.test_a_retry_is_answered_again_but_not_done_again,
    test_emulator.test_other_sessions_and_a_restart_are_refused,
    test_emulator.test_bad_requests_have_an_answer,
    test_emulator.test_homing_and_moving_reach_their_target,
    test_emulator.test_stop_and_speed,
    test_emulator.test_on_time_and_duty_limits,
], ids=lambda test: test.__name__.removeprefix('test_'))
def test_the_firmware_passes_the_tests_of_the_emulator(
        bench: FirmwareBench, test: Callable[[], None]) -> None:
    test()


def test_program_runs_at_exact_times(bench: FirmwareBench) -> None:
    bench.program(RING)
    status = bench.wait_idle()
    assert (status.end, status.steps_done, bench.host.triggers) == (End.DONE, 4, 4)
    records = bench.records()
    assert [record.strobe_counter for record in records] == [1, 2, 3, 4]
    assert [record.time_us - records[0].time_us for record in records] == [
        0, 17000, 34000, 51000]
    assert [record.strobe_us for record in records] == [4000] * 4
    assert [record.levels.index(FULL_LEVEL) for record in records] == [0, 1, 2, 3]


@pytest.mark.parametrize('activity', [Activity.HOMING, Activity.MOVING, Activity.STROBING])
def test_watchdog(bench: FirmwareBench, activity: Activity) -> None:
    bench.home()
    if activity is Activity.STROBING:
        bench.program([Step(1, FULL_LEVEL, 0, 1_900_000, 0)])
    elif activity is Activity.MOVING:
        bench.move(60000, 50000)
    else:
        bench.move(30000)
        bench.wait_idle()
        bench.ask(Command.HOME)
    assert bench.status().activity is activity
    silent_us, position = bench.host.time_us, bench.host.position
    bench.now += 500_000_000
    bench.board.advance(bench.now)
    stood = bench.host.position
    assert bench.host.lit == 0
    assert bench.host.dark_since_us - silent_us < 352_000 or activity is not Activity.STROBING
    assert position != stood or activity is Activity.STROBING
    status = bench.wait(100)
    assert bench.host.position == stood
    assert (status.activity, status.end, status.faults) == (
        Activity.IDLE, End.FAULT, Fault.WATCHDOG)


def test_stall_open_led_and_heat(bench: FirmwareBench) -> None:
    bench.home()
    bench.move(40000)
    bench.wait(50)
    bench.host.stalled = True
    status = bench.wait_idle()
    assert (status.end, status.faults) == (End.FAULT, Fault.STALL)
    assert StatusFlag.HOMED not in status.flags
    bench.host.stalled = False
    bench.ask(Command.CLEAR_FAULT)
    bench.home()

    bench.host.open_panels = 4
    bench.program(RING)
    status = bench.wait_idle()
    assert (status.faults, status.fault_panels, status.steps_done) == (Fault.LED_OPEN, 4, 2)
    bench.host.open_panels = 0
    bench.ask(Command.CLEAR_FAULT)

    bench.program(RING)
    bench.wait(20)
    bench.host.heat = 8000
    status = bench.wait_idle()
    assert (status.faults, status.fault_panels) == (Fault.OVER_TEMPERATURE, 1 << 5)
    bench.ask(Command.CLEAR_FAULT)
    assert bench.status().faults is Fault.OVER_TEMPERATURE
    bench.host.heat = 0
    bench.ask(Command.CLEAR_FAULT)
    assert bench.status().faults == 0


def test_servo_and_stop(bench: FirmwareBench) -> None:
    bench.ask(Command.SERVO, (15000).to_bytes(2, 'little'))
    assert 13000 < bench.wait(10).df_tilt_units < 15000
    assert bench.wait(100).df_tilt_units == 15000
    bench.program([Step(1, FULL_LEVEL, 0, 500_000, 0)] * 2)
    assert StatusFlag.PANELS_ON in bench.wait(100).flags
    bench.ask(Command.STOP)
    status = bench.status()
    assert (status.end, status.steps_done, status.strobe_counter) == (End.STOPPED, 0, 1)
    assert bench.host.lit == 0


def random_request(chance: random.Random) -> tuple[Command, bytes]:
    """A command with a body that is sensible more often than not."""
    command = chance.choice([c for c in Command if c is not Command.HELLO])
    if chance.random() < 0.1:
        return command, chance.randbytes(chance.randrange(20))
    step = Step(chance.randrange(256), chance.choice((0, 20000, FULL_LEVEL)),
                chance.randrange(3000), chance.choice((0, 1000, 30_000, 5_000_000)),
                chance.randrange(40_000), chance.random() < 0.8).pack()
    return command, {
        Command.LIMITS: struct.pack('<ii', chance.choice((-400, 900)), chance.choice((800, 9000))),
        Command.MOVE: struct.pack('<iI', chance.randrange(-1000, 10000), chance.randrange(90000)),
        Command.SERVO: struct.pack('<H', chance.randrange(40000)),
        Command.GAINS: struct.pack('<8H', *(chance.randrange(65536) for _ in range(8))),
        Command.STEPS: bytes([chance.choice((0, 0, 1, 2, 4))]) + step * chance.randint(1, 3),
        Command.START: bytes([chance.randint(0, 4)]),
        Command.RECORD: bytes([chance.randrange(4)]),
    }.get(command, b'')


@pytest.mark.parametrize('seed', range(5))
def test_firmware_and_emulator_answer_alike(
        built: Path, monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    monkeypatch.setattr(FirmwareBench, 'library', built / 'libhead.so', raising=False)
    benches = FirmwareBench(), test_emulator.Bench(backlash=0.0)
    chance, results = random.Random(seed), set()
    for bench in benches:
        bench.home()
    for _ in range(400):
        command, body = random_request(chance)
        (code, reply), (wanted, wanted_reply) = (bench.ask(command, body) for bench in benches)
        assert code is wanted, command
        results.add(code)
        if command is Command.RECORD and code is Result.OK:
            record, model = StepRecord.parse(reply), StepRecord.parse(wanted_reply)
            assert replace(record, time_us=0) == replace(model, time_us=0)
        if command in (Command.HOME, Command.MOVE, Command.START, Command.STOP):
            if command in (Command.HOME, Command.MOVE) and chance.random() < 0.3:
                continue                  # the next request finds it busy
            states = [bench.wait_idle() for bench in benches]
            assert len({(s.end, s.flags, s.faults, s.steps_done, s.strobe_counter,
                         s.trigger_counter) for s in states}) == 1, states
    assert len(results) >= 6


# ---------------------------------------------------------------------------- real clock

@pytest.fixture
def port(built: Path) -> Iterator[tuple[str, int]]:
    """Pseudo-terminal with the firmware as a process behind it, and the process id."""
    master, slave = os.openpty()
    tty.setraw(slave)
    process = subprocess.Popen([built / 'head_stdio'], stdin=master, stdout=master)
    os.close(master)
    yield os.ttyname(slave), process.pid
    process.kill()
    process.wait()
    os.close(slave)


@pytest.fixture
def client(port: tuple[str, int]) -> Iterator[HeadClient]:
    client = HeadClient([SerialLink(port[0])], (0, 64000))
    client.connect(MOTION)
    yield client
    client.disconnect()


def test_the_driver_homes_moves_and_strobes(client: HeadClient) -> None:
    assert client.boards[0].serial == 'FIRMWARE-HOST'
    assert client.boards[0].capabilities == Capability.MOTOR | Capability.LIGHTS
    assert client.home().motor_counts == 0
    for target in (20000, 19900):
        assert client.move_to(target, MOTION).motor_counts == target
    client.set_df_tilt(1.2)
    client.set_gains([0.5] + [1.0] * 7)
    result = client.run_program(RING)
    assert result.error is None
    assert [record.motor_counts for record in result.records] == [19900] * 4
    assert result.records[0].levels[0] == pytest.approx(FULL_LEVEL / 2, abs=1)


def test_stop_from_another_thread(client: HeadClient) -> None:
    threading.Timer(0.15, client.stop).start()
    result = client.run_program([Step(1, FULL_LEVEL, 0, 1_500_000, 0)])
    assert result.error is not None
    assert result.error.code is ErrorCode.HEAD_CANCELLED
    assert not client.state().panels_on


def test_silence_is_a_watchdog_fault_that_reconnecting_clears(
        port: tuple[str, int], client: HeadClient) -> None:
    link = client.links[0]
    link.request(Command.STEPS, b'\0' + Step(1, FULL_LEVEL, 0, 1_900_000, 0).pack())
    link.request(Command.START, b'\1')
    assert client.state().panels_on
    time.sleep(0.45)
    state = client.state()
    assert not state.panels_on
    assert state.faults is Fault.WATCHDOG
    client.disconnect()
    assert client.connect(MOTION).faults == 0


def test_damaged_and_repeated_requests_on_a_real_line(port: tuple[str, int]) -> None:
    line = os.open(port[0], os.O_RDWR | os.O_NOCTTY)
    tty.setraw(line)
    decoder = FrameDecoder()

    def ask(*wires: bytes) -> list[Packet]:
        packets: list[Packet] = []
        os.write(line, b''.join(wires))
        deadline = time.monotonic() + 0.3
        os.set_blocking(line, False)
        while time.monotonic() < deadline:
            try:
                packets += decoder.feed(os.read(line, 4096))
            except BlockingIOError:
                time.sleep(0.005)
        return packets

    try:
        hello = encode(Packet(Command.HELLO, 1, 5, bytes([VERSION])))
        program = encode(Packet(Command.STEPS, 2, 5, b'\0' + Step(0, 0, 0, 1000, 0).pack()))
        start = encode(Packet(Command.START, 3, 5, b'\1'))
        assert [p.body[0] for p in ask(os.urandom(300) + b'\0', hello, program)] == [0, 0]
        damaged = bytes([start[0], start[1] ^ 1]) + start[2:]
        first, second = ask(damaged, start, start)
        assert first == second
        status, = ask(encode(Packet(Command.STATUS, 4, 5)))
        assert Status.parse(status.body[1:]).strobe_counter == 1          # run once
    finally:
        os.close(line)


def test_a_killed_board_is_a_closed_or_silent_line(
        port: tuple[str, int], client: HeadClient) -> None:
    os.kill(port[1], 9)
    with pytest.raises(PsError) as error:
        client.state()
    assert error.value.code in (ErrorCode.HEAD_DISCONNECTED, ErrorCode.HEAD_LINK_TIMEOUT)


# ---------------------------------------------------------------------------- AVR

def test_the_avr_binary_in_the_simulator(tmp_path: Path) -> None:
    if shutil.which('avr-gcc') is None or not Path('/usr/include/simavr').is_dir():
        pytest.skip('gcc-avr or libsimavr-dev is not installed: AVR binary not run')
    made = subprocess.run(['make', '-s', 'simulator', f'BUILD={tmp_path}'], cwd=FIRMWARE,
                          capture_output=True, text=True, timeout=120)
    assert made.returncode == 0, made.stderr
    master, slave = os.openpty()
    tty.setraw(slave)
    process = subprocess.Popen([tmp_path / 'simulator', tmp_path / 'head.elf'],
                               stdin=master, stdout=master)
    os.close(master)
    client = HeadClient([SerialLink(os.ttyname(slave), boot_s=2.0)], (0, 64000))
    try:
        state = client.connect(MOTION)
        assert client.boards[0].serial == 'PSH-MEGA2560'
        assert state.faults == 0
        client.set_df_tilt(1.2)
        result = client.run_program(RING)
        assert result.error is None
        times = [record.time_us - result.records[0].time_us for record in result.records]
        assert times == pytest.approx([0, 17000, 34000, 51000], abs=100)
        assert [record.strobe_us for record in result.records] == pytest.approx(
            [4000] * 4, abs=200)
        # the simulated motor has no encoder: every move is a stall, and the driver says so
        with pytest.raises(PsError) as error:
            client.home()
        assert error.value.code is ErrorCode.HEAD_STALL
    finally:
        client.disconnect()
        process.kill()
        process.wait()
        os.close(slave)
