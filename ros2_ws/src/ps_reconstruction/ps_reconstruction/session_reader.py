"""Reading sessions: finished ones, ones cut off by a crash, and files that are neither.

A file is read from front to back, record by record, and nothing it says is trusted: sizes are
checked against what is there before memory is taken for them, and damage costs the damaged chunk
only. Nothing here needs ROS except the decoding of messages.
"""
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib import import_module
from io import BytesIO
from itertools import islice
from pathlib import Path
import re
import struct
from typing import Any, BinaryIO
import zlib

import lz4.frame
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
import zstandard

from ps_head_driver.errors import ErrorCode, PsError
from ps_reconstruction import cdr
from ps_reconstruction.session_format import (
    METADATA_FILE,
    STACK_TYPE,
    Topic,
    message_definition,
)

MAGIC = b'\x89MCAP0\r\n'
MAX_CHUNK_BYTES = 1 << 30           # the largest stack that is read
MAX_DESCRIPTION_BYTES = 64 << 20    # of topics, types and provenance together
MAX_PROBLEMS = 200


@dataclass(frozen=True)
class Place:
    """Where in a file a message is: byte of its record or chunk, and number in the chunk."""

    offset: int
    number: int


@dataclass(frozen=True)
class Message:
    """One recorded message; ``data`` is serialized (CDR), times in ns since 1970."""

    topic: Topic
    data: bytes
    log_time: int
    publish_time: int
    place: Place = field(compare=False)


@dataclass
class Scan:
    """What a pass over a file found besides messages.

    :param complete: the file ends with a footer, as a finished session's does.
    :param problems: damage, in words, one entry a place.
    :param lost_bytes: bytes that belong to no whole record.
    :param metadata: named groups of texts (provenance).
    """

    complete: bool = False
    problems: list[str] = field(default_factory=list)
    lost_bytes: int = 0
    compression: str = 'none'
    topics: list[Topic] = field(default_factory=list)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)

    def note(self, problem: str) -> None:
        """Add to ``problems``, of which a hostile file may have as many as it has bytes."""
        if len(self.problems) < MAX_PROBLEMS:
            self.problems.append(problem)
        elif len(self.problems) == MAX_PROBLEMS:
            self.problems.append('there are more problems than are listed')


@dataclass(frozen=True)
class Info:
    """What is in a session; times in ns since 1970."""

    path: Path
    complete: bool
    size_bytes: int
    start: int
    end: int
    counts: dict[str, int]
    types: dict[str, str]
    scan: Scan

    @property
    def stacks(self) -> int:
        """Photometric stacks on all topics."""
        return sum(n for topic, n in self.counts.items() if self.types[topic] == STACK_TYPE)


