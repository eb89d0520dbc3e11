"""Reading sessions: finished ones, ones cut off by a crash, and files that are neither.

A file is read from front to back, record by record, and nothing it says is trusted: sizes are
checked against what is there before memory is taken for them, and damage costs the damaged chunk
only. Nothing here needs ROS except ``Session.stacks``.
"""
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
import struct
from typing import Any, BinaryIO
import zlib

import lz4.frame
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.stream_reader import breakup_chunk
import yaml
import zstandard

from ps_head_driver.errors import ErrorCode, PsError
from ps_inspection.bag_file import BagFile
from ps_inspection.session_format import (
    METADATA_FILE,
    STACK_TYPE,
    Topic,
    error_of,
    message_definition,
    rosbag2_metadata,
    write_atomically,
)

MAGIC = b'\x89MCAP0\r\n'
MAX_CHUNK_BYTES = 2 << 30


@dataclass(frozen=True)
class Message:
    """One recorded message; ``data`` is serialized (CDR), times in ns since 1970."""

    topic: Topic
    data: bytes
    log_time: int
    publish_time: int


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


@dataclass(frozen=True)
class Recovery:
    """What ``Session.recover`` did."""

    changed: bool
    messages: int
    stacks: int
    lost_bytes: int
    problems: list[str]


