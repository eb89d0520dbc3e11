"""Wire protocol of the head's board(s): pure encoder and decoder, after docs/protocol.md.

A packet is COBS(type, sequence, session, body, CRC) and a zero byte; little-endian throughout.
Every request has exactly one reply of the same sequence and session and type + 0x80, whose body
begins with a Result. Nothing here blocks, waits or raises on received bytes except ProtocolError
from the parse functions.
"""
from binascii import crc_hqx
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum, IntFlag
import struct

VERSION = 1
MAX_BODY = 56
MAX_PACKET = 4 + MAX_BODY + 2           # header, body, CRC
MAX_WIRE = MAX_PACKET + 2               # one COBS code byte and the delimiter
REPLY = 0x80
PANELS = 8                              # bright field E N W S, dark field E N W S
FULL_LEVEL = 0xFFFF
STEPS_PER_PACKET = 3
TILT_UNIT = 1e-4                        # rad per unit of a dark-field tilt
TEMPERATURE_UNIT = 0.01                 # K
NOT_MEASURED = 0xFFFF

_HEADER = struct.Struct('<BBH')
_CRC = struct.Struct('<H')


class ProtocolError(ValueError):
    """A packet that is well framed but does not say what it should."""


class Command(IntEnum):
    """Requests; docs/protocol.md has their bodies."""

    HELLO = 0x01
    STATUS = 0x02
    LIMITS = 0x03
    HOME = 0x04
    MOVE = 0x05
    STOP = 0x06
    SERVO = 0x07
    GAINS = 0x08
    STEPS = 0x09
    START = 0x0A
    RECORD = 0x0B
    CLEAR_FAULT = 0x0C


class Result(IntEnum):
    """First byte of every reply."""

    OK = 0
    UNKNOWN_COMMAND = 1
    BAD_LENGTH = 2
    WRONG_SESSION = 3        # the board restarted or another host said hello
    WRONG_VERSION = 4
    UNSUPPORTED = 5          # this board has no motor, or no lights
    BUSY = 6
    NOT_HOMED = 7
    OUT_OF_LIMITS = 8
    BAD_VALUE = 9
    REJECTED = 10            # program beyond on-time or duty limits, or incomplete
    FAULT = 11               # a latched fault forbids it


class Capability(IntFlag):
    """What a board drives."""

    MOTOR = 1
    LIGHTS = 2


class Activity(IntEnum):
    """What the board is doing."""

    IDLE = 0
    HOMING = 1
    MOVING = 2
    STROBING = 3
    STOPPING = 4             # the motor slows down after STOP, a fault or the watchdog


class End(IntEnum):
    """How the last activity ended."""

    NONE = 0                 # none yet, or still running
    DONE = 1
    STOPPED = 2              # by STOP
    FAULT = 3


class Fault(IntFlag):
    """Latched faults; CLEAR_FAULT removes those whose cause has gone."""

    STALL = 1
    LIMIT = 2
    OVER_TEMPERATURE = 4
    LED_OPEN = 8
    WATCHDOG = 16


class StatusFlag(IntFlag):
    """Flags of a status."""

    HOMED = 1
    HOME_SWITCH = 2
    PANELS_ON = 4


# ---------------------------------------------------------------------------- packets

@dataclass(frozen=True)
class Packet:
    """One request or reply.

    :param type: a Command, or a Command + REPLY.
    :param sequence: 0 to 255; a retry repeats it.
    :param session: 0 to 65535; chosen by the host in HELLO, never 0.
    """

    type: int
    sequence: int
    session: int
    body: bytes = b''


def cobs_encode(data: bytes) -> bytes:
    """Consistent overhead byte stuffing: no zero byte in the result.

    :param data: at most 254 bytes, so that a single code byte of overhead is enough.
    """
    return b''.join(bytes([len(part) + 1]) + part for part in data.split(b'\0'))


def cobs_decode(data: bytes) -> bytes | None:
    """Inverse of cobs_encode; None if data is not such an encoding."""
    parts, position = [], 0
    while position < len(data):
        code = data[position]
        if code == 0 or position + code > len(data):
            return None
        parts.append(data[position + 1:position + code])
        position += code
    return b'\0'.join(parts) if parts else None


