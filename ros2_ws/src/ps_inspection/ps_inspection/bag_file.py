"""One MCAP file in a rosbag2 folder, written so that a crash costs only the last moments."""
from collections.abc import Mapping, Sequence
import contextlib
import io
import os
from pathlib import Path

from mcap.writer import CompressionType, Writer
import yaml

from ps_head_driver.errors import ErrorCode, PsError
from ps_reconstruction.session_format import (
    METADATA_FILE,
    Topic,
    error_of,
    rosbag2_metadata,
    write_atomically,
)

COMPRESSION = {
    'none': CompressionType.NONE, 'lz4': CompressionType.LZ4, 'zstd': CompressionType.ZSTD}


class BagFile:
    """Appends messages; ``flush`` makes them survive the process, ``finish`` completes the bag.

    Until ``finish`` there is no metadata.yaml and the file has no index: readers of finished bags
    refuse it, session_reader reads and session_recovery repairs it.

    :param path: the .mcap file; it must not exist, its folder must.
    :param topics: all topics, so that the file's first bytes describe whatever follows.
    :param compression: a key of COMPRESSION.
    :raises OSError: from every method that writes.
    """

    def __init__(self, path: Path, topics: Sequence[Topic], compression: str = 'none') -> None:
        self.path = path
        self.counts = {topic.name: 0 for topic in topics}
        self.flushed_size = 0
        self._topics = {topic.name: topic for topic in topics}
        self._start = self._end = 0
        # unbuffered: after an error nothing must be left that a later close would try to write
        self._stream = io.FileIO(path, 'xb')
        self._writer = Writer(self._stream, chunk_size=4 << 20,
                              compression=COMPRESSION[compression])
        self._writer.start(profile='ros2', library='ps_inspection')
        self._schemas: dict[str, int] = {}
        self._channels = {topic.name: self._register(topic) for topic in topics}
        self._writer.flush()

    def _register(self, topic: Topic) -> int:
        if topic.type not in self._schemas:
            self._schemas[topic.type] = self._writer.register_schema(
                topic.type, 'ros2msg', topic.definition.encode())
        return self._writer.register_channel(
            topic.name, 'cdr', self._schemas[topic.type], {
                'offered_qos_profiles': yaml.safe_dump(topic.qos(), sort_keys=False),
                'topic_type_hash': topic.type_hash,
            })

    def write(self, topic: str, data: bytes, log_time: int, publish_time: int) -> None:
        """Append one serialized message; times in ns since 1970."""
        self._writer.add_message(self._channels[topic], log_time, data, publish_time,
                                 sequence=self.counts[topic])
        first = not any(self.counts.values())
        self._start = log_time if first else min(self._start, log_time)
        self._end = log_time if first else max(self._end, log_time)
        self.counts[topic] += 1

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Append a named record of texts (provenance)."""
        self._writer.add_metadata(name, dict(values))

    def flush(self, sync: bool = False) -> None:
        """Hand everything to the operating system; with ``sync`` to the disk.

        :raises PsError: SESSION_WRITE_FAILED if the file is no longer in its folder.
        """
        self._writer.flush()
        if sync:
            os.fdatasync(self._stream.fileno())
        self.flushed_size = self._stream.tell()
        # a deleted file still takes data, and loses all of it when it is closed
        try:
            in_place = os.path.samestat(os.fstat(self._stream.fileno()), self.path.stat())
        except OSError:
            in_place = False
        if not in_place:
            raise PsError(ErrorCode.SESSION_WRITE_FAILED,
                          f'{self.path} was removed or replaced while recording')

    def free_bytes(self) -> int:
        """Bytes left on the file's disk."""
        state = os.fstatvfs(self._stream.fileno())
        return state.f_bavail * state.f_frsize

    def finish(self, custom: Mapping[str, str], replace: Path | None = None) -> None:
        """Write index, footer and metadata.yaml, and close.

        :param custom: see ``rosbag2_metadata``.
        :param replace: put the file in the place of this one before metadata.yaml is written.
        """
        self._writer.finish()
        # the writer's own buffer lies between; its flush is the only way to it
        self._writer.flush()
        os.fsync(self._stream.fileno())
        self._stream.close()
        if replace is not None:
            self.path = self.path.replace(replace)
        write_atomically(self.path.parent / METADATA_FILE, rosbag2_metadata(
            self.path.name,
            [(topic, self.counts[name]) for name, topic in self._topics.items()],
            self._start, self._end, custom))

    def abandon(self) -> None:
        """Close after an error: drop what was written in part, keep what was flushed."""
        if self._stream.closed:
            return
        with contextlib.suppress(OSError):
            os.ftruncate(self._stream.fileno(), self.flushed_size)
        self._stream.close()


def create_bag(folder: Path, topics: Sequence[Topic], compression: str) -> BagFile:
    """Make a new session folder with an empty bag in it.

    :raises PsError: SESSION_BAD_REQUEST if the folder exists, SESSION_NO_PERMISSION,
        SESSION_DISK_FULL or SESSION_WRITE_FAILED.
    """
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        folder.mkdir()
        return BagFile(folder / f'{folder.name}_0.mcap', topics, compression)
    except FileExistsError as error:
        reason = 'a session of this name exists' if folder.exists() else 'not a folder'
        raise PsError(ErrorCode.SESSION_BAD_REQUEST, f'{error.filename}: {reason}') from error
    except OSError as error:
        raise error_of(error, folder) from error
