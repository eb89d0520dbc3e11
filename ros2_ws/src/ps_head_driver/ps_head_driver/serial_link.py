"""Serial link to one board: requests and replies over any pyserial port or URL."""
from collections.abc import Callable
import contextlib
from dataclasses import dataclass
import os
import random
import threading
from typing import Any

import serial

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.protocol import (
    HELLO_REQUEST,
    REPLY,
    VERSION,
    BoardInfo,
    Command,
    FrameDecoder,
    Packet,
    ProtocolError,
    Result,
    encode,
)

REPLY_TIMEOUT_S = 0.1          # a full packet and its reply take 12 ms at 115200 baud
TRIES = 6
_READ_TIMEOUT_S = 0.1


@dataclass
class LinkStatistics:
    """Counts since the link object was made, for diagnostics."""

    requests: int = 0
    retries: int = 0
    timeouts: int = 0          # requests that failed after all tries
    damaged: int = 0           # frames thrown away
    stray: int = 0             # late or repeated replies thrown away


class SerialLink:
    """Request and reply with one board. Thread-safe; one request is on the line at a time.

    :param url: device path or pyserial URL (socket://, rfc2217://, ...).
    :param baud: bit/s.
    :param boot_s: how long a board may be silent after its port was opened (boards that restart
        then).
    """

    def __init__(self, url: str, baud: int = 115200, boot_s: float = 0.0) -> None:
        self.url, self.baud, self._boot_s = url, baud, boot_s
        # called when an open link breaks, from the thread that noticed
        self.on_lost: Callable[[], None] = lambda: None
        self.statistics = LinkStatistics()
        self.info: BoardInfo | None = None         # of the board, while connected
        self._port: Any = None                      # a pyserial port of any kind
        self._reader: threading.Thread | None = None
        self._request_lock = threading.Lock()
        self._arrived = threading.Condition()
        self._awaited: Packet | None = None         # request without its reply
        self._reply: Packet | None = None
        self._sequence = random.randrange(256)
        self._session = 0

    @property
    def connected(self) -> bool:
        """Whether the port is open and the board has said hello."""
        return self.info is not None

    def connect(self) -> BoardInfo:
        """Open the port and say hello. Does nothing if connected.

        :raises PsError: HEAD_DISCONNECTED, HEAD_LINK_TIMEOUT or HEAD_PROTOCOL_MISMATCH.
        """
        if self.info is not None:
            return self.info
        self.close()
        try:
            port = serial.serial_for_url(
                self.url, self.baud, timeout=_READ_TIMEOUT_S, write_timeout=1.0, do_not_open=True)
            with contextlib.suppress(ValueError, AttributeError):      # not on every kind of port
                port.exclusive = True
            port.open()
        except (OSError, ValueError) as error:      # SerialException is an OSError
            raise PsError(ErrorCode.HEAD_DISCONNECTED,
                          f'port {self.url}: {_reason(error)}') from error
        self._port = port
        self._reader = threading.Thread(
            target=self._read, args=(port,), name='ps_serial_reader', daemon=True)
        self._reader.start()
        try:
            self.info = self._hello()
        except PsError:
            self.close()
            raise
        return self.info

    def _hello(self) -> BoardInfo:
        self._session = random.randrange(1, 1 << 16)
        reply = self._exchange(Command.HELLO, HELLO_REQUEST.pack(VERSION), REPLY_TIMEOUT_S,
                               TRIES + round(self._boot_s / REPLY_TIMEOUT_S))
        try:
            if not reply:
                raise ProtocolError('hello: empty reply')
            info = BoardInfo.parse(reply[1:])
        except ProtocolError as error:
            raise PsError(ErrorCode.HEAD_PROTOCOL_MISMATCH,
                          f'port {self.url}: what answers is not a head ({error})') from error
        if reply[0] != Result.OK or info.version != VERSION:
            raise PsError(
                ErrorCode.HEAD_PROTOCOL_MISMATCH,
                f'board {info.serial} speaks protocol version {info.version}, this driver '
                f'{VERSION}; update the older one')
        return info

    def close(self) -> None:
        """Close the port; a waiting request fails with HEAD_DISCONNECTED."""
        port, self._port, self.info = self._port, None, None
        with self._arrived:
            self._arrived.notify_all()
        if port is not None:
            with contextlib.suppress(OSError, AttributeError):
                port.cancel_read()
            reader = self._reader
            if reader is not None and reader is not threading.current_thread():
                reader.join(timeout=2.0)
            with contextlib.suppress(OSError, TypeError):
                port.close()

    def request(self, command: Command, body: bytes = b'', timeout: float = REPLY_TIMEOUT_S,
                tries: int = TRIES) -> tuple[Result, bytes]:
        """Send a request and wait for its reply; repeated until it comes.

        :param timeout: for one try, s.
        :returns: result and the rest of the body.
        :raises PsError: HEAD_DISCONNECTED, HEAD_LINK_TIMEOUT, HEAD_BOARD_RESET (the board has
            restarted; the link is closed, connect again), HEAD_PROTOCOL_MISMATCH.
        """
        reply = self._exchange(command, body, timeout, tries)
        try:
            result = Result(reply[0])
        except (IndexError, ValueError) as error:
            raise PsError(ErrorCode.HEAD_PROTOCOL_MISMATCH,
                          f'{command.name}: reply without a known result') from error
        if result is Result.WRONG_SESSION:
            self._lose()
            raise PsError(ErrorCode.HEAD_BOARD_RESET,
                          'the board has restarted; connecting again')
        return result, reply[1:]

    def _exchange(self, command: Command, body: bytes, timeout: float, tries: int) -> bytes:
        with self._request_lock:
            port = self._port
            if port is None:
                raise PsError(ErrorCode.HEAD_DISCONNECTED, f'port {self.url} is not open')
            self._sequence = (self._sequence + 1) % 256
            packet = Packet(command, self._sequence, self._session, body)
            wire = encode(packet)
            with self._arrived:
                self._awaited, self._reply = packet, None
            self.statistics.requests += 1
            for attempt in range(tries):
                if attempt:
                    self.statistics.retries += 1
                try:
                    # a delimiter first ends whatever a disturbance has left in the board's buffer
                    port.write(b'\0' + wire if attempt else wire)
                except (OSError, TypeError) as error:
                    self._lose()
                    raise PsError(ErrorCode.HEAD_DISCONNECTED,
                                  f'port {self.url}: {_reason(error)}') from error
                with self._arrived:
                    self._arrived.wait_for(
                        lambda: self._reply is not None or self._port is not port, timeout)
                    if self._reply is not None:
                        return self._reply.body
                if self._port is not port:
                    raise PsError(ErrorCode.HEAD_DISCONNECTED,
                                  f'port {self.url} was closed; check cable and power')
            with self._arrived:
                self._awaited = None
            self.statistics.timeouts += 1
            raise PsError(ErrorCode.HEAD_LINK_TIMEOUT,
                          f'the board on {self.url} did not answer {command.name} within '
                          f'{tries} x {timeout:g} s')

    # ------------------------------------------------------------------ reader thread

    def _read(self, port: Any) -> None:
        decoder = FrameDecoder()
        damaged_before = self.statistics.damaged
        while self._port is port:
            try:
                data = port.read(1)
                if data:
                    data += port.read(port.in_waiting)
            except (OSError, TypeError, AttributeError):   # TypeError: closed under pyserial
                break
            for packet in decoder.feed(data):
                self._accept(packet)
            self.statistics.damaged = damaged_before + decoder.damaged
        if self._port is port:
            self._lose()

    def _accept(self, packet: Packet) -> None:
        with self._arrived:
            wanted = self._awaited
            if (wanted is None or packet.type != wanted.type | REPLY
                    or packet.sequence != wanted.sequence or packet.session != wanted.session):
                self.statistics.stray += 1
                return
            self._awaited, self._reply = None, packet
            self._arrived.notify_all()

    def _lose(self) -> None:
        was_connected = self.connected
        self.close()
        if was_connected:
            self.on_lost()


def _reason(error: Exception) -> str:
    """One line of what the system says, without pyserial's repetitions."""
    if isinstance(error, OSError) and error.errno:
        return os.strerror(error.errno)
    return ' '.join(str(error).split()) or type(error).__name__