def encode(packet: Packet) -> bytes:
    """Bytes on the wire, delimiter included.

    :raises ProtocolError: if the body is longer than MAX_BODY.
    """
    if len(packet.body) > MAX_BODY:
        raise ProtocolError(f'body of {len(packet.body)} bytes, at most {MAX_BODY} fit')
    content = _HEADER.pack(packet.type, packet.sequence, packet.session) + packet.body
    return cobs_encode(content + _CRC.pack(crc_hqx(content, 0xFFFF))) + b'\0'


def decode(frame: bytes) -> Packet | None:
    """Packet from the bytes between two delimiters; None if damaged."""
    if len(frame) > MAX_WIRE - 1:
        return None
    content = cobs_decode(frame)
    if content is None or not _HEADER.size + _CRC.size <= len(content) <= MAX_PACKET:
        return None
    if crc_hqx(content[:-2], 0xFFFF) != _CRC.unpack(content[-2:])[0]:
        return None
    kind, sequence, session = _HEADER.unpack(content[:4])
    return Packet(kind, sequence, session, content[4:-2])


class FrameDecoder:
    """Finds packets in a stream of bytes, of any content and cut anywhere.

    ``damaged`` counts frames that were thrown away.
    """

    def __init__(self) -> None:
        self.damaged = 0
        self._buffer = bytearray()
        self._overflow = False

    def feed(self, data: bytes) -> list[Packet]:
        """Packets completed by these bytes; memory stays bounded by one frame."""
        packets = []
        *frames, rest = data.split(b'\0')
        for part in frames:
            self._append(part)
            if self._overflow:
                self.damaged += 1
            elif self._buffer:
                packet = decode(bytes(self._buffer))
                if packet is None:
                    self.damaged += 1
                else:
                    packets.append(packet)
            self._buffer.clear()
            self._overflow = False
        self._append(rest)
        return packets

    def _append(self, part: bytes) -> None:
        if len(self._buffer) + len(part) > MAX_WIRE - 1:
            self._overflow = True
            self._buffer.clear()
        if not self._overflow:
            self._buffer += part


# ---------------------------------------------------------------------------- bodies

HELLO_REQUEST = struct.Struct('<B')             # protocol version
HELLO_REPLY = struct.Struct('<BBBBBB16s')       # version, firmware x.y.z, capabilities, max steps
LIMITS_REQUEST = struct.Struct('<ii')           # soft limits, counts
MOVE_REQUEST = struct.Struct('<iI')             # target, counts; speed, counts/s, 0: fastest
SERVO_REQUEST = struct.Struct('<H')             # dark-field tilt, TILT_UNIT
GAINS_REQUEST = struct.Struct('<8H')            # per panel, of FULL_LEVEL
STEPS_HEAD = struct.Struct('<B')                # index of the first step; 0: new program
STEP = struct.Struct('<BBHIII')                 # panels, flags, level; settle, strobe, period us
START_REQUEST = struct.Struct('<B')             # number of steps uploaded
RECORD_REQUEST = struct.Struct('<B')            # index
STATUS_REPLY = struct.Struct('<BBBHBiHBIIQ8H')
RECORD_REPLY = struct.Struct('<BIIQIi8H')

NO_MOTOR = -2**31                               # motor counts of a board without motor


@dataclass(frozen=True)
class BoardInfo:
    """What a board says about itself."""

    version: int
    firmware: tuple[int, int, int]
    capabilities: Capability
    max_steps: int
    serial: str

    def pack(self) -> bytes:
        """Body of the HELLO reply, after the Result."""
        return HELLO_REPLY.pack(self.version, *self.firmware, self.capabilities, self.max_steps,
                                self.serial.encode('ascii', 'replace')[:16])

    @staticmethod
    def parse(body: bytes) -> 'BoardInfo':
        """Inverse of pack."""
        version, *firmware, capabilities, steps, serial = _unpack(HELLO_REPLY, body, 'hello')
        return BoardInfo(version, (firmware[0], firmware[1], firmware[2]),
                         Capability(capabilities & 3), steps,
                         serial.rstrip(b'\0').decode('ascii', 'replace'))


