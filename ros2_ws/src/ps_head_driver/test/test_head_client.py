"""The head's operations against the fake head, on one board and on two."""
from collections.abc import Iterator
from pathlib import Path
import threading
import time

import pytest

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.fake.bench import fake_head
from ps_head_driver.fake.trigger_socket import ControlClient, TriggerListener
from ps_head_driver.head_client import HeadClient, Motion
from ps_head_driver.head_model import load_head, nominal_head_path
from ps_head_driver.kinematics import BrightFieldKinematics
from ps_head_driver.protocol import FULL_LEVEL, Activity, Step
from ps_head_driver.serial_link import SerialLink

MOTION = Motion(settle_s=0.0)
RING = [Step(1 << i, FULL_LEVEL, 2000, 4000, 17000) for i in range(4)]

Bench = tuple[HeadClient, ControlClient]


@pytest.fixture(params=[1, 2], ids=['one board', 'two boards'])
def bench(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bench]:
    with fake_head(tmp_path, request.param) as (ports, control):
        client = HeadClient([SerialLink(port) for port in ports], (0, 64000))
        client.connect(MOTION)
        yield client, control
        client.disconnect()


@pytest.fixture
def homed(bench: Bench) -> Bench:
    bench[0].home()
    return bench


def code_of(call: object, *arguments: object) -> ErrorCode:
    with pytest.raises(PsError) as error:
        call(*arguments)  # type: ignore[operator]
    return error.value.code


def test_home_and_move_end_on_the_same_side(homed: Bench) -> None:
    client, control = homed
    assert code_of(client.move_to, 64001, MOTION) is ErrorCode.HEAD_OUT_OF_LIMITS
    for target in (20000, 64000, 63900, 30000, 0):
        state = client.move_to(target, MOTION)
        assert abs(state.motor_counts - target) <= 4
        truth = control.command('state')
        assert abs(truth['slider_counts'] - target) <= 4      # no backlash left


def test_the_other_side_leaves_the_backlash(homed: Bench) -> None:
    client, control = homed
    for target in (20000, 64000):       # the end of the range, too
        client.move_to(target, Motion(approach_up=False, settle_s=0.0))
        assert control.command('state')['slider_counts'] == pytest.approx(target + 120, abs=4)


def test_move_before_homing_is_refused(bench: Bench) -> None:
    assert code_of(bench[0].move_to, 100, MOTION) is ErrorCode.HEAD_NOT_HOMED


def test_program_records_are_what_the_lights_did(homed: Bench, tmp_path: Path) -> None:
    client, _ = homed
    listener = TriggerListener(tmp_path / 'trigger.sock')
    assert listener.wait_connected(2.0)
    client.move_to(25000, MOTION)
    tilt = BrightFieldKinematics(load_head(nominal_head_path())).tilt(25000)
    client.set_df_tilt(1.2)
    client.set_gains([0.5] + [1.0] * 7)
    result = client.run_program(RING)
    assert result.error is None
    assert [record.motor_counts for record in result.records] == [25000] * 4
    for record in result.records:
        event = listener.get(1.0)
        assert event is not None
        assert event.device_time_ns == record.time_us * 1000
        assert event.strobe_counter == record.strobe_counter
        assert event.motor_counts == pytest.approx(25000, abs=1)
        assert event.tilt == pytest.approx(tilt, abs=1e-4)
        assert event.df_tilt == pytest.approx(1.2, abs=1e-3)
        assert [*event.bf_levels, *event.df_levels] == pytest.approx(
            [level / FULL_LEVEL for level in record.levels])
    assert result.records[0].levels[0] == pytest.approx(FULL_LEVEL / 2, abs=1)
    listener.close()


def test_gains_survive_a_reconnection(bench: Bench) -> None:
    client, control = bench
    client.set_gains([0.25] * 8)
    control.command('reset')
    assert code_of(client.state) is ErrorCode.HEAD_BOARD_RESET
    client.disconnect()
    assert not client.connect(MOTION).homed
    assert client.run_program(RING).records[0].levels[0] == pytest.approx(FULL_LEVEL / 4, abs=1)


