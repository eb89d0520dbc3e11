"""Keeps the head connected and homed, and lets one operation at a time use it."""
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from enum import IntEnum
import threading
import time

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.head_client import HeadClient, HeadState, Motion
from ps_head_driver.protocol import Activity, BoardInfo, Fault


class Phase(IntEnum):
    """State of the head for its users; values of ps_interfaces/HeadStatus."""

    DISCONNECTED = 0
    CONNECTED = 1
    HOMING = 2
    READY = 3
    MOVING = 4
    STROBING = 5
    FAULT = 6


HANDOVER = 0.5     # s that a request waits for an operation whose motion has ended
_PHASES = {Activity.HOMING: Phase.HOMING, Activity.MOVING: Phase.MOVING,
           Activity.STOPPING: Phase.MOVING, Activity.STROBING: Phase.STROBING}

_LINK_ERRORS = (ErrorCode.HEAD_DISCONNECTED, ErrorCode.HEAD_LINK_TIMEOUT,
                ErrorCode.HEAD_PROTOCOL_MISMATCH, ErrorCode.HEAD_BOARD_RESET)


@dataclass(frozen=True)
class Snapshot:
    """What is known about the head.

    :param state: last state read; None while disconnected.
    :param error: why it is disconnected or in fault, or what went wrong with homing.
    """

    phase: Phase
    state: HeadState | None
    error: PsError | None
    boards: tuple[BoardInfo, ...]


@dataclass
class Settings:
    """What the supervisor reads anew whenever it needs it."""

    motion: Motion = Motion()  # noqa: RUF009 - frozen
    home_on_connect: bool = True
    status_period: float = 0.5        # s
    reconnect_period: float = 0.25    # s
    move_timeout: float = 30.0        # s, of the homing after connecting


