"""Node that records sessions: services, subscriptions and diagnostics around SessionWriter."""
import contextlib
from dataclasses import replace
from datetime import datetime
from functools import partial
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
import os
from pathlib import Path
import platform
import threading
import time
from typing import Any

from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from std_msgs.msg import String

from ps_head_driver import ros_support
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.ros_support import Parameter
from ps_inspection.graph import NODES
from ps_inspection.session_writer import SessionWriter, WriterOptions
from ps_interfaces.msg import AcquisitionDone
from ps_interfaces.srv import StartSession, StopSession
from ps_reconstruction.session_format import (
    STACK_TYPE,
    TOPICS,
    Topic,
    check_name,
    message_definition,
    stack_id_of,
)

PARAMETERS = [
    Parameter('session_folder', '', 'Sessions are folders in this one; empty: the environment '
              'variable PS_SESSION_FOLDER, else ~/ps_sessions', read_only=True),
    Parameter('compression', 'none', 'Compression of the file',
              choices=('none', 'lz4', 'zstd')),
    Parameter('queue_bytes', 1 << 30, 'Limit of what waits for the disk; what does not fit is '
              'refused, counted and not acknowledged', unit='bytes', minimum=0, maximum=1 << 40),
    Parameter('flush_period', 0.5, 'Small messages are in the file after this time at the latest; '
              'a stack is at once', unit='s', minimum=0.01, maximum=60.0),
    Parameter('sync_to_disk', True, 'Acknowledge a stack only when it would survive a power '
              'failure; false: a crash of the process'),
    Parameter('min_free_bytes', 256 << 20, 'A session ends, complete, before less than this is '
              'left on the disk', unit='bytes', minimum=0, maximum=1 << 40),
    Parameter('stop_timeout', 5.0, 'Longest wait of session/stop for a stack whose acquisition '
              'has ended', unit='s', minimum=0.0, maximum=60.0),
]