@pytest.mark.parametrize('operation', ['home', 'move', 'program'])
def test_stop_from_another_thread(homed: Bench, operation: str) -> None:
    client, control = homed
    long = [Step(1, FULL_LEVEL, 0, 1_500_000, 0)]
    if operation == 'home':
        client.move_to(60000, MOTION)
    threading.Timer(0.15, client.stop).start()
    start = time.monotonic()
    if operation == 'program':
        result = client.run_program(long)
        assert result.error is not None
        code, records = result.error.code, result.records
        assert not records
    elif operation == 'move':
        code = code_of(client.move_to, 60000, Motion(speed=20000))
    else:
        code = code_of(client.home)
    assert code is ErrorCode.HEAD_CANCELLED
    assert time.monotonic() - start < 1.2
    truth = control.command('state')
    assert truth['activity'] == 'IDLE'
    assert not truth['panels_on']


def test_faults_have_their_code_and_can_be_cleared(homed: Bench) -> None:
    client, control = homed
    control.command('stall')
    assert code_of(client.move_to, 30000, MOTION) is ErrorCode.HEAD_STALL
    assert code_of(client.home) is ErrorCode.HEAD_STALL          # latched
    control.command('stall', on=False)
    client.clear_fault()
    client.home()

    control.command('led_open', panels=2)
    result = client.run_program(RING)
    assert result.error is not None
    assert result.error.code is ErrorCode.HEAD_LED_OPEN
    assert 'BF_N' in result.error.message
    assert len(result.records) == 1
    control.command('led_open', panels=0)
    client.clear_fault()

    control.command('heat', panel=6, kelvin=90)
    assert code_of(client.run_program, RING) is ErrorCode.HEAD_OVER_TEMPERATURE
    control.command('heat', panel=6, kelvin=0)
    assert client.clear_fault().faults == 0
    assert client.run_program(RING).error is None


def test_rejected_programs(bench: Bench) -> None:
    client, _ = bench
    for steps in ([], RING * 9, [Step(1, FULL_LEVEL, 0, 5_000_000, 0)], [Step(1, 1, 0, 0, 0)]):
        assert code_of(client.run_program, steps) is ErrorCode.HEAD_PROGRAM_REJECTED


def test_reset_in_the_middle_of_a_program(homed: Bench) -> None:
    client, control = homed
    threading.Timer(0.1, control.command, ['reset']).start()
    code = code_of(client.run_program, [Step(1, FULL_LEVEL, 0, 1_000_000, 0)])
    assert code is ErrorCode.HEAD_BOARD_RESET
    assert not control.command('state')['panels_on']


def test_unplugged_with_power_the_watchdog_stops_it(homed: Bench) -> None:
    client, control = homed
    threading.Timer(0.1, control.command, ['unplug'], {'power': False}).start()
    assert code_of(client.move_to, 60000, Motion(speed=10000)) is ErrorCode.HEAD_DISCONNECTED
    time.sleep(0.5)
    truth = control.command('state')
    assert truth['activity'] == 'IDLE'
    assert truth['motor_counts'] < 10000 * 0.6
    control.command('plug')
    client.disconnect()
    state = client.connect(MOTION)
    assert state.activity is Activity.IDLE
    assert state.homed                 # it kept its position, and the watchdog fault is cleared
    assert state.faults == 0


def test_everything_works_on_a_noisy_line(bench: Bench) -> None:
    client, control = bench
    control.command('line', corrupt=1e-3, drop=0.02, duplicate=0.05)
    client.home()
    for target in (15000, 5000):
        client.move_to(target, MOTION)
        result = client.run_program(RING)
        assert result.error is None
    strobes = [record.strobe_counter for record in result.records]
    assert strobes == [5, 6, 7, 8]              # no program ran twice