class HeadSupervisor:
    """A thread that connects, homes and watches; and the operations for everyone else.

    :param client: not connected yet.
    :param settings: read anew at each use.
    :param prepare: called before each attempt to connect; starts the fake head.
    :param on_change: called with a snapshot when the phase changes, and at each status period.
    """

    def __init__(self, client: HeadClient, settings: Settings,
                 on_change: Callable[[Snapshot], None],
                 prepare: Callable[[], None] = lambda: None) -> None:
        self.client, self.settings = client, settings
        self._prepare, self._on_change = prepare, on_change
        self._busy = threading.Lock()
        self._wake = threading.Event()
        self._closing = False
        self._home_wanted = False
        self._state: HeadState | None = None
        self._error: PsError | None = PsError(ErrorCode.HEAD_DISCONNECTED, 'not connected yet')
        self._announced: tuple[Phase, bool] | None = None
        self._announced_at = 0.0
        client.on_state = self._take_state
        for link in client.links:
            link.on_lost = self._link_lost
        self._thread = threading.Thread(target=self._run, name='ps_head_supervisor')

    def start(self) -> None:
        """Begin to connect."""
        self._thread.start()

    def close(self) -> None:
        """Everything off, disconnect, end the thread."""
        self._closing = True
        if self.client.connected:
            with suppress(PsError):
                self.client.stop()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(timeout=10.0)
        self.client.disconnect()

    # ------------------------------------------------------------------ state

    def snapshot(self) -> Snapshot:
        """What is known now."""
        state, error = self._state, self._error
        if not self.client.connected or state is None:
            return Snapshot(Phase.DISCONNECTED, None, error, ())
        fault = state.fault_error()
        if state.activity in _PHASES:
            phase = _PHASES[state.activity]
        elif fault is not None:
            phase, error = Phase.FAULT, fault
        else:
            phase = Phase.READY if state.homed else Phase.CONNECTED
        return Snapshot(phase, state, error, self.client.boards)

    def _take_state(self, state: HeadState) -> None:
        """Called with every state the client reads."""
        self._state = state
        if self._error is not None and self._error.code in _LINK_ERRORS:
            self._error = None
        self._announce()

    def _link_lost(self) -> None:
        """Called when a link breaks."""
        self._error = PsError(ErrorCode.HEAD_DISCONNECTED,
                              'the link broke; check cable and power, connecting again')
        self._wake.set()

    def _announce(self, always: bool = False) -> None:
        snapshot = self.snapshot()
        key = snapshot.phase, bool(snapshot.state and snapshot.state.homed)
        now = time.monotonic()
        due = now - self._announced_at >= self.settings.status_period
        if always or due or key != self._announced:
            self._announced, self._announced_at = key, now
            self._on_change(snapshot)

    # ------------------------------------------------------------------ operations

    @contextmanager
    def operation(self, homed: bool = False) -> Iterator[HeadClient]:
        """Use the head alone.

        :param homed: whether the operation needs the motor's position.
        :raises PsError: HEAD_DISCONNECTED, HEAD_BUSY, HEAD_NOT_HOMED.
        """
        # READY is said when the head reports it: the operation that ends has the head a bit longer
        idle = self._state is not None and self._state.activity is Activity.IDLE
        with self._alone(wait=HANDOVER if idle else 0.0):
            self.check_connected()
            if homed and not (self._state and self._state.homed):
                raise PsError(ErrorCode.HEAD_NOT_HOMED,
                              'the motor has no position; call head_driver/home')
            yield self.client

    def check_connected(self) -> None:
        """Refuse when there is no link.

        :raises PsError: HEAD_DISCONNECTED with the reason.
        """
        if not self.client.connected:
            reason = self._error.message if self._error else 'the head is not connected'
            raise PsError(ErrorCode.HEAD_DISCONNECTED, reason)

    def home(self, timeout: float) -> HeadState:
        """Home the motor.

        :param timeout: s.
        """
        with self.operation() as client:
            return self._home(client, timeout)

    def stop(self) -> None:
        """Stop whatever goes on, in whatever state; never refused for being busy."""
        self.check_connected()
        self._home_wanted = False
        self.client.stop()

    def reconnect(self) -> HeadState:
        """Close the link and open it again now."""
        with self._alone(wait=0.0 if self.client.connected else 5.0):
            self.client.disconnect()
            try:
                return self._connect()
            except PsError as error:
                self._error = error
                self._announce(always=True)
                raise
            finally:
                self._wake.set()

    def clear_fault(self) -> HeadState:
        """Clear the faults whose cause has gone.

        :raises PsError: the fault that remains.
        """
        with self.operation() as client:
            state = client.clear_fault()
        remaining = state.fault_error()
        if remaining is not None:
            raise remaining
        self._error = None
        self._announce(always=True)
        return state

    @contextmanager
    def _alone(self, wait: float = 0.0) -> Iterator[None]:
        if not self._busy.acquire(timeout=wait):
            if not self.client.connected:
                self.check_connected()
            raise PsError(ErrorCode.HEAD_BUSY, 'another operation of the head is running')
        try:
            yield
        finally:
            self._busy.release()

    # ------------------------------------------------------------------ thread

    def _run(self) -> None:
        while not self._closing:
            try:
                self._watch()
            except PsError as error:
                self._error = error
                if error.code is ErrorCode.HEAD_LINK_TIMEOUT:
                    self.client.disconnect()      # a board that is silent needs a new hello
            except (ValueError, OSError) as error:
                # an answer that makes no sense, or a fake head that cannot be started
                self._error = PsError(ErrorCode.HEAD_PROTOCOL_MISMATCH
                                      if isinstance(error, ValueError) else
                                      ErrorCode.HEAD_DISCONNECTED, str(error))
                self.client.disconnect()
            self._announce(always=not self.client.connected)
            connected = self.client.connected
            self._wake.wait(self.settings.status_period if connected
                            else self.settings.reconnect_period)
            self._wake.clear()

    def _watch(self) -> None:
        if not self.client.connected:
            # requests that come now are refused because there is no link, not because it is busy
            with self._busy:
                self._state = None
                self._prepare()
                if self._closing:
                    return
                self._connect()
        if self._busy.locked():
            return                                # the operation that runs reads the state itself
        state = self.client.state()
        if state.activity is Activity.IDLE and state.faults is Fault.WATCHDOG:
            self.client.clear_fault()             # its cause, our silence, is over
        if self._home_wanted and not state.homed and not state.faults:
            with self._alone():
                self._home(self.client, self.settings.move_timeout)

    def _connect(self) -> HeadState:
        self._home_wanted = False
        state = self.client.connect(self.settings.motion)
        self._home_wanted = self.settings.home_on_connect and not state.homed
        return state

    def _home(self, client: HeadClient, timeout: float) -> HeadState:
        self._home_wanted = False
        state = client.home(timeout)
        self._error = None
        return state