class SessionRecorder(Node):
    """Records the cell's topics into one MCAP session at a time.

    Topics are subscribed to all the time, not from start to stop: discovery takes longer than the
    first capture of a session may.
    """

    def __init__(self) -> None:
        super().__init__('session_recorder')
        self.parameters = ros_support.Parameters(self, PARAMETERS, ErrorCode.SESSION_BAD_REQUEST)
        self._topics = [self._resolved(topic) for topic in TOPICS]
        self._stack_topic = next(t.name for t in self._topics if t.type == STACK_TYPE)
        self._latest: dict[str, tuple[bytes, int]] = {}
        self._writer: SessionWriter | None = None
        self._announced: set[str] = set()      # stacks whose acquisition has ended, not yet here
        self._change = threading.Condition()   # guards the three above

        # one group for all: messages are queued in the order they came
        arrivals = MutuallyExclusiveCallbackGroup()
        for topic in self._topics:
            self.create_subscription(
                _message_class(topic.type), topic.name, partial(self._on_message, topic),
                QoSProfile(
                    depth=topic.depth, reliability=ReliabilityPolicy.RELIABLE,
                    durability=DurabilityPolicy.TRANSIENT_LOCAL if topic.latched
                    else DurabilityPolicy.VOLATILE),
                raw=True, callback_group=arrivals)
        self._active = self.create_publisher(String, 'session/active', ros_support.LATCHED)
        self._recorded = self.create_publisher(
            String, 'session/recorded',
            QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE))
        self._active.publish(String(data=''))
        services = MutuallyExclusiveCallbackGroup()
        self.create_service(
            StartSession, 'session/start', self._on_start, callback_group=services)
        self.create_service(StopSession, 'session/stop', self._on_stop, callback_group=services)
        self._parameter_clients = {
            node.executable: tuple(
                self.create_client(kind, f'{node.executable}/{name}',
                                   callback_group=ReentrantCallbackGroup())
                for kind, name in ((ListParameters, 'list_parameters'),
                                   (GetParameters, 'get_parameters')))
            for node in NODES if node.executable != self.get_name()}
        ros_support.Diagnostics(self, {'Session': self._diagnose})

    def close(self) -> None:
        """End a running session cleanly."""
        if self._writer is not None:
            self._writer.close()

    # ------------------------------------------------------------------ messages

    def _resolved(self, topic: Topic) -> Topic:
        definition, type_hash = message_definition(topic.type)
        return replace(topic, name=self.resolve_topic_name(topic.name), definition=definition,
                       type_hash=type_hash)

    def _on_message(self, topic: Topic, data: bytes, info: dict[str, int]) -> None:
        sent = info['source_timestamp'] or time.time_ns()
        with self._change:
            if topic.latched:
                self._latest[topic.name] = (data, sent)
            if self._writer is None:
                return
            on_written = None
            if topic.name == self._stack_topic:
                stack_id = stack_id_of(data)
                on_written = partial(self._acknowledge, stack_id)
                self._announced.discard(stack_id)
                self._change.notify_all()
            elif topic.type == 'ps_interfaces/msg/AcquisitionDone':
                done = deserialize_message(data, AcquisitionDone)
                if done.success:
                    self._announced.add(done.stack_id)
                else:
                    # its frames were refused after all: no stack will come
                    self._announced.discard(done.stack_id)
                    self._change.notify_all()
            taken = self._writer.write(topic.name, data, time.time_ns(), sent, on_written)
        if not taken and on_written is not None and self._writer.error is None:
            self.get_logger().error(
                f'stack {stack_id} is not recorded: the disk is too slow, the queue is full')

    def _acknowledge(self, stack_id: str) -> None:
        # the writer's thread may still be at work while the context goes down
        with contextlib.suppress(Exception):
            self._recorded.publish(String(data=stack_id))

    # ------------------------------------------------------------------ services

    @ros_support.answers(ErrorCode.SESSION_INTERNAL)
    def _on_start(self, request: StartSession.Request, response: StartSession.Response) -> str:
        now = datetime.now().astimezone()
        name = check_name(request.name or f'session_{now:%Y%m%d_%H%M%S}')
        folder = self._session_folder() / name
        values = self.parameters
        with self._change:
            if self._writer is not None and self._writer.error is None:
                raise PsError(ErrorCode.SESSION_ALREADY_RECORDING,
                              f'session {self._writer.folder.name} is being recorded; '
                              'stop it first')
            writer = SessionWriter(
                folder, self._topics,
                WriterOptions(values['compression'], values['queue_bytes'],
                              values['flush_period'], values['sync_to_disk'],
                              values['min_free_bytes']),
                {'session': {
                    'session_id': name, 'part_id': request.part_id, 'notes': request.notes,
                    'created': now.isoformat(), 'software': f'ps_inspection {_version()}',
                    'system': platform.platform(), 'namespace': self.get_namespace(),
                }, f'parameters/{self.get_name()}': {k: str(v) for k, v in values.items()}},
                self._on_error)
            for topic, (data, sent) in self._latest.items():
                writer.write(topic, data, time.time_ns(), sent)
            self._announced.clear()
            self._writer = writer
        self._active.publish(String(data=name))
        self._record_parameters(writer)
        response.uri = str(folder)
        self.get_logger().info(f'recording {folder}')
        return f'recording {name}'

    @ros_support.answers(ErrorCode.SESSION_INTERNAL)
    def _on_stop(self, _request: StopSession.Request, response: StopSession.Response) -> str:
        with self._change:
            writer = self._writer
            if writer is None:
                raise PsError(ErrorCode.SESSION_NOT_RECORDING, 'no session is being recorded')
            self._active.publish(String(data=''))
            self._change.wait_for(lambda: not self._announced or writer.error is not None,
                                  self.parameters['stop_timeout'])
            missing = sorted(self._announced)
            self._writer = None
        writer.close()
        response.uri = str(writer.folder)
        response.messages = sum(writer.counts.values())
        response.stacks = writer.counts[self._stack_topic]
        if writer.error is not None:
            raise writer.error
        self.get_logger().info(f'{writer.folder}: {response.stacks} stacks')
        notes = []
        if writer.refused:
            notes.append(f'{writer.refused} messages were refused because the queue was full')
        if missing:
            notes.append(f'acquired but never received: {", ".join(missing)}')
        return '; '.join(notes)

    def _session_folder(self) -> Path:
        folder = (self.parameters['session_folder'] or os.environ.get('PS_SESSION_FOLDER')
                  or '~/ps_sessions')
        return Path(folder).expanduser().absolute()

    def _on_error(self, error: PsError) -> None:
        # called from the writer's thread
        with contextlib.suppress(Exception):
            self.get_logger().error(f'recording ended: {error.message}')
            self._active.publish(String(data=''))

    # ------------------------------------------------------------------ provenance

    def _record_parameters(self, writer: SessionWriter) -> None:
        """Ask every node for its parameters; an answer goes into the session when it comes."""
        for node, (listing, getting) in self._parameter_clients.items():
            if listing.service_is_ready() and getting.service_is_ready():
                listing.call_async(ListParameters.Request()).add_done_callback(
                    partial(self._on_names, writer, node, getting))

    def _on_names(self, writer: SessionWriter, node: str, getting: Any, future: Any) -> None:
        names = future.result().result.names
        getting.call_async(GetParameters.Request(names=names)).add_done_callback(
            lambda reply: writer.add_metadata(f'parameters/{node}', {
                name: str(parameter_value_to_python(value))
                for name, value in zip(names, reply.result().values, strict=True)}))

    # ------------------------------------------------------------------ diagnostics

    def _diagnose(self) -> ros_support.Report:
        writer = self._writer
        if writer is None:
            return ros_support.OK, 'not recording', {'folder': self._session_folder()}
        values = {
            'session': writer.folder, 'messages': sum(writer.counts.values()),
            'stacks': writer.counts[self._stack_topic], 'queued_bytes': writer.queued_bytes,
            'refused': writer.refused,
        }
        if writer.error is not None:
            return ros_support.ERROR, writer.error.message, values
        if writer.refused:
            return (ros_support.ERROR,
                    f'{writer.refused} messages refused, the disk is too slow', values)
        return ros_support.OK, f'recording {writer.folder.name}', values


def _message_class(message_type: str) -> Any:
    package, _, name = message_type.split('/')
    return getattr(import_module(f'{package}.msg'), name)


def _version() -> str:
    try:
        return version('ps_inspection')
    except PackageNotFoundError:
        return 'source tree'


def main() -> None:
    """Run the node."""
    ros_support.run_node(SessionRecorder)


if __name__ == '__main__':
    main()
