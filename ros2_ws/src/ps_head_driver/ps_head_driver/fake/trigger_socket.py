"""Trigger cable and light of the fake head: a Unix-domain socket from the emulator to the camera.

A real head and a real camera are joined by a trigger cable and by light. Here the emulator sends
one line of JSON for each strobe, with what the panels and the motor really did, not with what the
host asked for. The fake camera renders that. Tests use the same socket to inject faults and to
look at the true state of the board.

Lines from the server: {"kind": "hello" | "strobe" | "reply", ...}; lines to the server:
{"command": name, "arguments": {...}}, answered by one "reply".
"""
from collections import deque
from collections.abc import Iterator
import contextlib
from dataclasses import asdict, dataclass
import hashlib
import json
import os
from pathlib import Path
import socket
import tempfile
import threading
import time
from types import TracebackType
from typing import Any

Levels = tuple[float, float, float, float]

_LONGEST_PATH = 100                 # sockaddr_un holds 108 bytes
_LONGEST_LINE = 1 << 20
_RECONNECT_S = 0.1


@dataclass(frozen=True)
class StrobeEvent:
    """What really lit one camera trigger.

    Sent when the strobe has ended, so ``strobe_s`` is right also after an abort.

    :param strobe_counter: the board's strobe count since power-up; 1 for the first.
    :param trigger_counter: the board's camera trigger count since power-up.
    :param device_time_ns: strobe start on the board's clock.
    :param strobe_s: time the panels were on after the trigger.
    :param bf_levels: relative output of the bright-field panels E N W S, 0 to 1; broken LED: 0.
    :param df_levels: the same for the dark field.
    :param motor_counts: where the slider really stood (backlash and lost steps included).
    :param tilt: bright-field tilt at ``motor_counts``, rad.
    :param df_tilt: dark-field tilt, rad.
    :param boot: changes when the board restarts.
    """

    strobe_counter: int
    trigger_counter: int
    device_time_ns: int
    strobe_s: float
    bf_levels: Levels
    df_levels: Levels
    motor_counts: float
    tilt: float
    df_tilt: float
    boot: int = 0

    @staticmethod
    def from_dict(data: dict[str, Any]) -> 'StrobeEvent':
        """Inverse of dataclasses.asdict, after JSON."""
        return StrobeEvent(**{
            **data, 'bf_levels': tuple(data['bf_levels']), 'df_levels': tuple(data['df_levels'])})


def default_path(namespace: str = 'ps_head') -> Path:
    """Socket path that the head driver and the camera of one namespace share by default.

    Differs between users, ROS domains and namespaces, so that cells side by side do not mix.
    """
    folder = os.environ.get('XDG_RUNTIME_DIR') or tempfile.gettempdir()
    domain = os.environ.get('ROS_DOMAIN_ID') or '0'
    label = namespace.strip('/').replace('/', '-') or 'root'
    name = f'ps_head_trigger-{os.getuid()}-{domain}-{label}'
    if len(os.path.join(folder, name)) + len('.sock') > _LONGEST_PATH:
        name = 'ps_head_trigger-' + hashlib.sha256(name.encode()).hexdigest()[:16]
    return Path(folder) / f'{name}.sock'


def _encode(message: dict[str, Any]) -> bytes:
    return json.dumps(message).encode() + b'\n'


def _take_lines(buffer: bytearray) -> Iterator[dict[str, Any]]:
    """Remove the whole lines from the buffer and yield those that are JSON objects."""
    while (end := buffer.find(b'\n')) >= 0:
        line = bytes(buffer[:end])
        del buffer[:end + 1]
        with contextlib.suppress(ValueError):
            message = json.loads(line)
            if isinstance(message, dict):
                yield message
    if len(buffer) > _LONGEST_LINE:
        buffer.clear()


class TriggerServer:
    """The emulator's end. Never blocks and has no thread: call :meth:`service` often.

    :param path: of the socket; a stale one, left by a killed process, is replaced.
    :param hello: sent to every client first, e.g. the head file that the emulator uses.
    :raises OSError: if another live server has the path.
    """

    def __init__(self, path: str | Path, hello: dict[str, Any] | None = None) -> None:
        self.path = str(path)
        self.hello = {'kind': 'hello', **(hello or {})}
        self._clients: dict[socket.socket, bytearray] = {}
        _remove_stale(self.path)
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._listener.bind(self.path)
            os.chmod(self.path, 0o600)
            self._listener.listen(16)
            self._listener.setblocking(False)
        except OSError:
            self._listener.close()
            raise

    def sockets(self) -> list[socket.socket]:
        """All sockets that are worth waking up for, for select."""
        return [self._listener, *self._clients]

    def service(self) -> list[tuple[socket.socket, dict[str, Any]]]:
        """Accept clients and read their commands.

        :returns: (client, command) pairs; answer each with :meth:`reply`.
        """
        with contextlib.suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                client.setblocking(False)
                self._clients[client] = bytearray()
                self._send(client, _encode(self.hello))
        commands = []
        for client in list(self._clients):
            buffer = self._clients[client]
            try:
                data = client.recv(65536)
            except BlockingIOError:
                continue
            except OSError:
                data = b''
            if not data:
                self._drop(client)
                continue
            buffer += data
            commands += [(client, message) for message in _take_lines(buffer)]
        return commands

    def strobe(self, event: StrobeEvent) -> None:
        """Tell every client about a strobe."""
        line = _encode({'kind': 'strobe', **asdict(event)})
        for client in list(self._clients):
            self._send(client, line)

    def reply(self, client: socket.socket, answer: dict[str, Any]) -> None:
        """Answer a command."""
        self._send(client, _encode({'kind': 'reply', **answer}))

    def close(self) -> None:
        """Close all connections and remove the socket."""
        for client in list(self._clients):
            self._drop(client)
        self._listener.close()
        with contextlib.suppress(OSError):
            os.unlink(self.path)

    def _send(self, client: socket.socket, line: bytes) -> None:
        try:
            client.sendall(line)
        except OSError:         # gone, or it does not read: the board cannot wait for it
            self._drop(client)

    def _drop(self, client: socket.socket) -> None:
        self._clients.pop(client, None)
        client.close()


