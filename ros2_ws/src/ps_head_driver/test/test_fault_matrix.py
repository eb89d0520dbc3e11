"""Every fault of head and link, while idle, moving and strobing: what is said, and recovery."""
from collections.abc import Iterator
from contextlib import suppress
import threading
import time
from typing import Any

import pytest

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.fake.bench import fake_head
from ps_head_driver.fake.trigger_socket import ControlClient
from ps_head_driver.head_client import HeadClient, Motion
from ps_head_driver.head_supervisor import HeadSupervisor, Phase, Settings
from ps_head_driver.protocol import FULL_LEVEL, Step
from ps_head_driver.serial_link import SerialLink

RECOVERY_S = 2.0
FAST = Motion(settle_s=0.0)
PROGRAM = [Step(1 << i % 4, FULL_LEVEL, 2000, 5000, 60_000) for i in range(12)]
QUIET = {'drop': 0.0, 'corrupt': 0.0, 'duplicate': 0.0, 'delay_s': 0.0}
ACTIVITIES = ('idle', 'moving', 'strobing')
Codes = set[ErrorCode | None]
GONE: Codes = {ErrorCode.HEAD_DISCONNECTED, ErrorCode.HEAD_BOARD_RESET}
SILENT: Codes = {ErrorCode.HEAD_LINK_TIMEOUT}
HOT: Codes = {ErrorCode.HEAD_OVER_TEMPERATURE}
NOTHING: Codes = {None}

# command and arguments that begin and end the cause; codes while idle, moving, strobing
# (a reset while idle may be over before anyone looks)
Command = tuple[str, dict[str, Any]]
CAUSES: dict[str, tuple[Command, Command, tuple[Codes, ...]]] = {
    'unplug': (('unplug', {}), ('plug', {}), (GONE, GONE, GONE)),
    'reset': (('reset', {}), ('state', {}), (GONE | NOTHING, GONE, GONE)),
    'dead line': (('line', {'drop': 1.0}), ('line', QUIET), (SILENT, SILENT, SILENT)),
    'damaged bytes': (('line', {'corrupt': 1e-3}), ('line', QUIET), (NOTHING,) * 3),
    'lost replies': (('line', {'drop': 0.1}), ('line', QUIET), (NOTHING,) * 3),
    'doubled replies': (('line', {'duplicate': 0.5}), ('line', QUIET), (NOTHING,) * 3),
    'late replies': (('line', {'delay_s': 0.12, 'delayed': 0.2}), ('line', QUIET),
                     (NOTHING,) * 3),
    'stall': (('stall', {}), ('stall', {'on': False}),
              (NOTHING, {ErrorCode.HEAD_STALL}, NOTHING)),
    'led open': (('led_open', {'panels': 4}), ('led_open', {'panels': 0}),
                 (NOTHING, NOTHING, {ErrorCode.HEAD_LED_OPEN})),
    'over-temperature': (('heat', {'panel': 1, 'kelvin': 90}), ('heat', {'panel': 1, 'kelvin': 0}),
                         (HOT, HOT, HOT)),
}

Cell = tuple[HeadSupervisor, ControlClient]


@pytest.fixture(scope='module')
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    with fake_head(tmp_path_factory.mktemp('head')) as (ports, control):
        client = HeadClient([SerialLink(ports[0])], (0, 70000))
        supervisor = HeadSupervisor(
            client, Settings(FAST, status_period=0.1, reconnect_period=0.1), lambda _: None)
        supervisor.start()
        yield supervisor, control
        supervisor.close()


def recover(supervisor: HeadSupervisor) -> float:
    """What an operator does at most: clear the fault, home; seconds until ready."""
    start = time.monotonic()
    while True:
        snapshot = supervisor.snapshot()
        if snapshot.phase is Phase.READY:
            return time.monotonic() - start
        assert time.monotonic() - start < 10.0, snapshot
        with suppress(PsError):
            if snapshot.phase is Phase.FAULT:
                supervisor.clear_fault()
            elif snapshot.phase is Phase.CONNECTED:
                supervisor.home(5.0)
        time.sleep(0.02)


