"""What every node needs and none should repeat: parameters, answers, diagnostics, a clean exit."""
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
import functools
import math
import sys
import threading
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
import rclpy
from rclpy.client import Client
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from ps_head_driver.errors import ErrorCode, PsError

RELIABLE = QoSProfile(depth=4, reliability=ReliabilityPolicy.RELIABLE)
LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)

# for topics with pictures: parameters qos_overrides.<topic>.<publisher|subscription>.<policy>
OVERRIDABLE = QoSOverridingOptions.with_default_policies()


# ---------------------------------------------------------------------------- parameters

@dataclass(frozen=True)
class Parameter:
    """One parameter of a node: the single place where default, unit and range are stated."""

    name: str
    default: Any
    description: str
    unit: str = ''
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple[Any, ...] = ()
    read_only: bool = False

    def descriptor(self) -> ParameterDescriptor:
        """ROS descriptor, with the range where there is one."""
        text = self.description + (f' [{self.unit}]' if self.unit else '')
        descriptor = ParameterDescriptor(description=text, read_only=self.read_only)
        if self.choices:
            descriptor.additional_constraints = 'one of ' + ', '.join(map(str, self.choices))
        if self.minimum is None and self.maximum is None:
            return descriptor
        if isinstance(self.default, float):
            descriptor.floating_point_range = [FloatingPointRange(
                from_value=-math.inf if self.minimum is None else float(self.minimum),
                to_value=math.inf if self.maximum is None else float(self.maximum))]
        else:
            descriptor.integer_range = [IntegerRange(
                from_value=-2**63 if self.minimum is None else int(self.minimum),
                to_value=2**63 - 1 if self.maximum is None else int(self.maximum), step=1)]
        return descriptor

    def check(self, value: Any) -> str:
        """Reason why a value is refused, or an empty string."""
        if isinstance(value, float) and not math.isfinite(value):
            return f'parameter {self.name}: {value} is not finite'
        if self.choices and value not in self.choices:
            allowed = ', '.join(map(str, self.choices))
            return f'parameter {self.name}: {value!r} is not one of {allowed}'
        too_low = self.minimum is not None and value < self.minimum
        too_high = self.maximum is not None and value > self.maximum
        if too_low or too_high:
            low = '-inf' if self.minimum is None else self.minimum
            high = 'inf' if self.maximum is None else self.maximum
            unit = f' {self.unit}' if self.unit else ''
            return f'parameter {self.name}: {value} is outside {low} to {high}{unit}'
        return ''


class Parameters(Mapping[str, Any]):
    """Declared parameters of a node, read as ``parameters['name']``.

    :param node: the node that declares them.
    :param table: what to declare.
    :param on_change: called with {name: new value} before a run-time change takes effect; may
        raise PsError to refuse it.
    :raises PsError: ``code`` if a start value from a file or the command line is refused.
    """

    def __init__(
        self, node: Node, table: Sequence[Parameter], code: ErrorCode,
        on_change: Callable[[dict[str, Any]], None] | None = None,
    ) -> None:
        self._node = node
        self._table = {parameter.name: parameter for parameter in table}
        self._on_change = on_change
        for parameter in table:
            try:
                value = node.declare_parameter(
                    parameter.name, parameter.default, parameter.descriptor()).value
            except ParameterException as error:
                raise PsError(
                    code, f'{node.get_name()}: parameter {parameter.name}: {error}') from error
            reason = parameter.check(value)
            if reason:
                raise PsError(code, f'{node.get_name()}: {reason}')
        node.add_on_set_parameters_callback(self._validate)

    def _validate(self, changes: list[Any]) -> SetParametersResult:
        for change in changes:
            known = self._table.get(change.name)
            reason = known.check(change.value) if known else ''
            if reason:
                return SetParametersResult(successful=False, reason=reason)
        ours = {c.name: c.value for c in changes if c.name in self._table}
        if ours and self._on_change is not None:
            try:
                self._on_change(ours)
            except PsError as error:
                return SetParametersResult(successful=False, reason=error.message)
        return SetParametersResult(successful=True)

    def __getitem__(self, name: str) -> Any:
        if name not in self._table:
            raise KeyError(name)
        return self._node.get_parameter(name).value

    def __iter__(self) -> Any:
        return iter(self._table)

    def __len__(self) -> int:
        return len(self._table)


# ---------------------------------------------------------------------------- answers

