"""Node inspection: one call per part, and the search for the best illumination."""
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
import os
from pathlib import Path
import threading
import time
from typing import Any

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.node import Node
from std_msgs.msg import String

from ps_head_driver import ros_support
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.paths import confined
from ps_head_driver.ros_support import Parameter
from ps_head_driver.stack import Mode
from ps_head_driver.stack_source import StackSource
from ps_inspection.illumination_score import Region
from ps_inspection.illumination_search import IlluminationSearch
from ps_inspection.inspection_request import check_request
from ps_inspection.nodes.illumination_prober import IlluminationProber, Request, ring_steps
from ps_inspection.nodes.output_images import OutputImages
from ps_inspection.reconstruction_watch import ReconstructionWatch
from ps_inspection.stack_pipeline import StackPipeline
from ps_interfaces import msg as ps
from ps_interfaces.action import AcquireStack, Inspect, SearchIllumination
from ps_interfaces.srv import LastInspection
from ps_reconstruction.result_files import write_quantities

PARAMETERS = [
    Parameter('output_folder', '', 'Files of inspections are in it, a folder for each stack; '
              'empty: the environment variable PS_OUTPUT_FOLDER, else ~/ps_inspections',
              read_only=True),
    Parameter('session_folder', '', 'As of session_recorder: where the sessions named in results '
              'are', read_only=True),
    Parameter('capture_timeout', 60.0, 'Longest capture, moves included', 's', 1.0, 600.0),
    Parameter('reconstruction_timeout', 60.0, 'Longest wait for the reconstruction of a stack, '
              'those before it included', 's', 1.0, 600.0),
    Parameter('output_timeout', 10.0, 'Longest wait for an output image after its reconstruction',
              's', 0.1, 120.0),
    Parameter('record_timeout', 5.0, 'Longest wait for a stack to be in the session file', 's',
              0.0, 60.0),
    Parameter('pipeline_depth', 2, 'Stacks on their way at a time; 2: one is captured or waits '
              'while another is reconstructed, 1: one after the other', '', 1, 2, read_only=True),
    Parameter('remembered', 500, 'Finished inspections that last_inspection knows', '', 1, 100000,
              read_only=True),
]
_FRESH_S = 5.0        # for the reconstruction to be discovered after a start
_LOOK_S = 0.25        # between two looks for new and lost reconstructions