class Session:
    """A session folder or a single .mcap file.

    :raises PsError: SESSION_NOT_A_SESSION if there is no MCAP file to read.
    """

    def __init__(self, path: Path | str, max_chunk_bytes: int = MAX_CHUNK_BYTES) -> None:
        path = Path(path)
        self.max_chunk_bytes = max_chunk_bytes
        # metadata.yaml also names the file, but could name any file
        self.is_folder = path.is_dir()
        files = sorted(path.glob('*.mcap')) if self.is_folder else [path]
        if not path.exists():
            raise PsError(ErrorCode.SESSION_NOT_A_SESSION, f'{path} does not exist')
        if len(files) != 1:
            raise PsError(ErrorCode.SESSION_NOT_A_SESSION,
                          f'{path} holds {len(files)} .mcap files; a session holds one')
        self.file = files[0]
        self.folder = self.file.parent
        try:
            with self.file.open('rb') as stream:
                magic = stream.read(len(MAGIC))
        except OSError as error:
            raise PsError(ErrorCode.SESSION_NOT_A_SESSION,
                          f'cannot read {self.file}: {error.strerror}') from error
        if magic != MAGIC:
            raise PsError(ErrorCode.SESSION_NOT_A_SESSION, f'{self.file} is not an MCAP file')

    def messages(self, scan: Scan | None = None) -> Iterator[Message]:
        """All messages that can be read, in file order.

        :param scan: filled on the way.
        """
        scan = Scan() if scan is None else scan
        definitions: dict[int, tuple[str, str]] = {}        # schema id: type and its text
        topics: dict[int, Topic] = {}
        named: dict[str, Topic] = {}
        described = 0
        for record, place in self._records(scan):
            if isinstance(record, records.Message):
                if record.channel_id in topics:
                    yield Message(topics[record.channel_id], record.data, record.log_time,
                                  record.publish_time, place)
                continue
            described += _size(record)
            if described > MAX_DESCRIPTION_BYTES:
                scan.note(f'topics and metadata after byte {place.offset} are left out: together '
                          f'they are larger than {MAX_DESCRIPTION_BYTES} bytes')
            elif isinstance(record, records.Schema):
                definitions[record.id] = record.name, record.data.decode('utf-8', 'replace')
            elif isinstance(record, records.Metadata):
                scan.metadata[record.name] = dict(record.metadata)
            elif (isinstance(record, records.Channel) and record.id not in topics
                    and record.schema_id in definitions):
                topic = _topic(record, *definitions[record.schema_id])
                known = named.setdefault(topic.name, topic)
                if known is topic:
                    scan.topics.append(topic)
                elif known.type != topic.type:
                    scan.note(f'topic {topic.name} has two types')
                    continue
                topics[record.id] = known

    def read(self, place: Place) -> bytes:
        """Serialized message at a place that ``messages`` told, without reading what is before.

        :raises PsError: SESSION_NOT_A_SESSION if there is none.
        """
        try:
            with self.file.open('rb') as stream:
                stream.seek(place.offset)
                opcode, length = _record_head(stream)
                record = next(islice(self._parse(opcode, stream, length, Scan()),
                                     place.number, None))
            if isinstance(record, records.Message):
                return record.data
            reason = 'not a message'
        except Exception as error:
            reason = f'{type(error).__name__}: {error}'
        raise PsError(ErrorCode.SESSION_NOT_A_SESSION,
                      f'{self.file} has changed: no message at byte {place.offset}: {reason}')

    def stacks(self, scan: Scan | None = None) -> Iterator[Any]:
        """All photometric stacks as ps_interfaces messages.

        :raises PsError: SESSION_NOT_A_SESSION if the session was recorded with another definition
            of the stack; a single stack that cannot be decoded is a problem of the scan.
        """
        scan = Scan() if scan is None else scan
        for number, message in enumerate(self.stack_messages(scan)):
            try:
                yield decode(message.data, STACK_TYPE)
            except ValueError as error:
                scan.note(f'stack {number} cannot be decoded: {error}')

    def stack_messages(self, scan: Scan | None = None) -> Iterator[Message]:
        """All photometric stacks, serialized.

        :raises PsError: as ``stacks``.
        """
        for message in self.messages(scan):
            if message.topic.type == STACK_TYPE:
                self.check_definition(message.topic)
                yield message

    def check_definition(self, topic: Topic) -> None:
        """Refuse a topic whose messages this software would decode wrongly.

        :raises PsError: SESSION_NOT_A_SESSION if its type had another definition.
        """
        _, expected = message_definition(topic.type)
        if topic.type_hash not in ('', expected):
            raise PsError(
                ErrorCode.SESSION_NOT_A_SESSION,
                f'{self.file} was recorded with another definition of {topic.type}; read it '
                'with the software version that "ps_session info" shows')

    def info(self) -> Info:
        """Read the whole file and say what is in it."""
        scan = Scan()
        counts: dict[str, int] = {}
        times: list[int] = []
        for message in self.messages(scan):
            counts[message.topic.name] = counts.get(message.topic.name, 0) + 1
            times = [min([*times[:1], message.log_time]), max([*times[1:], message.log_time])]
        start, end = times or (0, 0)
        return Info(self.file, scan.complete and (self.folder / METADATA_FILE).is_file(),
                    self.file.stat().st_size, start, end,
                    {topic.name: counts.get(topic.name, 0) for topic in scan.topics},
                    {topic.name: topic.type for topic in scan.topics}, scan)

    # ------------------------------------------------------------------ records

    def _records(self, scan: Scan) -> Iterator[tuple[records.McapRecord, Place]]:
        """Records of interest, those inside chunks included, and where they are."""
        size = self.file.stat().st_size
        with self.file.open('rb') as stream:
            stream.seek(len(MAGIC))
            while not scan.complete:
                start = stream.tell()
                opcode, length = _record_head(stream)
                if not opcode or length > size - stream.tell():
                    scan.lost_bytes += size - start
                    scan.note(f'the file ends inside a record, at byte {start}')
                    return
                if opcode == Opcode.FOOTER:
                    scan.complete = True
                try:
                    for number, record in enumerate(self._parse(opcode, stream, length, scan)):
                        yield record, Place(start, number)
                except Exception as error:      # a damaged record can fail in any way
                    scan.lost_bytes += length + 9
                    scan.note(
                        f'record at byte {start} is damaged: {type(error).__name__}: {error}')
                stream.seek(start + 9 + length)

    def _parse(self, opcode: int, stream: BinaryIO, length: int,
               scan: Scan) -> Iterator[records.McapRecord]:
        """The record of interest that follows in the stream, or all those in a chunk."""
        if opcode != Opcode.CHUNK and opcode not in _READERS:
            return
        if length > self.max_chunk_bytes:
            raise ValueError(f'it has {length} bytes, the limit is {self.max_chunk_bytes}')
        content = BytesIO(stream.read(length))
        if opcode != Opcode.CHUNK:
            yield _READERS[opcode](ReadDataStream(content), length)
            return
        chunk = records.Chunk.read(ReadDataStream(content))
        content = BytesIO(self._decompressed(chunk))
        scan.compression = chunk.compression or 'none'
        while True:
            opcode, length = _record_head(content)
            if not opcode:
                return
            following = content.tell() + length
            if following > chunk.uncompressed_size:
                raise ValueError('the chunk ends inside a record')
            if opcode in _READERS:
                yield _READERS[opcode](ReadDataStream(content), length)
            content.seek(following)

    def _decompressed(self, chunk: records.Chunk) -> bytes:
        size = chunk.uncompressed_size
        if size > self.max_chunk_bytes:
            raise ValueError(f'chunk claims {size} bytes, the limit is {self.max_chunk_bytes}')
        if chunk.compression == 'lz4':
            data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
        elif chunk.compression == 'zstd':
            if zstandard.get_frame_parameters(chunk.data).content_size > size:
                raise ValueError('zstd frame is larger than its chunk')
            data = zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=size)
        elif chunk.compression == '':
            data = chunk.data
        else:
            raise ValueError(f'compression {chunk.compression!r} is not known')
        if len(data) != size or (chunk.uncompressed_crc and
                                 zlib.crc32(data) != chunk.uncompressed_crc):
            raise ValueError('chunk content does not match its size or check sum')
        return data


