"""The socket between fake head and fake camera, without either."""
from pathlib import Path
import threading
import time

import pytest

from ps_head_driver.fake.trigger_socket import (
    ControlClient,
    StrobeEvent,
    TriggerListener,
    TriggerServer,
    default_path,
)

EVENT = StrobeEvent(
    strobe_counter=3, trigger_counter=5, device_time_ns=123456789, strobe_s=0.004,
    bf_levels=(1.0, 0.0, 0.5, 0.0), df_levels=(0.0, 0.0, 0.0, 0.0), motor_counts=24880.0,
    tilt=0.52, df_tilt=1.3, boot=2)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / 'trigger.sock'


def connected(server: TriggerServer, listener: TriggerListener) -> bool:
    deadline = time.monotonic() + 5
    while not listener.connected and time.monotonic() < deadline:
        server.service()
        listener.wait_connected(0.01)
    return listener.connected


def test_events_arrive_whole_and_in_order(path: Path) -> None:
    server = TriggerServer(path, {'head_file': 'head.yaml'})
    listener = TriggerListener(path)
    assert connected(server, listener)
    assert listener.hello == {'head_file': 'head.yaml'}
    later = StrobeEvent(**{**EVENT.__dict__, 'strobe_counter': 4})
    server.strobe(EVENT)
    server.strobe(later)
    assert listener.get(2.0) == EVENT
    assert listener.get(2.0) == later
    assert listener.get(0.01) is None
    listener.close()
    server.close()
    assert not path.exists()


def test_listener_survives_a_restart_of_the_head(path: Path) -> None:
    listener = TriggerListener(path)
    for _ in range(2):
        server = TriggerServer(path)
        assert connected(server, listener)
        server.strobe(EVENT)
        assert listener.get(2.0) == EVENT
        server.close()
        deadline = time.monotonic() + 5
        while listener.connected and time.monotonic() < deadline:
            time.sleep(0.01)
        assert not listener.connected
    listener.close()


def test_clear_forgets_and_close_wakes(path: Path) -> None:
    server = TriggerServer(path)
    listener = TriggerListener(path)
    assert connected(server, listener)
    server.strobe(EVENT)
    time.sleep(0.1)
    listener.clear()
    assert listener.get(0.0) is None
    threading.Timer(0.05, listener.close).start()
    start = time.monotonic()
    assert listener.get(10.0) is None
    assert time.monotonic() - start < 5
    server.close()


def test_stale_socket_is_replaced_but_a_live_one_is_not(path: Path) -> None:
    server = TriggerServer(path)
    with pytest.raises(OSError, match='another fake head'):
        TriggerServer(path)
    server._listener.close()        # as after kill -9: the file stays
    TriggerServer(path).close()


def test_commands_are_answered(path: Path) -> None:
    server = TriggerServer(path)
    done = threading.Event()

    def serve() -> None:
        while not done.is_set():
            for client, message in server.service():
                if message['command'] == 'echo':
                    server.reply(client, message['arguments'])
                else:
                    server.reply(client, {'error': 'unknown'})
            time.sleep(0.005)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        with ControlClient(path) as control:
            assert control.command('echo', value=3) == {'value': 3}
            control._socket.sendall(b'not json\n[1]\n')
            with pytest.raises(ValueError, match='unknown'):
                control.command('nonsense')
    finally:
        done.set()
        thread.join()
        server.close()


def test_default_path_differs_by_domain_and_namespace(
        monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv('XDG_RUNTIME_DIR', '/run/user/1')
    monkeypatch.setenv('ROS_DOMAIN_ID', '7')
    paths = {default_path('ps_head'), default_path('/ps_head'), default_path('/left/head')}
    monkeypatch.setenv('ROS_DOMAIN_ID', '8')
    paths.add(default_path('ps_head'))
    assert len(paths) == 3
    monkeypatch.setenv('XDG_RUNTIME_DIR', '/' + 'x' * 120)
    assert default_path('ps_head').name.startswith('ps_head_trigger-')
    monkeypatch.setenv('XDG_RUNTIME_DIR', '/run')
    assert len(str(default_path('n' * 200))) < 108
