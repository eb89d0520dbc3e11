"""A client of a running cell: the public interfaces as plain blocking calls.

For robot programs, the demo and tests. Everything goes through topics, services and actions, as
anybody else would use them.
"""
from collections.abc import Callable, Iterable
from contextlib import suppress
import threading
import time
from types import TracebackType
from typing import Any

from rclpy.client import Client
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger

from ps_head_driver import ros_support
from ps_head_driver.action_client import ActionClient
from ps_head_driver.errors import ErrorCode, PsError
from ps_inspection.running_goal import RunningGoal
from ps_interfaces import msg as ps
from ps_interfaces import srv
from ps_reconstruction.conversions import IMAGE_TOPICS

KEPT = 4     # stacks and images of each output; 50 MB of images come with every capture


class CellClient:
    """Blocking access to a cell; use it as a context manager.

    :param namespace: of the cell.
    :param outputs: keys of IMAGE_TOPICS to receive; the reconstruction computes only what
        somebody receives. The newest few stacks and images are kept.
    """

    def __init__(self, namespace: str = 'ps_head', outputs: Iterable[str] = ()) -> None:
        self._context = Context()
        self._context.init()
        self.node = Node('cell_client', namespace=namespace, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._changed = threading.Condition()
        # Made once and kept: a client that is destroyed just when the other thread begins to wait
        # for answers ends that thread (rclpy 7.1), and a new one must be discovered first.
        self._asking = threading.Lock()
        self._services: dict[str, Client] = {}
        self._actions: dict[str, ActionClient] = {}
        self.status: ps.HeadStatus | None = None
        self.stacks: dict[str, tuple[ps.PhotometricStack, float]] = {}
        self.done: dict[str, tuple[ps.AcquisitionDone, float]] = {}
        self.info: dict[str, tuple[ps.ReconstructionInfo, float]] = {}
        # output -> stamp of the stack -> (message, time of arrival)
        self.images: dict[str, dict[tuple[int, int], tuple[Image, float]]] = {}

        reliable, latched = ros_support.RELIABLE, ros_support.LATCHED
        subscribe = self.node.create_subscription
        subscribe(ps.HeadStatus, 'head_status', self._on_status, latched)
        subscribe(ps.PhotometricStack, 'stack', self._keeper(self.stacks), reliable)
        subscribe(ps.AcquisitionDone, 'acquisition_done', self._keeper(self.done), reliable)
        subscribe(ps.ReconstructionInfo, 'reconstruction_info', self._keeper(self.info), latched)
        for output in outputs:
            self.images[output] = {}
            subscribe(Image, IMAGE_TOPICS[output], self._image_keeper(output), reliable)
        self._thread = threading.Thread(target=self._spin, name='ps_cell_client', daemon=True)
        self._thread.start()

    # ------------------------------------------------------------------ receiving

    def _spin(self) -> None:
        with suppress(ExternalShutdownException):
            self._executor.spin()

    def _on_status(self, message: ps.HeadStatus) -> None:
        with self._changed:
            self.status = message
            self._changed.notify_all()

    def _keeper(self, store: dict) -> Any:
        def keep(message: Any) -> None:
            with self._changed:
                store[message.stack_id] = (message, time.monotonic())
                _forget_old(store)
                self._changed.notify_all()
        return keep

    def _image_keeper(self, output: str) -> Any:
        def keep(message: Image) -> None:
            with self._changed:
                stamp = message.header.stamp
                self.images[output][stamp.sec, stamp.nanosec] = (message, time.monotonic())
                _forget_old(self.images[output])
                self._changed.notify_all()
        return keep

    def wait(self, condition: Any, timeout: float, what: str) -> Any:
        """Wait until ``condition()`` gives something true and return it.

        :raises PsError: RECONSTRUCTION_TIMEOUT saying what was waited for.
        """
        with self._changed:
            found = self._changed.wait_for(condition, timeout)
        if not found:
            raise PsError(ErrorCode.RECONSTRUCTION_TIMEOUT, f'no {what} within {timeout:g} s')
        return found

    def wait_for_outputs(self, timeout: float = 20.0) -> None:
        """Wait until the reconstruction knows that the output images are wanted.

        Images are lazy: one that is published before publisher and subscriber have found each
        other is not computed.

        :raises PsError: RECONSTRUCTION_TIMEOUT.
        """
        deadline = time.monotonic() + timeout
        while not all(self.node.count_publishers(IMAGE_TOPICS[name]) for name in self.images):
            if time.monotonic() > deadline:
                raise PsError(ErrorCode.RECONSTRUCTION_TIMEOUT,
                              f'nobody publishes the output images after {timeout:g} s; is the '
                              'reconstruction node running?')
            time.sleep(0.05)
        # the publisher finds its subscribers at the same time, give or take a message
        time.sleep(0.3)

    # ------------------------------------------------------------------ asking

    def call(self, kind: Any, name: str, request: Any = None, timeout: float = 30.0) -> Any:
        """Call a service of the cell.

        :returns: the response.
        :raises PsError: the code and message of an answer without success, or that nobody
            answered.
        """
        with self._asking:
            if name not in self._services:
                self._services[name] = self.node.create_client(kind, name)
        response = ros_support.call(self._services[name], request or kind.Request(), timeout,
                                    ErrorCode.SEQUENCER_HEAD_UNAVAILABLE)
        if not response.success:
            raise _error_of(response)
        return response

    def send(self, kind: Any, name: str, goal: Any,
             on_feedback: Callable[[Any], None] = lambda _: None) -> RunningGoal:
        """Send a goal to an action of the cell; see RunningGoal for what to do with it."""
        with self._asking:
            if name not in self._actions:
                self._actions[name] = ActionClient(self.node, kind, name)
        return RunningGoal(self._actions[name], name, goal, on_feedback)

    def home(self) -> None:
        """Home the motor and wait until the head is ready."""
        try:
            self.call(Trigger, 'head_driver/home', timeout=60.0)
        except PsError as error:
            # the driver homes by itself when it connects: that is as good
            if error.code is not ErrorCode.HEAD_BUSY:
                raise
        self.wait_until_ready(60.0)

    def wait_until_ready(self, timeout: float) -> None:
        """Wait until the head is homed and idle.

        :raises PsError: RECONSTRUCTION_TIMEOUT.
        """
        self.wait(lambda: self.status is not None and self.status.homed
                  and self.status.state == ps.HeadStatus.READY, timeout, 'READY in head_status')

    def solve(self, convergence_radius: float) -> srv.SolveConvergenceRadius.Response:
        """Ask which motor position gives a convergence radius (m)."""
        kind = srv.SolveConvergenceRadius
        return self.call(kind, 'solve_convergence_radius', kind.Request(
            mode=kind.Request.INVERSE, convergence_radius=convergence_radius))

    def illuminate(self, convergence_radius: float) -> srv.SetIllumination.Response:
        """Move the panels to a convergence radius (m)."""
        kind = srv.SetIllumination
        return self.call(kind, 'set_illumination', kind.Request(
            by=kind.Request.BY_CONVERGENCE_RADIUS, convergence_radius=convergence_radius))

    def capture(self, recipe: str = '', part_id: str = '', timeout: float = 120.0) -> str:
        """Take one stack; returns its id."""
        return self.call(srv.Capture, 'capture', srv.Capture.Request(
            recipe=recipe, part_id=part_id), timeout).stack_id

    def stack(self, stack_id: str, timeout: float = 30.0) -> ps.PhotometricStack:
        """The published stack."""
        return self.wait(lambda: self.stacks.get(stack_id), timeout, f'stack {stack_id}')[0]

    def reconstruction(
        self, stack_id: str, timeout: float = 120.0,
    ) -> tuple[ps.ReconstructionInfo, dict[str, Image]]:
        """Info and the subscribed output images of a stack.

        :raises PsError: the error of a reconstruction that failed.
        """
        info = self.wait(lambda: self.info.get(stack_id), timeout,
                         f'reconstruction of {stack_id}')[0]
        if not info.success:
            raise PsError(info.error_code, info.message)
        stamp = (info.header.stamp.sec, info.header.stamp.nanosec)
        self.wait(lambda: all(stamp in images for images in self.images.values()), timeout,
                  f'output images of {stack_id}')
        return info, {name: images[stamp][0] for name, images in self.images.items()}

    # ------------------------------------------------------------------ life

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown(timeout_sec=2.0)
        self._thread.join(timeout=2.0)
        self.node.destroy_node()
        self._context.try_shutdown()

    def __enter__(self) -> 'CellClient':
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self.close()


def _forget_old(store: dict) -> None:
    """Keep the newest, so that a robot program does not grow with every part."""
    while len(store) > KEPT:
        del store[next(iter(store))]


def _error_of(response: Any) -> PsError:
    """Error of an answer; std_srvs/Trigger has no code, so its message begins with the name."""
    if hasattr(response, 'error_code'):
        return PsError(response.error_code, response.message)
    name, _, message = response.message.partition(': ')
    code = ErrorCode.__members__.get(name)
    return PsError(code, message) if code is not None else PsError(
        ErrorCode.HEAD_FAULT, response.message)