def _record_head(stream: BinaryIO) -> tuple[int, int]:
    """Opcode and length of content of the next record; opcode 0 at the end."""
    head = stream.read(9)
    opcode, length = struct.unpack('<BQ', head) if len(head) == 9 else (0, 0)
    return opcode, length


_READERS: dict[int, Callable[[ReadDataStream, int], records.McapRecord]] = {
    Opcode.SCHEMA: lambda data, _: records.Schema.read(data),
    Opcode.CHANNEL: lambda data, _: records.Channel.read(data),
    Opcode.METADATA: lambda data, _: records.Metadata.read(data),
    Opcode.MESSAGE: records.Message.read,
}


def _size(record: records.McapRecord) -> int:
    """Bytes, about, that keeping a schema, channel or metadata record takes."""
    texts = [value for value in vars(record).values() if isinstance(value, str | bytes)]
    for pairs in vars(record).values():
        if isinstance(pairs, dict):
            texts += [*pairs.keys(), *pairs.values()]
    return 1000 + sum(map(len, texts))


def _topic(channel: records.Channel, message_type: str, definition: str) -> Topic:
    return Topic(channel.topic, message_type, _is_latched(channel), definition,
                 channel.metadata.get('topic_type_hash', ''))


def _is_latched(channel: records.Channel) -> bool:
    # not parsed as YAML: a text of brackets would take its parser seconds
    durability = re.search(r'durability:\s*(\w+)',
                           channel.metadata.get('offered_qos_profiles', ''))
    # rosbag2 wrote numbers before version 9
    return durability is not None and durability[1] in ('transient_local', '1')


def decode(data: bytes, message_type: str) -> Any:
    """Message of an installed type, from serialized data that nobody vouches for.

    :raises ValueError: if it cannot be decoded.
    """
    from rclpy.serialization import deserialize_message
    cdr.check(data, message_type)
    package, _, name = message_type.split('/')
    try:
        return deserialize_message(data, getattr(import_module(f'{package}.msg'), name))
    except Exception as error:
        raise ValueError(f'{type(error).__name__}: {error}') from error


def is_session(path: Path) -> bool:
    """Whether a path looks like a session: an .mcap file, or a folder with one."""
    return (path.is_file() and path.suffix == '.mcap') or (
        path.is_dir() and any(path.glob('*.mcap')))
