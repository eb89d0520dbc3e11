"""What happened in a session: its stacks, results, faults and states, without pictures."""
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from ps_head_driver.conversions import message_to_stack
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.stack import Stack
from ps_inspection.session_output import identity, known, reason
from ps_interfaces.msg import HeadStatus
from ps_reconstruction.session_format import STACK_TYPE
from ps_reconstruction.session_reader import Message, Place, Scan, Session, decode

MAX_EVENTS = 2000
STATES = {getattr(HeadStatus, name): name.lower() for name in (
    'DISCONNECTED', 'CONNECTED', 'HOMING', 'READY', 'MOVING', 'STROBING', 'FAULT')}
_LEVELS = ('ok', 'warning', 'fault', 'fault')      # of DiagnosticStatus; stale counts as a fault


@dataclass
class Entry:
    """One stack and what became of it; times in s from the start of the session.

    :param facts: values of session_output.IDENTITY_FIELDS.
    :param acquired: when the last exposure had ended; None if not recorded.
    :param result: fields of its ReconstructionInfo; None if there was none.
    :param reconstructed: when the result came.
    """

    place: Place
    facts: dict[str, Any]
    lights: list[str]
    received: float
    acquired: float | None = None
    result: dict[str, Any] | None = None
    reconstructed: float | None = None

    @property
    def name(self) -> str:
        """The part, or the stack where the part has no name."""
        return str(self.facts['part_id'] or self.facts['stack_id'])


@dataclass(frozen=True)
class Event:
    """Something that people should know; ``kind`` is fault, warning or ok (a return to it)."""

    time: float
    kind: str
    source: str
    text: str


@dataclass
class Summary:
    """A session without its pictures; times in s from its start.

    :param start_ns: log time of the first message, ns since 1970.
    :param states: (begin, state of the head), one entry a change.
    :param calibrations: calibration id to what is known of it.
    """

    scan: Scan = field(default_factory=Scan)
    start_ns: int = 0
    duration: float = 0.0
    messages: int = 0
    entries: list[Entry] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    states: list[tuple[float, str]] = field(default_factory=list)
    calibrations: dict[str, dict[str, Any]] = field(default_factory=dict)


def summarize(session: Session) -> Summary:
    """Read a session once.

    A message that cannot be read is a problem of ``Summary.scan``.
    """
    return _Summarizer(session).run()


class _Summarizer:
    def __init__(self, session: Session) -> None:
        self._session = session
        self._summary = Summary()
        self._acquired: dict[str, float] = {}
        self._by_id: dict[str, Entry] = {}
        self._levels: dict[str, str] = {}
        self._head_error = 0
        self._foreign: set[str] = set()
        self._handlers: dict[str, Callable[[Message, Any, float], None]] = {
            STACK_TYPE: self._on_stack,
            'ps_interfaces/msg/AcquisitionDone': self._on_done,
            'ps_interfaces/msg/ReconstructionInfo': self._on_info,
            'ps_interfaces/msg/HeadStatus': self._on_status,
            'ps_interfaces/msg/HeadCalibration': self._on_calibration,
            'diagnostic_msgs/msg/DiagnosticArray': self._on_diagnostics}

    def run(self) -> Summary:
        summary, scan = self._summary, self._summary.scan
        for message in self._session.messages(scan):
            if not summary.messages:
                summary.start_ns = message.log_time
            summary.messages += 1
            time = (message.log_time - summary.start_ns) * 1e-9
            summary.duration = max(summary.duration, time)
            handler = self._handlers.get(message.topic.type)
            if handler is None or message.topic.type in self._foreign:
                continue
            try:
                self._session.check_definition(message.topic)
            except PsError as error:
                self._foreign.add(message.topic.type)
                scan.note(error.message)
                continue
            try:
                handler(message, decode(message.data, message.topic.type), time)
            except (ValueError, PsError) as error:
                scan.note(f'{message.topic.name} after {time:.3f} s: {reason(error)}')
        return summary

    def _event(self, time: float, kind: str, source: str, text: str) -> None:
        if len(self._summary.events) < MAX_EVENTS:
            self._summary.events.append(Event(time, kind, source, text))

    def _on_stack(self, message: Message, decoded: Any, time: float) -> None:
        stack: Stack = message_to_stack(decoded)
        entry = Entry(message.place, identity(stack), [light.name for light in stack.lights],
                      time, self._acquired.get(stack.stack_id))
        self._summary.entries.append(entry)
        self._by_id[stack.stack_id] = entry

    def _on_done(self, _message: Message, done: Any, time: float) -> None:
        if done.success:
            self._acquired[done.stack_id] = time
        else:
            self._event(time, 'fault', 'capture', _failure(done))

    def _on_info(self, _message: Message, info: Any, time: float) -> None:
        if not info.success:
            self._event(time, 'fault', 'reconstruction', _failure(info))
        entry = self._by_id.get(info.stack_id)
        if entry is not None and info.success:
            entry.reconstructed = time
            entry.result = {
                'method': info.method, 'valid_fraction': info.valid_fraction,
                'residual_rms': known(info.residual_rms),
                **{name: known(getattr(info, f'roughness_{name}'))
                   for name in ('sa', 'sq', 'sdq', 'sdr')},
                'durations': {d.stage: d.duration for d in info.durations}}

    def _on_status(self, _message: Message, status: Any, time: float) -> None:
        state = STATES.get(status.state, 'unknown')
        states = self._summary.states
        if not states or states[-1][1] != state:
            states.append((time, state))
        if status.error_code != self._head_error:
            self._head_error = status.error_code
            if status.error_code:
                self._event(time, 'fault', 'head', _failure(status))
            else:
                self._event(time, 'ok', 'head', 'well again')

    def _on_calibration(self, _message: Message, calibration: Any, _time: float) -> None:
        if calibration.calibration_id:
            created = datetime.fromtimestamp(calibration.created.sec, UTC)
            self._summary.calibrations[calibration.calibration_id] = {
                'created': f'{created:%Y-%m-%d %H:%M} UTC' if calibration.created.sec else '',
                'head serial': calibration.head_serial,
                'target': calibration.target_name,
                'verdict': ('none', 'OK', 'POOR', 'FAILED')[min(calibration.verdict, 3)],
                'reason': calibration.verdict_reason}

    def _on_diagnostics(self, _message: Message, array: Any, time: float) -> None:
        for status in array.status:
            level = _LEVELS[min(status.level[0], 3)]
            if level != self._levels.get(status.name, 'ok'):
                self._event(time, level, status.name, status.message)
            self._levels[status.name] = level


def _failure(message: Any) -> str:
    """Code by name, and text, of a message with error_code and message."""
    try:
        name = ErrorCode(message.error_code).name
    except ValueError:
        name = f'error {message.error_code}'
    return f'{name}: {message.message}' if message.message else name