@dataclass(frozen=True)
class Step:
    """One step of a strobe program, in the board's units.

    :param panels: bit mask, bright field E N W S in bits 0 to 3, dark field in 4 to 7.
    :param level: output relative to FULL_LEVEL, times the panel's gain.
    :param settle_us: panels on before the trigger.
    :param strobe_us: panels on after the trigger.
    :param period_us: shortest time to the next trigger.
    :param trigger: whether the camera gets a pulse.
    """

    panels: int
    level: int
    settle_us: int
    strobe_us: int
    period_us: int
    trigger: bool = True

    def pack(self) -> bytes:
        """As it stands in a STEPS request."""
        return STEP.pack(self.panels, int(self.trigger), self.level, self.settle_us,
                         self.strobe_us, self.period_us)


@dataclass(frozen=True)
class Status:
    """State of one board. Counters are since power-up, ``time_us`` is the board's clock."""

    activity: Activity
    end: End
    flags: StatusFlag
    faults: Fault
    fault_panels: int                   # bit mask as in Step
    motor_counts: int                   # measured; NO_MOTOR without motor
    df_tilt_units: int                  # TILT_UNIT; NOT_MEASURED without lights
    steps_done: int                     # of the last program
    strobe_counter: int
    trigger_counter: int
    time_us: int
    temperatures: tuple[int, ...]       # PANELS values, TEMPERATURE_UNIT; NOT_MEASURED

    def pack(self) -> bytes:
        """Body of the STATUS reply, after the Result."""
        return STATUS_REPLY.pack(
            self.activity, self.end, self.flags, self.faults, self.fault_panels,
            self.motor_counts, self.df_tilt_units, self.steps_done, self.strobe_counter,
            self.trigger_counter, self.time_us, *self.temperatures)

    @staticmethod
    def parse(body: bytes) -> 'Status':
        """Inverse of pack.

        :raises ProtocolError: wrong length or unknown activity.
        """
        (activity, end, flags, faults, panels, counts, tilt, steps, strobes, triggers, time_us,
         *temperatures) = _unpack(STATUS_REPLY, body, 'status')
        try:
            return Status(Activity(activity), End(end), StatusFlag(flags & 7), Fault(faults & 31),
                          panels, counts, tilt, steps, strobes, triggers, time_us,
                          tuple(temperatures))
        except ValueError as error:
            raise ProtocolError(f'status: {error}') from error


@dataclass(frozen=True)
class StepRecord:
    """What the board did in one step.

    :param strobe_us: time the panels were on after the trigger.
    :param time_us: of the trigger, on the board's clock.
    :param levels: output of each panel relative to FULL_LEVEL.
    """

    index: int
    strobe_counter: int
    trigger_counter: int
    time_us: int
    strobe_us: int
    motor_counts: int
    levels: tuple[int, ...]

    def pack(self) -> bytes:
        """Body of the RECORD reply, after the Result."""
        return RECORD_REPLY.pack(self.index, self.strobe_counter, self.trigger_counter,
                                 self.time_us, self.strobe_us, self.motor_counts, *self.levels)

    @staticmethod
    def parse(body: bytes) -> 'StepRecord':
        """Inverse of pack."""
        index, strobes, triggers, time_us, strobe_us, motor, *levels = _unpack(
            RECORD_REPLY, body, 'record')
        return StepRecord(index, strobes, triggers, time_us, strobe_us, motor, tuple(levels))


def pack_steps(steps: Sequence[Step]) -> list[bytes]:
    """Bodies of the STEPS requests that upload a program."""
    return [STEPS_HEAD.pack(first) + b''.join(
                step.pack() for step in steps[first:first + STEPS_PER_PACKET])
            for first in range(0, len(steps), STEPS_PER_PACKET)]


def parse_steps(body: bytes) -> tuple[int, list[Step]]:
    """First index and steps of a STEPS request.

    :raises ProtocolError: wrong length.
    """
    count, rest = divmod(len(body) - STEPS_HEAD.size, STEP.size)
    if rest or not 1 <= count <= STEPS_PER_PACKET:
        raise ProtocolError(f'steps: {len(body)} bytes')
    steps = []
    for i in range(count):
        panels, flags, level, settle, strobe, period = STEP.unpack_from(
            body, STEPS_HEAD.size + i * STEP.size)
        steps.append(Step(panels, level, settle, strobe, period, bool(flags & 1)))
    return body[0], steps


def _unpack(layout: struct.Struct, body: bytes, name: str) -> tuple:
    if len(body) != layout.size:
        raise ProtocolError(f'{name}: {len(body)} bytes, expected {layout.size}')
    return layout.unpack(body)
