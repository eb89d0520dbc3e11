"""Serial link over a real pseudo-terminal, on a good line and on a bad one."""
from collections.abc import Iterator
import os
from pathlib import Path
import threading
import time
import tty

import pytest

from ps_head_driver import protocol
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.fake.bench import fake_head
from ps_head_driver.fake.trigger_socket import ControlClient
from ps_head_driver.protocol import Command, Result, Status
from ps_head_driver.serial_link import SerialLink

Bench = tuple[SerialLink, ControlClient]


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    with fake_head(tmp_path) as (ports, control):
        link = SerialLink(ports[0])
        link.connect()
        yield link, control
        link.close()


def test_hello_and_status(bench: Bench) -> None:
    link, _ = bench
    assert link.connected
    assert link.info is not None
    assert link.info.serial == 'FAKE-0001'
    result, body = link.request(Command.STATUS)
    assert result is Result.OK
    assert Status.parse(body).faults == 0
    assert link.statistics.retries == 0


@pytest.mark.parametrize('rates', [
    {'drop': 0.2}, {'duplicate': 0.5}, {'corrupt': 1e-3}, {'delay_s': 0.15, 'delayed': 0.3}])
def test_a_bad_line_costs_time_but_no_wrong_answer(bench: Bench, rates: dict[str, float]) -> None:
    link, control = bench
    control.command('line', **rates)
    moved = set()
    for i in range(60):
        result, body = link.request(Command.STATUS)
        assert result is Result.OK
        status = Status.parse(body)
        moved.add(status.time_us)
        # a reply to an older request would carry an older gain of time
        assert len(moved) == i + 1 or link.statistics.retries
    assert link.statistics.timeouts == 0
    if 'duplicate' in rates or 'delay_s' in rates:
        assert link.statistics.stray > 0
    if 'drop' in rates:
        assert link.statistics.retries > 0


def test_a_silent_board_is_a_time_out(bench: Bench) -> None:
    link, control = bench
    control.command('line', drop=1.0)
    start = time.monotonic()
    with pytest.raises(PsError) as error:
        link.request(Command.STATUS, timeout=0.05, tries=3)
    assert error.value.code is ErrorCode.HEAD_LINK_TIMEOUT
    assert 0.14 < time.monotonic() - start < 1.0
    control.command('line', drop=0.0)
    assert link.request(Command.STATUS)[0] is Result.OK


def test_unplugged_and_plugged_again(bench: Bench) -> None:
    link, control = bench
    lost = threading.Event()
    link.on_lost = lost.set
    control.command('unplug')
    assert lost.wait(1.0)
    assert not link.connected
    with pytest.raises(PsError) as error:
        link.request(Command.STATUS)
    assert error.value.code is ErrorCode.HEAD_DISCONNECTED
    with pytest.raises(PsError, match='No such file') as error:
        link.connect()
    assert error.value.code is ErrorCode.HEAD_DISCONNECTED
    control.command('plug')
    link.connect()
    assert link.request(Command.STATUS)[0] is Result.OK


def test_a_restart_of_the_board_is_noticed(bench: Bench) -> None:
    link, control = bench
    control.command('reset')
    with pytest.raises(PsError) as error:
        link.request(Command.STATUS)
    assert error.value.code is ErrorCode.HEAD_BOARD_RESET
    assert not link.connected
    link.connect()
    assert link.request(Command.STATUS)[0] is Result.OK


def test_closing_wakes_a_waiting_request(bench: Bench) -> None:
    link, control = bench
    control.command('line', drop=1.0)
    threading.Timer(0.1, link.close).start()
    start = time.monotonic()
    with pytest.raises(PsError) as error:
        link.request(Command.STATUS, timeout=5.0)
    assert error.value.code is ErrorCode.HEAD_DISCONNECTED
    assert time.monotonic() - start < 2.0


def test_requests_of_several_threads_do_not_mix(bench: Bench) -> None:
    link, _ = bench
    wrong: list[Result] = []

    def ask(command: Command, expected: Result) -> None:
        for _ in range(50):
            result, _body = link.request(command)
            if result is not expected:
                wrong.append(result)

    threads = [threading.Thread(target=ask, args=pair) for pair in (
        (Command.STATUS, Result.OK), (Command.STOP, Result.OK),
        (Command.MOVE, Result.BAD_LENGTH), (Command.RECORD, Result.BAD_LENGTH))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


@pytest.mark.parametrize('answer', [b'', b'Marlin 2.1 ready\r\n', bytes(range(256)) * 4])
def test_something_else_on_the_port(answer: bytes, tmp_path: Path) -> None:
    master, slave = os.openpty()
    tty.setraw(slave)
    os.write(master, answer)
    link = SerialLink(os.ttyname(slave))
    try:
        with pytest.raises(PsError) as error:
            link.connect()
        assert error.value.code is ErrorCode.HEAD_LINK_TIMEOUT
        assert not link.connected
    finally:
        os.close(master)
        os.close(slave)


def test_a_board_of_another_version_is_refused(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with fake_head(tmp_path) as (ports, _):
        monkeypatch.setattr('ps_head_driver.serial_link.VERSION', protocol.VERSION + 1)
        with pytest.raises(PsError, match='update the older one') as error:
            SerialLink(ports[0]).connect()
        assert error.value.code is ErrorCode.HEAD_PROTOCOL_MISMATCH


def test_bad_urls_are_errors_not_tracebacks() -> None:
    for url in ('', '/dev/does-not-exist', 'nonsense://x', 'socket://127.0.0.1:1'):
        with pytest.raises(PsError) as error:
            SerialLink(url).connect()
        assert error.value.code is ErrorCode.HEAD_DISCONNECTED