class InspectionNode(Node):
    """See the README for the actions, the service and the parameters."""

    def __init__(self) -> None:
        super().__init__('inspection')
        self.parameters = ros_support.Parameters(
            self, PARAMETERS, ErrorCode.INSPECTION_BAD_REQUEST)
        self.pipeline = StackPipeline(self.parameters['pipeline_depth'],
                                      self.parameters['reconstruction_timeout'])
        self.finished: deque[ps.Inspection] = deque(maxlen=self.parameters['remembered'])
        self.failures = 0
        self._session = ''
        self._recorded: deque[str] = deque(maxlen=200)
        self._exposing = threading.Lock()    # from acceptance to safe_to_move: a second is BUSY
        self._camera = threading.Lock()      # until the stack is published: a second waits
        self._source = StackSource(self, ErrorCode.INSPECTION_CAPTURE_FAILED,
                                   ErrorCode.INSPECTION_CANCELLED)
        self._prober = IlluminationProber(self, self._source)
        self._outputs = OutputImages(self)

        events = MutuallyExclusiveCallbackGroup()     # in the order they came
        self.create_subscription(ps.AcquisitionDone, 'acquisition_done', self._on_acquired,
                                 ros_support.RELIABLE, callback_group=events)
        info_topic = self.create_subscription(
            ps.ReconstructionInfo, 'reconstruction_info', self.pipeline.reconstructed,
            ros_support.LATCHED, callback_group=events).topic_name
        self._watch = ReconstructionWatch(lambda: [
            tuple(each.endpoint_gid) for each in self.get_publishers_info_by_topic(info_topic)])
        self.create_timer(_LOOK_S, self._watch.look)
        self.create_subscription(String, 'session/active', self._on_session, ros_support.LATCHED,
                                 callback_group=events)
        self.create_subscription(String, 'session/recorded', self._on_recorded,
                                 ros_support.RELIABLE, callback_group=events)
        self.create_service(LastInspection, 'last_inspection', self._on_last)
        parallel = ReentrantCallbackGroup()
        self._actions = [
            ActionServer(self, kind, name, execute, callback_group=parallel,
                         goal_callback=lambda _: GoalResponse.ACCEPT,
                         cancel_callback=lambda _: CancelResponse.ACCEPT)
            for kind, name, execute in (
                (Inspect, 'inspect', self._on_inspect),
                (SearchIllumination, 'search_illumination', self._on_search))]
        ros_support.Diagnostics(self, {'Inspection': self._diagnose})

    # ------------------------------------------------------------------ inputs

    def _on_acquired(self, message: ps.AcquisitionDone) -> None:
        if message.success:
            self.pipeline.acquired(message.stack_id)
        else:
            self.pipeline.forget(message.stack_id)     # its frames were refused afterwards

    def _on_session(self, message: String) -> None:
        self._session = message.data

    def _on_recorded(self, message: String) -> None:
        self._recorded.append(message.data)

    @ros_support.answers(ErrorCode.INSPECTION_INTERNAL)
    def _on_last(self, request: LastInspection.Request,
                 response: LastInspection.Response) -> None:
        for inspection in reversed(self.finished):
            if (request.part_id in ('', inspection.part_id)
                    and request.stack_id in ('', inspection.stack_id)):
                response.inspection = inspection
                return
        asked = ' '.join(filter(None, (
            request.part_id and f'part_id {request.part_id!r}',
            request.stack_id and f'stack_id {request.stack_id!r}')))
        raise PsError(ErrorCode.INSPECTION_NOT_FOUND,
                      f'none of the last {len(self.finished)} inspections '
                      f'{"is of " + asked if asked else "is finished"}')

    # ------------------------------------------------------------------ the actions

    def _on_search(self, goal: ServerGoalHandle) -> SearchIllumination.Result:
        result = SearchIllumination.Result()

        def work() -> None:
            # its probes are reconstructed, too: they must not push out an inspection's stack
            with (self._exclusive(), self.pipeline.place(lambda: goal.is_cancel_requested),
                  self._camera_of(goal)):
                asked, roi = goal.request, goal.request.roi
                search = self._prober.search(
                    Request(list(asked.modes), asked.cr_min, asked.cr_max, asked.probe_budget,
                            asked.exposure_time,
                            Region(roi.x_offset, roi.y_offset, roi.width, roi.height)),
                    self.parameters['capture_timeout'], lambda: goal.is_cancel_requested,
                    lambda search: goal.publish_feedback(_probe_feedback(search)))
                best = search.best
                if best.mode == Mode.BRIGHT_FIELD:
                    self._prober.move_to(best, lambda: goal.is_cancel_requested)
                result.best_mode = int(best.mode)
                result.best_convergence_radius = best.convergence_radius
                result.probed_modes = [int(probe.setting.mode) for probe in search.probes]
                result.probed_convergence_radii = [
                    probe.setting.convergence_radius for probe in search.probes]
                result.scores = [-error for error in search.errors]

        return self._finish(goal, result, work)

    def _on_inspect(self, goal: ServerGoalHandle) -> Inspect.Result:
        result = Inspect.Result()

        def work() -> None:
            check_request(goal.request)
            stage = Inspect.Feedback
            with self._exclusive() as capture_over, self._outputs.wanted(goal.request.outputs):
                _tell(goal, stage.WAITING)
                with (self.pipeline.place(lambda: goal.is_cancel_requested) as taken,
                      self._camera_of(goal)):
                    self._capture(goal, result, capture_over)
                    alive = self._watch.follow()
                    taken(result.stack_id)
                capture_over()
                _tell(goal, stage.RECONSTRUCTING, True)
                self._reconstruct(goal, result, alive)
                self._deliver(goal, result)

        self._finish(goal, result, work)
        if result.error_code != ErrorCode.INSPECTION_BUSY:
            self._remember(goal.request, result)
        return result

    def _finish(self, goal: ServerGoalHandle, result: Any, work: Callable[[], None]) -> Any:
        try:
            work()
            result.success, result.message = True, result.message or 'ok'
            goal.succeed()
        except Exception as error:
            known = ros_support.as_ps_error(self, error, ErrorCode.INSPECTION_INTERNAL)
            self.get_logger().warning(f'{known.code.name}: {known.message}')
            ros_support.fill_error(result, known)
            if known.code not in (ErrorCode.INSPECTION_CANCELLED, ErrorCode.INSPECTION_BUSY):
                self.failures += 1
            if goal.is_cancel_requested:
                goal.canceled()
            else:
                goal.abort()
        return result

    @contextmanager
    def _exclusive(self) -> Iterator[Callable[[], None]]:
        """One goal at a time until its exposures have ended; yields what says that they have."""
        if not self._exposing.acquire(blocking=False):
            raise PsError(ErrorCode.INSPECTION_BUSY, 'another inspection or search is using the '
                                                     'head; wait for its safe_to_move')
        once = threading.Lock()      # feedback and the end may both say it, in two threads

        def release() -> None:
            if once.acquire(blocking=False):
                self._exposing.release()
        try:
            yield release
        finally:
            release()

    @contextmanager
    def _camera_of(self, goal: ServerGoalHandle) -> Iterator[None]:
        """Wait until the capture before has been read out and published."""
        while not self._camera.acquire(timeout=0.05):
            self._source.check(lambda: goal.is_cancel_requested)
        try:
            yield
        finally:
            self._camera.release()

    # ------------------------------------------------------------------ stages of an inspection

    def _capture(self, goal: ServerGoalHandle, result: Inspect.Result,
                 over: Callable[[], None]) -> None:
        """Illumination and capture; fills stack_id."""
        request, stage, state = goal.request, Inspect.Feedback, AcquireStack.Feedback
        deadline = time.monotonic() + _FRESH_S
        while not self._watch.ready():
            self._source.check(lambda: goal.is_cancel_requested)
            if time.monotonic() > deadline:
                raise PsError(ErrorCode.INSPECTION_RECONSTRUCTION_LOST,
                              'nobody publishes reconstruction_info; is the reconstruction node '
                              'running?')
            time.sleep(0.1)
        take = AcquireStack.Goal(
            part_id=request.part_id, head_pose=request.head_pose, recipe=request.recipe,
            ambient_frame=request.ambient_frame)
        if request.illumination != Inspect.Goal.AS_IS:
            mode, radius = request.mode, request.convergence_radius
            if request.illumination == Inspect.Goal.SEARCH:
                _tell(goal, stage.ILLUMINATING)
                best = self._prober.search(
                    Request(exposure_time=request.exposure_time),
                    self.parameters['capture_timeout'], lambda: goal.is_cancel_requested).best
                mode, radius = int(best.mode), best.convergence_radius
            moves = mode == Mode.BRIGHT_FIELD or request.illumination == Inspect.Goal.GIVEN
            take.steps = ring_steps(mode, radius if moves else 0.0, request.exposure_time)
            result.mode, result.convergence_radius = mode, radius

        def on_feedback(capture: AcquireStack.Feedback) -> None:
            moving = capture.state == state.MOVING
            # feedback may be overtaken by the result
            if capture.state != state.PUBLISHED and not result.stack_id:
                _tell(goal, stage.ILLUMINATING if moving else stage.CAPTURING,
                      capture.safe_to_move)
            if capture.safe_to_move:
                over()

        result.stack_id = self._source.capture(
            take, self.parameters['capture_timeout'], lambda: goal.is_cancel_requested,
            on_feedback).stack_id

    def _reconstruct(self, goal: ServerGoalHandle, result: Inspect.Result,
                     alive: Callable[[], bool]) -> None:
        result.info = self.pipeline.wait(
            result.stack_id, self.parameters['reconstruction_timeout'],
            lambda: goal.is_cancel_requested, alive)
        if not result.info.success:
            code = result.info.error_code
            name = ErrorCode(code).name if code in ErrorCode._value2member_map_ else str(code)
            raise PsError(ErrorCode.INSPECTION_RECONSTRUCTION_FAILED,
                          f'stack {result.stack_id}: {name}: {result.info.message}')

    def _deliver(self, goal: ServerGoalHandle, result: Inspect.Result) -> None:
        """Files, and the session once the stack is in it; fills uris."""
        session = self._session
        names = sorted(set(goal.request.outputs))
        if names:
            stamp = result.info.header.stamp
            arrays = self._outputs.fetch(
                names, (stamp.sec, stamp.nanosec), self.parameters['output_timeout'],
                lambda: goal.is_cancel_requested)
            # the stack's name came over the network
            folder = confined(
                _folder(self.parameters['output_folder'], 'PS_OUTPUT_FOLDER', '~/ps_inspections'),
                result.stack_id, 'stack_id', ErrorCode.INSPECTION_WRITE_FAILED)
            try:
                files = write_quantities(arrays, folder)
            except OSError as error:
                raise PsError(ErrorCode.INSPECTION_WRITE_FAILED,
                              f'output_folder: {error}') from error
            result.uris = [file.as_uri() for file in files]
        if not session:
            return
        deadline = time.monotonic() + self.parameters['record_timeout']
        while result.stack_id not in self._recorded:
            self._source.check(lambda: goal.is_cancel_requested)
            if time.monotonic() > deadline or not self._session:
                result.message = f'not acknowledged by the recorder of session {session}'
                return
            time.sleep(0.02)
        folder = _folder(self.parameters['session_folder'], 'PS_SESSION_FOLDER', '~/ps_sessions')
        result.uris = [(folder / session).as_uri(), *result.uris]

    # ------------------------------------------------------------------ afterwards

    def _remember(self, request: Inspect.Goal, result: Inspect.Result) -> None:
        self.finished.append(ps.Inspection(
            finished=self.get_clock().now().to_msg(), stack_id=result.stack_id,
            part_id=request.part_id, head_pose=request.head_pose, success=result.success,
            error_code=result.error_code, message=result.message, info=result.info,
            uris=result.uris))

    def _diagnose(self) -> ros_support.Report:
        values = {'inspections': len(self.finished), 'failures': self.failures,
                  'on their way': self.pipeline.on_their_way, 'dropped': self.pipeline.dropped,
                  'exposing': self._exposing.locked()}
        if self.finished and not self.finished[-1].success:
            return ros_support.WARN, self.finished[-1].message, values
        return ros_support.OK, 'ready', values


def _tell(goal: ServerGoalHandle, stage: int, safe_to_move: bool = False) -> None:
    goal.publish_feedback(Inspect.Feedback(stage=stage, safe_to_move=safe_to_move))


def _probe_feedback(search: IlluminationSearch) -> SearchIllumination.Feedback:
    setting = search.probes[-1].setting
    shadowed, saturated = search.last_shares
    return SearchIllumination.Feedback(
        probe=len(search.probes), total=search.budget, mode=int(setting.mode),
        convergence_radius=setting.convergence_radius, score=-search.errors[-1],
        shadowed=shadowed, saturated=saturated)


def _folder(parameter: str, variable: str, otherwise: str) -> Path:
    return Path(parameter or os.environ.get(variable) or otherwise).expanduser().absolute()


def main() -> None:
    """Run the node."""
    # three goals at a time may each hold a thread
    ros_support.run_node(InspectionNode, threads=12)


if __name__ == '__main__':
    main()