class Session:
    """A session folder or a single .mcap file.

    :raises PsError: SESSION_NOT_A_SESSION if there is no MCAP file to read.
    """

    def __init__(self, path: Path | str, max_chunk_bytes: int = MAX_CHUNK_BYTES) -> None:
        path = Path(path)
        self.max_chunk_bytes = max_chunk_bytes
        # metadata.yaml also names the file, but could name any file
        self._is_folder = path.is_dir()
        files = sorted(path.glob('*.mcap')) if self._is_folder else [path]
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
        schemas: dict[int, records.Schema] = {}
        topics: dict[int, Topic] = {}
        for record in self._records(scan):
            if isinstance(record, records.Schema):
                schemas[record.id] = record
            elif isinstance(record, records.Channel):
                if record.id not in topics and record.schema_id in schemas:
                    topic = _topic(record, schemas[record.schema_id])
                    known = {other.name: other for other in scan.topics}.get(topic.name)
                    if known is None:
                        scan.topics.append(topic)
                    elif known.type != topic.type:
                        scan.problems.append(f'topic {topic.name} has two types')
                        continue
                    topics[record.id] = known or topic
            elif isinstance(record, records.Metadata):
                scan.metadata[record.name] = dict(record.metadata)
            elif isinstance(record, records.Message) and record.channel_id in topics:
                yield Message(topics[record.channel_id], record.data, record.log_time,
                              record.publish_time)

    def stacks(self, scan: Scan | None = None) -> Iterator[Any]:
        """All photometric stacks as ps_interfaces messages.

        :raises PsError: SESSION_NOT_A_SESSION if the session was recorded with another definition
            of the stack; a single stack that cannot be decoded is a problem of the scan.
        """
        from rclpy.serialization import deserialize_message

        from ps_interfaces.msg import PhotometricStack

        scan = Scan() if scan is None else scan
        _, expected = message_definition(STACK_TYPE)
        for number, message in enumerate(
                m for m in self.messages(scan) if m.topic.type == STACK_TYPE):
            if message.topic.type_hash not in ('', expected):
                raise PsError(
                    ErrorCode.SESSION_NOT_A_SESSION,
                    f'{self.file} was recorded with another definition of {STACK_TYPE}; read it '
                    'with the software version that "ps_session info" shows')
            try:
                yield deserialize_message(message.data, PhotometricStack)
            except Exception as error:
                scan.problems.append(f'stack {number} cannot be decoded: {error}')

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

    def recover(self) -> Recovery:
        """Make a session that was cut off a complete one, losing nothing that can be read.

        The file is written anew beside the old one and put in its place at the end, so an
        interrupted recovery does no harm. A session that is whole is left alone.

        :raises PsError: SESSION_DISK_FULL, SESSION_NO_PERMISSION or SESSION_WRITE_FAILED;
            SESSION_BAD_REQUEST for a file without its folder.
        """
        if not self._is_folder:
            raise PsError(ErrorCode.SESSION_BAD_REQUEST,
                          f'{self.file} is a file; name the session folder it is in')
        info = self.info()
        scan = info.scan
        stacks = sum(n for name, n in info.counts.items() if info.types[name] == STACK_TYPE)
        result = Recovery(not info.complete or bool(scan.problems), sum(info.counts.values()),
                          stacks, scan.lost_bytes, scan.problems)
        custom = scan.metadata.get('session', {})
        try:
            if scan.complete and not scan.problems:
                if result.changed:      # only metadata.yaml is missing
                    write_atomically(self.folder / METADATA_FILE, rosbag2_metadata(
                        self.file.name,
                        [(topic, info.counts[topic.name]) for topic in scan.topics],
                        info.start, info.end, custom))
                return result
            self._rewrite(scan, custom)
        except OSError as error:
            raise error_of(error, self.file) from error
        return result

    def _rewrite(self, scan: Scan, custom: dict[str, str]) -> None:
        new = self.file.with_name(self.file.name + '.recovering')
        new.unlink(missing_ok=True)
        bag = BagFile(new, scan.topics, scan.compression)
        try:
            for name, values in scan.metadata.items():
                bag.add_metadata(name, values)
            for message in self.messages():
                bag.write(message.topic.name, message.data, message.log_time,
                          message.publish_time)
            bag.finish(custom, self.file)
        except BaseException:
            bag.abandon()
            new.unlink(missing_ok=True)
            raise

    # ------------------------------------------------------------------ records

    def _records(self, scan: Scan) -> Iterator[records.McapRecord]:
        """Records of interest, those inside chunks included."""
        size = self.file.stat().st_size
        with self.file.open('rb') as stream:
            stream.seek(len(MAGIC))
            while not scan.complete:
                start = stream.tell()
                head = stream.read(9)
                opcode, length = struct.unpack('<BQ', head) if len(head) == 9 else (0, 0)
                if not opcode or length > size - stream.tell():
                    scan.lost_bytes += size - start
                    scan.problems.append(f'the file ends inside a record, at byte {start}')
                    return
                if opcode == Opcode.FOOTER:
                    scan.complete = True
                elif opcode in _READERS:
                    try:
                        yield from self._parse(opcode, stream, length, scan)
                    except Exception as error:      # a damaged record can fail in any way
                        scan.lost_bytes += length + 9
                        scan.problems.append(
                            f'record at byte {start} is damaged: {type(error).__name__}: {error}')
                stream.seek(start + 9 + length)

    def _parse(self, opcode: int, stream: BinaryIO, length: int,
               scan: Scan) -> list[records.McapRecord]:
        data = ReadDataStream(BytesIO(stream.read(length)))
        record = _READERS[opcode](data, length)
        if not isinstance(record, records.Chunk):
            return [record]
        scan.compression = record.compression or 'none'
        return breakup_chunk(self._decompressed(record))

    def _decompressed(self, chunk: records.Chunk) -> records.Chunk:
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
        chunk.compression, chunk.data = '', data
        return chunk


_READERS: dict[int, Callable[[ReadDataStream, int], records.McapRecord]] = {
    Opcode.CHUNK: lambda data, _: records.Chunk.read(data),
    Opcode.SCHEMA: lambda data, _: records.Schema.read(data),
    Opcode.CHANNEL: lambda data, _: records.Channel.read(data),
    Opcode.METADATA: lambda data, _: records.Metadata.read(data),
    Opcode.MESSAGE: records.Message.read,
}


def _topic(channel: records.Channel, schema: records.Schema) -> Topic:
    return Topic(channel.topic, schema.name, _is_latched(channel),
                 schema.data.decode('utf-8', 'replace'),
                 channel.metadata.get('topic_type_hash', ''))


def _is_latched(channel: records.Channel) -> bool:
    try:
        profiles = yaml.safe_load(channel.metadata.get('offered_qos_profiles', ''))
        # rosbag2 wrote numbers before version 9
        return bool(profiles) and profiles[0].get('durability') in ('transient_local', 1)
    except (yaml.YAMLError, AttributeError, KeyError, TypeError):
        return False
