"""Runs the nodes of a cell as processes, where ROS launch does not exist.

What is started comes from graph.py, as with the launch files.
"""
from collections.abc import Callable, Mapping, Sequence
import contextlib
import ctypes
from dataclasses import dataclass, field
import os
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
import time
from types import TracebackType

from rcl_interfaces.srv import GetParameters
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.task import Future
import yaml

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.graph import HEAD_DRIVER, NodeSpec, NodeStart, resolve
from ps_head_driver.ros_support import LATCHED
from ps_inspection.environment import cell_environment
from ps_inspection.graph import NODES
from ps_interfaces.msg import HeadStatus

_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None, use_errno=True)
_LOG_LINES = 8


class CellError(PsError):
    """A node died or did not get ready; the message names it and ends with its last words."""

    def __init__(self, message: str) -> None:
        super().__init__(ErrorCode.INSPECTION_INTERNAL, message)


@dataclass
class NodeProcess:
    """One node of a running cell.

    :param ready_s: s from the start of the cell until it answered; None: not yet.
    """

    start: NodeStart
    process: subprocess.Popen
    log: Path
    ready_s: float | None = None

    @property
    def name(self) -> str:
        """Name of the node."""
        return self.start.executable

    def last_words(self) -> str:
        """Last lines of the log."""
        with self.log.open('rb') as stream:
            stream.seek(max(0, self.log.stat().st_size - 4096))
            lines = stream.read().decode('utf-8', 'replace').splitlines()
        return '\n'.join(f'  {line}' for line in lines[-_LOG_LINES:] if line.strip())


@dataclass
class Cell:
    """The processes of a cell; ``start`` and ``stop``, or a context manager.

    :param arguments: as of the launch file, name to text; see ps_inspection.graph.
    :param nodes: what to run; the default is the whole cell.
    :param log_folder: one file a node; the default is a new temporary folder.
    :param ready_timeout: s for all nodes together.
    :param grace: s from SIGINT to SIGKILL.
    :param environment: variables besides those of this process and of cell_environment().
    :param on_ready: called when a node is ready.
    :raises ValueError: wrong arguments.
    """

    arguments: Mapping[str, str] = field(default_factory=dict)
    nodes: Sequence[NodeSpec] = NODES
    log_folder: Path | None = None
    ready_timeout: float = 60.0
    grace: float = 10.0
    environment: Mapping[str, str] = field(default_factory=dict)
    on_ready: Callable[[NodeProcess], None] = lambda _: None

    def __post_init__(self) -> None:
        self._starts = resolve(self.nodes, self.arguments)
        self.processes: list[NodeProcess] = []
        self.head_status: HeadStatus | None = None

    def __enter__(self) -> 'Cell':
        self.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 traceback: TracebackType | None) -> None:
        self.stop()

    def start(self) -> None:
        """Start all nodes and return when all are ready.

        :raises CellError: if one dies or is not ready in time; all are stopped then.
        """
        folder = self.log_folder or Path(tempfile.mkdtemp(prefix='ps_cell_'))
        self.log_folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        environment = self._node_environment()
        self._started = time.monotonic()
        try:
            for start in self._starts:
                self.processes.append(_spawn(start, folder, environment))
            self._wait_until_ready()
        except BaseException:
            self.stop()
            raise

    def restart(self, name: str) -> None:
        """Start one node again, stopping it first if it runs, and return when it is ready.

        :raises CellError: as of start; the other nodes keep running.
        """
        node = next(node for node in self.processes if node.name == name)
        _stop([node], self.grace)
        if name == HEAD_DRIVER.executable:
            self.head_status = None      # what the old one said last
        assert self.log_folder is not None
        self._started = time.monotonic()
        self.processes[self.processes.index(node)] = _spawn(
            node.start, self.log_folder, self._node_environment())
        self._wait_until_ready()

    def _node_environment(self) -> dict[str, str]:
        return {**os.environ, **cell_environment(), **self.environment}

    def check(self) -> None:
        """Raise CellError if a node has died."""
        for node in self.processes:
            status = node.process.poll()
            if status is not None:
                how = f'killed by {signal.Signals(-status).name}' if status < 0 else (
                    f'ended with exit code {status}')
                raise CellError(f'{node.name} {how}; log: {node.log}\n{node.last_words()}')

    def stop(self) -> list[str]:
        """Stop all nodes, the head last: whoever is using it can still switch its panels off.

        :returns: names of the nodes that had to be killed or ended with an error.
        """
        others = [n for n in self.processes if n.name != HEAD_DRIVER.executable]
        head = [n for n in self.processes if n.name == HEAD_DRIVER.executable]
        killed = [*_stop(others, self.grace), *_stop(head, self.grace)]
        self.processes = []
        return killed

    def _wait_until_ready(self) -> None:
        """A node is ready when it answers; the head also when it has said its state."""
        deadline = self._started + self.ready_timeout
        namespace = self._starts[0].namespace if self._starts else ''
        context = Context()
        # args: not those of this process, which rcl would take for remapping rules
        context.init(args=[], domain_id=_domain_id(self.environment))
        executor = SingleThreadedExecutor(context=context)
        monitor = Node(f'ps_cell_{os.getpid()}', namespace=namespace, context=context,
                       enable_rosout=False, start_parameter_services=False)
        executor.add_node(monitor)
        try:
            monitor.create_subscription(HeadStatus, 'head_status', self._on_status, LATCHED)
            probes = {node.name: _Probe(monitor, node.name) for node in self.processes}
            while waiting := [node for node in self.processes if node.ready_s is None]:
                executor.spin_once(timeout_sec=0.05)
                self.check()
                for node in waiting:
                    if probes[node.name].answered() and self._head_has_reported(node):
                        node.ready_s = time.monotonic() - self._started
                        self.on_ready(node)
                if time.monotonic() > deadline:
                    node = waiting[0]
                    raise CellError(f'{node.name} is not ready after {self.ready_timeout:g} s; '
                                    f'log: {node.log}\n{node.last_words()}')
        finally:
            executor.shutdown()
            monitor.destroy_node()
            context.try_shutdown()

    def _on_status(self, message: HeadStatus) -> None:
        self.head_status = message

    def _head_has_reported(self, node: NodeProcess) -> bool:
        if node.name != HEAD_DRIVER.executable:
            return True
        status = self.head_status
        # a real head may be unplugged: the driver keeps trying, and the cell is up without it
        must_connect = node.start.parameters.get('fake_hardware', False)
        return status is not None and not (
            must_connect and status.state == HeadStatus.DISCONNECTED)