def _remove_stale(path: str) -> None:
    if not os.path.exists(path):
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        try:
            probe.connect(path)
        except OSError:
            with contextlib.suppress(OSError):
                os.unlink(path)
            return
    raise OSError(f'{path}: another fake head is running with this trigger socket')


class TriggerListener:
    """The camera's end: a thread that connects, reconnects and queues events.

    :param path: of the socket; need not exist yet.
    :param capacity: events kept; the oldest are dropped.
    """

    def __init__(self, path: str | Path, capacity: int = 4096) -> None:
        self.path = str(path)
        self._events: deque[StrobeEvent] = deque(maxlen=capacity)
        self._changed = threading.Condition()
        self._closing = threading.Event()
        self._hello: dict[str, Any] | None = None
        self._socket: socket.socket | None = None
        self._thread = threading.Thread(target=self._run, name='trigger-listener', daemon=True)
        self._thread.start()

    @property
    def connected(self) -> bool:
        """Whether the fake head is there."""
        return self._hello is not None

    @property
    def hello(self) -> dict[str, Any]:
        """What the server said about itself: 'head_file' (true head). Empty if not connected."""
        return dict(self._hello or {})

    def wait_connected(self, timeout: float) -> bool:
        """Wait for the fake head.

        :param timeout: s.
        """
        with self._changed:
            return self._changed.wait_for(lambda: self.connected, timeout)

    def clear(self) -> None:
        """Forget the events that have come so far."""
        with self._changed:
            self._events.clear()

    def get(self, timeout: float) -> StrobeEvent | None:
        """Next event in the order of the triggers; None if none comes within timeout (s)."""
        with self._changed:
            self._changed.wait_for(lambda: self._events or self._closing.is_set(), timeout)
            return self._events.popleft() if self._events else None

    def close(self) -> None:
        """Disconnect and end the thread; wakes up a waiting get()."""
        self._closing.set()
        with self._changed:
            self._changed.notify_all()
            if self._socket is not None:
                with contextlib.suppress(OSError):
                    self._socket.shutdown(socket.SHUT_RDWR)
        self._thread.join(timeout=2.0)

    def _run(self) -> None:
        while not self._closing.is_set():
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
                try:
                    connection.connect(self.path)
                    with self._changed:
                        self._socket = connection
                    if not self._closing.is_set():
                        self._receive(connection)
                except OSError:
                    pass
                with self._changed:
                    self._socket = None
                    self._hello = None
            self._closing.wait(_RECONNECT_S)

    def _receive(self, connection: socket.socket) -> None:
        buffer = bytearray()
        while data := connection.recv(65536):
            buffer += data
            for message in _take_lines(buffer):
                kind = message.pop('kind', None)
                with self._changed:
                    if kind == 'hello':
                        self._hello = message
                    elif kind == 'strobe':
                        self._events.append(StrobeEvent.from_dict(message))
                    self._changed.notify_all()


class ControlClient:
    """For tests: inject faults into the emulator and look at its true state.

    :param timeout: s, for connecting and for each answer.
    :raises OSError: if the emulator does not come up within timeout.
    """

    def __init__(self, path: str | Path, timeout: float = 5.0) -> None:
        self._buffer = bytearray()
        deadline = time.monotonic() + timeout
        while True:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            self._socket.settimeout(timeout)
            try:
                self._socket.connect(str(path))
                break
            except OSError:
                self._socket.close()
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.05)

    def command(self, name: str, **arguments: Any) -> dict[str, Any]:
        """Send one command and wait for its answer.

        :raises OSError: if the emulator does not answer.
        :raises ValueError: if it refuses; the message says why.
        """
        self._socket.sendall(_encode({'command': name, 'arguments': arguments}))
        while True:
            data = self._socket.recv(65536)
            if not data:
                raise ConnectionResetError('the fake head has ended')
            self._buffer += data
            for message in _take_lines(self._buffer):
                if message.pop('kind', None) == 'reply':
                    if 'error' in message:
                        raise ValueError(message['error'])
                    return message

    def close(self) -> None:
        """Disconnect."""
        self._socket.close()

    def __enter__(self) -> 'ControlClient':
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self.close()
