"""Recording a session: a bounded queue and a thread of its own between callbacks and the disk.

Policy when the disk cannot keep up: what is in the queue gets written; a message that does not
fit any more is refused and counted, and a refused stack is never acknowledged. The newest is lost
and not the oldest because what was taken in before has priority over what nobody was promised.
"""
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
import threading
import time

from ps_head_driver.errors import ErrorCode, PsError
from ps_inspection.bag_file import BagFile, create_bag
from ps_reconstruction.session_format import Topic, error_of


@dataclass(frozen=True)
class WriterOptions:
    """How a session is written.

    :param compression: none, lz4 or zstd.
    :param queue_bytes: limit of the queue; one message is taken whatever its size.
    :param flush_period: s; a small message is in the file after this time at the latest.
    :param sync: wait for the disk before a message is acknowledged, so that it survives a power
        failure and not only a crash.
    :param min_free_bytes: the session ends, complete and readable, before less than this is left
        on the disk.
    """

    compression: str = 'none'
    queue_bytes: int = 1 << 30
    flush_period: float = 0.5
    sync: bool = True
    min_free_bytes: int = 256 << 20


@dataclass(frozen=True)
class _Message:
    topic: str
    data: bytes
    log_time: int
    publish_time: int
    on_written: Callable[[], None] | None


class SessionWriter:
    """A session being recorded.

    An error of the disk ends the recording, never the caller: ``error`` then says why,
    ``on_error`` is called once, and further messages are refused.

    :param folder: the session folder, to be created.
    :param provenance: named groups of texts that go into the file first; the group ``session``
        also goes into metadata.yaml.
    :param on_error: called from the writer's thread.
    :raises PsError: SESSION_* if the folder or file cannot be created.
    """

    def __init__(
        self, folder: Path, topics: Sequence[Topic], options: WriterOptions = WriterOptions(),
        provenance: Mapping[str, Mapping[str, str]] | None = None,
        on_error: Callable[[PsError], None] = lambda _: None,
    ) -> None:
        self.folder = folder
        self.error: PsError | None = None
        self.refused = 0
        self._options = options
        self._custom = dict((provenance or {}).get('session', {}))
        self._on_error = on_error
        self._bag = create_bag(folder, topics, options.compression)
        self._queue: deque[_Message | tuple[str, Mapping[str, str]]] = deque(
            (provenance or {}).items())
        self._queued_bytes = 0
        self._closing = False
        self._change = threading.Condition()
        self._thread = threading.Thread(
            target=self._run, name='ps_session_writer', daemon=True)
        self._thread.start()

    @property
    def counts(self) -> dict[str, int]:
        """Messages in the file, by topic."""
        return dict(self._bag.counts)

    @property
    def queued_bytes(self) -> int:
        """Bytes waiting for the disk."""
        return self._queued_bytes

    def write(self, topic: str, data: bytes, log_time: int, publish_time: int,
              on_written: Callable[[], None] | None = None) -> bool:
        """Queue one serialized message (CDR); times in ns since 1970.

        :param on_written: makes the message urgent: it is flushed at once, and this is called
            from the writer's thread when it is in the file for good.
        :returns: whether it was taken.
        """
        with self._change:
            full = self._queued_bytes + len(data) > self._options.queue_bytes
            if self._closing or self.error is not None or (full and self._queued_bytes):
                self.refused += 1
                return False
            self._queued_bytes += len(data)
            self._queue.append(_Message(topic, data, log_time, publish_time, on_written))
            self._change.notify()
        return True

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Queue a named group of texts (provenance that was not known at the start)."""
        with self._change:
            self._queue.append((name, values))
            self._change.notify()

    def close(self) -> None:
        """Write what is queued, complete the bag, wait for both. Safe to call again."""
        with self._change:
            self._closing = True
            self._change.notify()
        self._thread.join()

    # ------------------------------------------------------------------ the writer's thread

    def _run(self) -> None:
        try:
            try:
                self._write_until_closed()
            except PsError as error:
                if error.code != ErrorCode.SESSION_DISK_FULL:
                    raise
                self._fail(error)       # noticed in time: the bag can still be completed
            self._bag.finish(self._custom)
        except OSError as error:
            self._bag.abandon()
            self._fail(error_of(error, self._bag.path))
        except PsError as error:
            self._bag.abandon()
            self._fail(error)
        except Exception as error:
            self._bag.abandon()
            self._fail(PsError(ErrorCode.SESSION_INTERNAL, f'{type(error).__name__}: {error}'))

    def _fail(self, error: PsError) -> None:
        with self._change:
            if self.error is not None:
                return
            self.error = error
            self._queue.clear()
            self._queued_bytes = 0
        self._on_error(error)

    def _write_until_closed(self) -> None:
        flush_due = float('inf')
        while True:
            with self._change:
                wait = flush_due - time.monotonic()
                if not self._queue and not self._closing and wait > 0:
                    self._change.wait(min(wait, 3600.0))
                item = self._queue.popleft() if self._queue else None
                if item is None and self._closing:
                    return
            if isinstance(item, _Message):
                self._write(self._bag, item)
                with self._change:
                    self._queued_bytes = max(0, self._queued_bytes - len(item.data))
                if item.on_written is None:
                    flush_due = min(
                        flush_due, time.monotonic() + self._options.flush_period)
                else:
                    flush_due = float('inf')
            elif item is not None:
                self._bag.add_metadata(*item)
                flush_due = min(flush_due, time.monotonic() + self._options.flush_period)
            if time.monotonic() >= flush_due:
                self._check_space(0)
                self._bag.flush()
                flush_due = float('inf')

    def _write(self, bag: BagFile, message: _Message) -> None:
        if message.on_written is not None:
            self._check_space(len(message.data))
        bag.write(message.topic, message.data, message.log_time, message.publish_time)
        if message.on_written is not None:
            bag.flush(self._options.sync)
            try:
                message.on_written()
            except Exception as error:      # no fault of the disk
                raise PsError(ErrorCode.SESSION_INTERNAL, 'acknowledging a message: '
                              f'{type(error).__name__}: {error}') from error

    def _check_space(self, size: int) -> None:
        left = self._bag.free_bytes() - size
        if left < self._options.min_free_bytes:
            raise PsError(
                ErrorCode.SESSION_DISK_FULL,
                f'the disk of {self.folder} is nearly full ({max(left, 0) >> 20} MiB would be '
                f'left, the limit is {self._options.min_free_bytes >> 20} MiB); the session was '
                'ended and is complete up to here')