class _Probe:
    """Asks one node for nothing until it answers: then its executor is spinning."""

    RETRY_S = 1.0     # a reply can be lost right after discovery

    def __init__(self, monitor: Node, name: str) -> None:
        self._client = monitor.create_client(GetParameters, f'{name}/get_parameters')
        self._future: Future | None = None
        self._asked = 0.0

    def answered(self) -> bool:
        if self._future is not None and self._future.done():
            return True
        now = time.monotonic()
        if now - self._asked > self.RETRY_S and self._client.service_is_ready():
            self._asked = now
            self._future = self._client.call_async(GetParameters.Request())
        return False


def _domain_id(environment: Mapping[str, str]) -> int | None:
    text = environment.get('ROS_DOMAIN_ID', '')
    return int(text) if text else None


def _spawn(start: NodeStart, folder: Path, environment: Mapping[str, str]) -> NodeProcess:
    files = list(start.parameter_files)
    if start.parameters:
        # a file keeps the types; "-p name:=value" would read a text like 'on' as YAML
        own = folder / f'{start.executable}.parameters.yaml'
        own.write_text(yaml.safe_dump({'/**': {'ros__parameters': start.parameters}}))
        files.append(own)
    command = [
        sys.executable, '-m', f'{start.package}.nodes.{start.executable}', '--ros-args',
        '-r', f'__ns:=/{start.namespace}', '--enclave', start.enclave,
        *(word for file in files for word in ('--params-file', str(file)))]
    log = folder / f'{start.executable}.log'
    parent = os.getpid()

    def die_with_parent() -> None:
        # SIGTERM, not SIGKILL: panels off, session closed, even if the runner is killed
        _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.getppid() != parent:
            os._exit(1)

    with log.open('wb') as stream:
        process = subprocess.Popen(
            command, env=dict(environment), stdin=subprocess.DEVNULL, stdout=stream,
            stderr=subprocess.STDOUT, start_new_session=True, preexec_fn=die_with_parent)
    return NodeProcess(start, process, log)


def _stop(nodes: Sequence[NodeProcess], grace: float) -> list[str]:
    for node in nodes:
        if node.process.poll() is None:
            node.process.send_signal(signal.SIGINT)
    deadline = time.monotonic() + grace
    killed = []
    for node in nodes:
        try:
            node.process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            killed.append(node.name)
        # its group: helpers that a node left behind must not outlive the cell
        with contextlib.suppress(ProcessLookupError):
            os.killpg(node.process.pid, signal.SIGKILL)
        if node.process.wait() not in (0, -signal.SIGKILL) and node.name not in killed:
            killed.append(node.name)
    return killed