def fill_error(response: Any, error: PsError) -> None:
    """Write an error into a service response or action result (std_srvs/Trigger has no code)."""
    response.success = False
    if hasattr(response, 'error_code'):
        response.error_code = int(error.code)
        response.message = error.message
    else:
        response.message = f'{error.code.name}: {error.message}'


def as_ps_error(node: Node, error: Exception, internal: ErrorCode) -> PsError:
    """Turn any exception into an answerable error; a bug is logged with its traceback."""
    if isinstance(error, PsError):
        return error
    import traceback
    node.get_logger().error(''.join(traceback.format_exception(error)))
    return PsError(internal, f'internal error, please report it: {type(error).__name__}: {error}')


def answers(internal: ErrorCode) -> Callable:
    """Decorate a service callback method: it returns a message or None, or raises; the answer is
    always filled.

    :param internal: code for an exception that is not a PsError.
    """
    def decorate(callback: Callable) -> Callable:
        @functools.wraps(callback)
        def handler(self: Any, request: Any, response: Any) -> Any:
            node = self if isinstance(self, Node) else self.node
            try:
                message = callback(self, request, response)
            except Exception as error:
                known = as_ps_error(node, error, internal)
                node.get_logger().warning(f'{callback.__name__.strip("_")}: {known.message}')
                fill_error(response, known)
            else:
                response.success = True
                response.message = message or 'ok'
            return response
        return handler
    return decorate


def call(client: Client, request: Any, timeout: float, code: ErrorCode) -> Any:
    """Call a service and wait, from a callback of another callback group.

    :raises PsError: ``code`` if the server is not there or does not answer within ``timeout``
        seconds.
    """
    if not client.wait_for_service(timeout_sec=min(timeout, 10.0)):
        raise PsError(code, f'service {client.srv_name} is not there; is its node running?')
    response = client.call(request, timeout_sec=timeout)
    if response is None:
        raise PsError(code, f'service {client.srv_name} did not answer within {timeout:g} s')
    return response


def wait_for_future(future: Any, timeout: float) -> Any:
    """Result of an rclpy future that another thread spins for; None after ``timeout`` seconds."""
    done = threading.Event()
    future.add_done_callback(lambda _: done.set())
    return future.result() if done.wait(timeout) else None


# ---------------------------------------------------------------------------- diagnostics

OK, WARN, ERROR, STALE = (
    DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR, DiagnosticStatus.STALE)

Report = tuple[bytes, str, dict[str, Any]]


class Diagnostics:
    """Publishes /diagnostics once a second (REP 107), one status per task.

    A task returns (level, message, values); one that raises is reported as ERROR.
    """

    def __init__(self, node: Node, tasks: Mapping[str, Callable[[], Report]],
                 hardware_id: Callable[[], str] = lambda: '', period: float = 1.0) -> None:
        self._node, self._tasks, self._hardware_id = node, tasks, hardware_id
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', RELIABLE)
        node.create_timer(period, self.publish)

    def publish(self) -> None:
        """Send the present state now."""
        message = DiagnosticArray()
        message.header.stamp = self._node.get_clock().now().to_msg()
        prefix = self._node.get_fully_qualified_name().lstrip('/')
        for name, task in self._tasks.items():
            try:
                level, text, values = task()
            except Exception as error:
                level, text, values = ERROR, f'{type(error).__name__}: {error}', {}
            message.status.append(DiagnosticStatus(
                level=level, name=f'{prefix}: {name}', message=text,
                hardware_id=self._hardware_id(),
                values=[KeyValue(key=str(k), value=str(v)) for k, v in values.items()]))
        self._publisher.publish(message)


# ---------------------------------------------------------------------------- life of a process

def run_node(factory: Callable[[], Node], threads: int = 6) -> None:
    """Run one node until SIGINT or SIGTERM and leave with exit code 0; 1 with one clear line if it
    cannot start.

    A node may have ``close()``: called after spinning has ended, before it is destroyed.
    """
    rclpy.init()
    node: Node | None = None
    executor = MultiThreadedExecutor(num_threads=threads)
    status = 0
    try:
        node = factory()
        executor.add_node(node)
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except PsError as error:
        print(f'{error.code.name}: {error.message}', file=sys.stderr, flush=True)
        status = 1
    except Exception:
        # a signal during construction makes rcl calls fail: that is an exit, not an error
        if rclpy.ok():
            raise
    finally:
        if node is not None and hasattr(node, 'close'):
            node.close()
        executor.shutdown(timeout_sec=2.0)
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
        for thread in threading.enumerate():
            if thread.name.startswith('ps_') and not thread.daemon:
                thread.join(timeout=2.0)
    if status:
        sys.exit(status)