def operate(supervisor: HeadSupervisor, activity: str) -> ErrorCode | None:
    """The code with which it ended; None if it went well."""
    if activity == 'idle':
        deadline = time.monotonic() + 1.0
        while time.monotonic() < deadline:
            if (error := supervisor.snapshot().error) is not None:
                return error.code
            time.sleep(0.01)
        return None
    try:
        with supervisor.operation(homed=True) as client:
            if activity == 'moving':
                up = client.state().motor_counts < 3000
                client.move_to(6000 if up else 500, Motion(speed=9000, settle_s=0.0))
            elif (error := client.run_program(PROGRAM).error) is not None:
                return error.code
    except PsError as error:
        return error.code
    return None


@pytest.mark.parametrize('activity', ACTIVITIES)
@pytest.mark.parametrize('cause', CAUSES)
def test_fault(cell: Cell, cause: str, activity: str) -> None:
    supervisor, control = cell
    begin, end, expected = CAUSES[cause]
    recover(supervisor)
    timer = threading.Timer(0.15, control.command, [begin[0]], begin[1])
    timer.start()
    code = operate(supervisor, activity)
    timer.join()
    control.command(end[0], **end[1])
    assert code in expected[ACTIVITIES.index(activity)]
    assert recover(supervisor) < RECOVERY_S
    assert not control.command('state')['panels_on']
    # the supervisor may look at the head at this very moment: busy is a right answer, try again
    deadline = time.monotonic() + 2.0
    while (code := operate(supervisor, 'strobing')) is ErrorCode.HEAD_BUSY and (
            time.monotonic() < deadline):
        time.sleep(0.05)
    assert code is None


@pytest.mark.parametrize('activity', ['idle', 'homing', 'moving', 'strobing'])
def test_stop_from_any_state_leaves_panels_off_and_the_motor_still(
        cell: Cell, activity: str) -> None:
    supervisor, control = cell
    recover(supervisor)
    thread = threading.Thread(target=lambda: operate(supervisor, activity))
    if activity == 'homing':
        thread = threading.Thread(target=lambda: suppressed(supervisor.home))
    thread.start()
    wanted = {'idle': 'IDLE'}.get(activity, activity.upper())
    deadline = time.monotonic() + 2.0
    while control.command('state')['activity'] != wanted and time.monotonic() < deadline:
        time.sleep(0.002)
    supervisor.stop()
    assert not control.command('state')['panels_on']
    thread.join()
    state = control.command('state')
    assert (state['activity'], state['panels_on']) == ('IDLE', False)
    if activity == 'homing':
        assert not state['homed']
    assert recover(supervisor) < RECOVERY_S


def suppressed(home: Any) -> None:
    with suppress(PsError):
        home(5.0)


def test_limit_switch(cell: Cell) -> None:
    supervisor, _ = cell
    recover(supervisor)
    with pytest.raises(PsError) as error, supervisor.operation(homed=True) as client:
        client.move_to(68000, FAST)
    assert error.value.code is ErrorCode.HEAD_LIMIT_HIT
    assert recover(supervisor) < RECOVERY_S
    with supervisor.operation(homed=True) as client:
        assert client.move_to(1000, FAST).motor_counts == 1000


@pytest.mark.parametrize(('held_s', 'code'), [(0.2, None), (1.5, ErrorCode.HEAD_BUSY)])
def test_who_read_ready_is_let_in_when_the_operation_ends(
        cell: Cell, held_s: float, code: ErrorCode | None) -> None:
    supervisor, _ = cell
    recover(supervisor)
    taken = threading.Event()

    def hold() -> None:
        with supervisor.operation():
            taken.set()
            time.sleep(held_s)

    holder = threading.Thread(target=hold)
    holder.start()
    assert taken.wait(2.0)
    assert supervisor.snapshot().phase is Phase.READY       # what a client is told
    found = None
    try:
        with supervisor.operation():
            pass
    except PsError as error:
        found = error.code
    holder.join()
    assert found is code
