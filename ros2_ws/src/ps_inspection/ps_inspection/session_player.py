"""Playing a session into a running graph, where ros2 bag does not exist."""
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
import time

from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from ps_head_driver.errors import ErrorCode, PsError
from ps_reconstruction import cdr
from ps_reconstruction.session_format import TOPICS, Topic
from ps_reconstruction.session_reader import Message, Scan, Session

# s without a new reader after which all are taken to be there: some periods of the announcements
# in fastdds.xml; also what a reader needs that was found and has not found the player yet
SETTLED = 1.5
# what live nodes would say about the played stacks themselves
DERIVED = ('ps_interfaces/msg/ReconstructionInfo', 'diagnostic_msgs/msg/DiagnosticArray')


@dataclass(frozen=True)
class PlayOptions:
    """How to play.

    :param rate: 2 plays twice as fast.
    :param start: s from the beginning; the last latched message before it is still sent.
    :param loop: begin again at the end, until interrupted.
    :param everything: also what live nodes derive from the stacks.
    :param namespace: in place of the recorded one; empty: as recorded.
    :param wait: s at most that the topics are given to find their readers.
    """

    rate: float = 1.0
    start: float = 0.0
    loop: bool = False
    everything: bool = False
    namespace: str = ''
    wait: float = 8.0


class Player:
    """Publishes the messages of a session in their recorded rhythm.

    :param paused: asked often; playing stands still while it is true.
    :param on_message: called for every message sent.

    ``problems`` has the damage found in the last round.
    """

    def __init__(self, node: Node, session: Session, options: PlayOptions,
                 paused: Callable[[], bool] = lambda: False,
                 on_message: Callable[[Message], None] = lambda _: None) -> None:
        self._node, self._session, self._options = node, session, options
        self._paused, self._on_message = paused, on_message
        self.problems: list[str] = []
        self._publishers: dict[str, Publisher] = {}
        self._known = {topic.type for topic in TOPICS} - (
            set() if options.everything else set(DERIVED))

    def play(self) -> int:
        """Play to the end, or for ever with ``loop``.

        :returns: messages sent.
        :raises PsError: SESSION_NOT_A_SESSION if the session has nothing that can be played.
        """
        sent = 0
        while True:
            scan = Scan()
            clock: _Clock | None = None
            before = sent
            for message in self._due(scan):
                try:
                    cdr.check(message.data, message.topic.type)
                except ValueError as error:     # would cost every reader its memory
                    scan.note(f'{message.topic.name}: a message is left out: {error}')
                    continue
                self._advertise([message.topic, *scan.topics], scan)
                clock = clock or _Clock(message.log_time, self._options.rate)
                self._sleep_until(clock, message.log_time)
                self._publishers[message.topic.name].publish(message.data)
                self._on_message(message)
                sent += 1
            self.problems = scan.problems
            if sent == before:
                raise PsError(ErrorCode.SESSION_NOT_A_SESSION,
                              f'{self._session.file} has nothing to play from '
                              f'{self._options.start:g} s on')
            if not self._options.loop:
                break
        for publisher in self._publishers.values():
            if publisher.get_subscription_count():
                publisher.wait_for_all_acked()
        return sent

    def _due(self, scan: Scan) -> Iterator[Message]:
        """Messages from ``start`` on, the latched state before it first."""
        begin: int | None = None
        state: dict[str, Message] = {}
        for message in self._session.messages(scan):
            if message.topic.type not in self._known:
                continue
            begin = message.log_time if begin is None else begin
            # in whole ns: as a float, the first message may lie before its own time
            if message.log_time < begin + round(self._options.start * 1e9):
                if message.topic.latched:
                    state[message.topic.name] = message
                continue
            for latched in state.values():
                # sent now: its own time is over
                yield replace(latched, log_time=message.log_time)
            state = {}
            yield message

    def _advertise(self, topics: Sequence[Topic], scan: Scan) -> None:
        """Make the publishers that are missing, and give their readers time to find them."""
        missing = {topic.name: topic for topic in topics
                   if topic.type in self._known and topic.name not in self._publishers}
        for topic in missing.values():
            self._session.check_definition(topic)
            package, _, name = topic.type.split('/')
            try:
                self._publishers[topic.name] = self._node.create_publisher(
                    getattr(import_module(f'{package}.msg'), name),
                    self._renamed(topic.name, scan),
                    QoSProfile(
                        depth=topic.depth, reliability=ReliabilityPolicy.RELIABLE,
                        durability=DurabilityPolicy.TRANSIENT_LOCAL if topic.latched
                        else DurabilityPolicy.VOLATILE))
            except (InvalidTopicNameException, ValueError) as error:
                raise PsError(ErrorCode.SESSION_BAD_REQUEST,
                              f'topic {topic.name!r} cannot be played: {error}') from error
        if missing:
            self._wait_for_readers([self._publishers[name] for name in missing])

    def _wait_for_readers(self, publishers: Sequence[Publisher]) -> None:
        """Until their number stands still; the first to be found is not the last."""
        deadline = time.monotonic() + self._options.wait
        found, since = 0, time.monotonic()
        while (now := time.monotonic()) < deadline:
            count = sum(publisher.get_subscription_count() for publisher in publishers)
            if count != found:
                found, since = count, now
            if found and now - since > SETTLED:
                return
            time.sleep(0.02)

    def _renamed(self, name: str, scan: Scan) -> str:
        recorded = scan.metadata.get('session', {}).get('namespace', '').rstrip('/') + '/'
        if not self._options.namespace or not name.startswith(recorded):
            return name
        return f'/{self._options.namespace.strip("/")}/{name[len(recorded):]}'

    def _sleep_until(self, clock: '_Clock', log_time: int) -> None:
        while True:
            if self._paused():
                begin = time.monotonic()
                time.sleep(0.05)
                clock.shift(time.monotonic() - begin)
                continue
            left = clock.left(log_time)
            if left <= 0:
                return
            time.sleep(min(left, 0.05))


class _Clock:
    """Recorded time to time now."""

    def __init__(self, first: int, rate: float) -> None:
        self._first, self._rate, self._begin = first, rate, time.monotonic()

    def shift(self, seconds: float) -> None:
        self._begin += seconds

    def left(self, log_time: int) -> float:
        """Seconds until a message is due."""
        due = self._begin + (log_time - self._first) * 1e-9 / self._rate
        return due - time.monotonic()
