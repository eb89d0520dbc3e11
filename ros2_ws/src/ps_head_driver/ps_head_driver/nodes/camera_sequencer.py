"""Node camera_sequencer: triggers lights, collects frames, publishes one stack a capture."""
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
import math
from pathlib import Path
import threading
import time
from typing import Any
import uuid

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from std_msgs.msg import String

from ps_head_driver import convergence_radius, ros_support
from ps_head_driver.acquisition import Acquirer, Acquisition, Progress, Settings, Stage
from ps_head_driver.calibration_file import HeadCalibration, apply
from ps_head_driver.camera_model import scaled_camera
from ps_head_driver.cameras.base import Camera
from ps_head_driver.cameras.factory import CAMERAS, CameraSettings, make_camera
from ps_head_driver.conversions import message_to_calibration, message_to_pose, stack_to_message
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.flat_field import FlatField, make_flat_field
from ps_head_driver.frames import OPTICAL_FRAME
from ps_head_driver.head_model import CameraGeometry, load_head, nominal_head_path
from ps_head_driver.head_services import HeadServices
from ps_head_driver.kinematics import BrightFieldKinematics
from ps_head_driver.recipes import Recipe, load_recipes
from ps_head_driver.ros_support import Parameter, answers
from ps_head_driver.stack import Geometry, Mode, Panel, Plane, Pose, Stack, with_exposure_scale
from ps_interfaces import msg as ps
from ps_interfaces.action import AcquireStack
from ps_interfaces.srv import Capture, CaptureFlat

PARAMETERS = [
    Parameter('camera', 'fake', 'Camera back end', choices=CAMERAS, read_only=True),
    Parameter('head_file', '', 'Head geometry (YAML); empty: the nominal head', read_only=True),
    Parameter('recipe_file', '', 'Recipes (YAML); empty: the ones shipped', read_only=True),
    Parameter('sequencing', 'hardware', 'hardware: the board runs the sequence and triggers the '
              'camera; host: this node does, one light after the other (no trigger cable needed, '
              'slower)', choices=('hardware', 'host')),
    Parameter('default_exposure', 0.004, 'Exposure of steps that state none', 's', 1e-5, 10.0),
    Parameter('gain', 0.0, 'Camera gain of steps that state none', 'dB', 0.0, 48.0),
    Parameter('settle', 0.002, 'Panels on before the camera is triggered', 's', 0.0, 1.0),
    Parameter('frame_period', 1 / 60, 'Shortest time between two triggers', 's', 0.001, 10.0),
    Parameter('frame_timeout', 5.0, 'Longest wait for the frames of a finished program', 's',
              0.1, 120.0),
    Parameter('time_tolerance', 0.002, 'Allowed difference of frame and strobe times', 's',
              0.0, 1.0),
    Parameter('move_timeout', 30.0, 'Longest wait for a move of the panels', 's', 1.0, 300.0),
    Parameter('program_margin', 5.0, 'Longest wait for a strobe program beyond its own duration',
              's', 0.5, 60.0),
    Parameter('host_margin', 0.2, 'Sequencing host: a light stays on this much longer than the '
              'exposure', 's', 0.02, 1.5),
    Parameter('max_motion', 3.0, 'Largest shift between two frames of a stack, measured in them; '
              'a stack that moved more is refused; 0: not measured', 'px', 0.0, 100.0),
    Parameter('max_motor_motion', 4, 'Largest movement of the panels within a strobe program',
              'counts', 0, 1000),
    Parameter('flat_height', 256, 'Rows of a stored flat-field picture', 'px', 16, 4096),
    Parameter('trigger_socket', '', 'Fake camera: where the emulator announces strobes; empty: '
              'derived from namespace and domain', read_only=True),
    Parameter('true_head_file', '', 'Fake camera: the head as it really is; empty: head_file',
              read_only=True),
    Parameter('scene', 'disc', 'Fake camera: what lies under the head', read_only=True),
    Parameter('scale', 1.0, 'Fake camera: picture size relative to head_file', '', 0.05, 8.0,
              read_only=True),
    Parameter('bit_depth', 8, 'Fake camera: bits per pixel', 'bit', choices=(8, 16),
              read_only=True),
    Parameter('noise', True, 'Fake camera: shot and read noise', read_only=True),
    Parameter('seed', 1, 'Fake camera: seed of the noise', minimum=0, read_only=True),
    Parameter('input_folder', '', 'Folder camera: pictures to play', read_only=True),
    Parameter('slant', math.radians(45), 'Folder camera: assumed slant of lights of unknown '
              'geometry', 'rad', 0.05, 1.5, read_only=True),
    Parameter('image_topic', 'camera/image_raw', 'Topic camera: pictures', read_only=True),
    Parameter('significant_bits', 16, 'Topic camera: bits of 16-bit pictures that the driver '
              'fills in, from the lowest', 'bit', choices=(10, 12, 14, 16), read_only=True),
    Parameter('camera_id', '', 'GenICam camera: its id (as arv-tool-0.8 lists it) or IP address; '
              'empty: the first one found', read_only=True),
    Parameter('trigger_line', 'Line0', 'GenICam camera: input that the board triggers',
              read_only=True),
    Parameter('pixel_format', '', 'GenICam camera: pixel format (PFNC name, such as Mono12); '
              'empty: as the camera is set', read_only=True),
]


class CameraSequencer(Node):
    """See the README for topics, services, the action and parameters."""

    def __init__(self) -> None:
        super().__init__('camera_sequencer')
        self.parameters = ros_support.Parameters(
            self, PARAMETERS, ErrorCode.SEQUENCER_BAD_REQUEST)
        self.head = load_head(self.parameters['head_file'] or nominal_head_path())
        self.recipes = load_recipes(self.parameters['recipe_file'] or _recipe_path())
        self.calibration: HeadCalibration | None = None
        self.session_id = ''
        self.flat: FlatField | None = None
        self.captures = self.failures = 0
        self.motion_px = math.nan
        self.last_error = ''
        self._busy = threading.Lock()
        self._running: ServerGoalHandle | None = None
        self._cancel = threading.Event()
        self.camera: Camera = make_camera(self.parameters['camera'], CameraSettings(
            node=self, head=self.head, parameters=self.parameters))
        self._camera_open = False
        try:
            self._open_camera()
        except PsError as error:
            if error.code != ErrorCode.SEQUENCER_CAMERA_LOST:
                raise
            self.get_logger().warning(f'{error.message}; tried again at the next capture')

        latched, reliable = ros_support.LATCHED, ros_support.RELIABLE
        parallel = ReentrantCallbackGroup()
        self._stack = self.create_publisher(
            ps.PhotometricStack, 'stack', reliable,
            qos_overriding_options=ros_support.OVERRIDABLE)
        self._done = self.create_publisher(ps.AcquisitionDone, 'acquisition_done', reliable)
        self.create_subscription(
            ps.HeadCalibration, 'calibration', self._on_calibration, latched)
        self.create_subscription(String, 'session/active', self._on_session, latched)
        self._head = HeadServices(self, lambda: (
            self.parameters['move_timeout'], self.parameters['program_margin']))
        self._acquirer = Acquirer(self.camera, self._head, self._settings, self._cancel.is_set)
        self.create_service(Capture, 'capture', self._on_capture, callback_group=parallel)
        self.create_service(CaptureFlat, 'capture_flat', self._on_flat, callback_group=parallel)
        self._action = ActionServer(
            self, AcquireStack, 'acquire_stack', self._on_acquire, callback_group=parallel,
            goal_callback=lambda _: GoalResponse.ACCEPT, cancel_callback=self._on_cancel)
        ros_support.Diagnostics(self, {'Camera': self._diagnose})

    # ------------------------------------------------------------------ inputs

    def _on_calibration(self, message: ps.HeadCalibration) -> None:
        try:
            self.calibration = message_to_calibration(message)
        except PsError as error:
            self.get_logger().error(f'calibration refused: {error.message}')

    def _on_session(self, message: String) -> None:
        self.session_id = message.data

    def _on_cancel(self, goal: ServerGoalHandle) -> CancelResponse:
        # a goal that is not running yet looks at its own flag when it gets its turn
        if self._running is not None and self._running.goal_id == goal.goal_id:
            self._cancel.set()
            self.camera.cancel()
            self._head.stop()
        return CancelResponse.ACCEPT

    def _settings(self) -> Settings:
        own = self.parameters
        return Settings(
            hardware=own['sequencing'] == 'hardware', exposure=own['default_exposure'],
            **{name: own[name] for name in (
                'gain', 'settle', 'frame_period', 'frame_timeout', 'time_tolerance',
                'host_margin', 'max_motion', 'max_motor_motion')})

    # ------------------------------------------------------------------ requests

    @answers(ErrorCode.SEQUENCER_INTERNAL)
    def _on_capture(self, request: Capture.Request, response: Capture.Response) -> str:
        with self._exclusive():
            stack, taken = self._capture(self.recipes.get(request.recipe), request.part_id)
        response.stack_id = stack.stack_id
        return (f'{len(stack.images)} frames in {taken.duration * 1e3:.0f} ms, motion '
                + _motion_text(taken.motion_px))

    @answers(ErrorCode.SEQUENCER_INTERNAL)
    def _on_flat(self, request: CaptureFlat.Request, response: CaptureFlat.Response) -> str:
        if request.clear:
            self.flat = None
            return 'no flat field'
        recipe = self.recipes.get(request.recipe)
        with self._exclusive():
            rounds = [self._acquire(recipe) for _ in range(request.averages or 4)]
        first = rounds[0]
        self.flat = make_flat_field(
            _new_id('flat'), first.lights,
            [[frame.image for frame in taken.frames] for taken in rounds],
            first.ambient.image if first.ambient else None, self.parameters['flat_height'])
        response.flat_id = self.flat.flat_id
        return f'flat field of {len(first.lights)} lights, {len(rounds)} pictures each'

    def _on_acquire(self, goal: ServerGoalHandle) -> AcquireStack.Result:
        request, result = goal.request, AcquireStack.Result()
        try:
            with self._exclusive(goal):
                stack, taken = self._capture(
                    self._recipe_of(request), request.part_id, message_to_pose(request.head_pose),
                    lambda *progress: self._feedback(goal, *progress))
            result.success, result.message = True, 'ok'
            result.stack_id = stack.stack_id
            result.exposure_times = [light.exposure_time for light in taken.lights]
            result.duration, result.motion_px = taken.duration, taken.motion_px
            goal.succeed()
        except Exception as error:
            known = ros_support.as_ps_error(self, error, ErrorCode.SEQUENCER_INTERNAL)
            ros_support.fill_error(result, known)
            if goal.is_cancel_requested:
                goal.canceled()
            else:
                goal.abort()
        return result

    def _recipe_of(self, request: AcquireStack.Goal) -> Recipe:
        try:
            if request.steps:
                modes, panels = ('BRIGHT_FIELD', 'DARK_FIELD', 'BOTH'), tuple(Panel.__members__)
                content: dict[str, Any] = {'steps': [{
                    'mode': modes[step.mode], 'panel': panels[step.panel],
                    'convergence_radius': step.convergence_radius, 'gain': step.gain,
                    'exposure': step.exposure_time, 'intensity': step.intensity or 1.0}
                    for step in request.steps]}
            else:
                content = self.recipes.get(request.recipe).model_dump()
            if request.ambient_frame:
                content['ambient'] = True
            if request.bracket:
                content['bracket'] = list(request.bracket)
            return Recipe.model_validate(content)
        except (IndexError, ValueError) as error:
            reason = ' '.join(str(error).split())
            raise PsError(ErrorCode.SEQUENCER_BAD_REQUEST, f'steps: {reason}') from error

    @staticmethod
    def _feedback(goal: ServerGoalHandle, state: int, frames: int, safe_to_move: bool) -> None:
        goal.publish_feedback(AcquireStack.Feedback(
            state=state, frames_acquired=frames, safe_to_move=safe_to_move))

    @contextmanager
    def _exclusive(self, goal: ServerGoalHandle | None = None) -> Iterator[None]:
        """One capture at a time; a second one is refused, not queued."""
        if not self._busy.acquire(blocking=False):
            raise PsError(ErrorCode.SEQUENCER_BUSY, 'another capture is running; try again later')
        try:
            self._cancel.clear()
            self._running = goal
            if goal is not None and goal.is_cancel_requested:
                self._cancel.set()
            yield
        finally:
            self._running = None
            self._busy.release()

    # ------------------------------------------------------------------ capture

    def _capture(
        self, recipe: Recipe, part_id: str, pose: Pose = Pose(),  # noqa: B008
        progress: Progress = lambda *_: None,
    ) -> tuple[Stack, Acquisition]:
        """Take one stack and publish it; acquisition_done goes out as soon as the light is off."""
        stack_id = _new_id('stack')
        done_sent = False

        def on_progress(state: Stage, frames: int, safe_to_move: bool) -> None:
            nonlocal done_sent
            if safe_to_move and not done_sent:
                self._publish_done(stack_id, True, ErrorCode.NONE, 'ok')
                done_sent = True
            progress(state, frames, safe_to_move)

        try:
            taken = self._acquire(recipe, on_progress)
            stack = self._assemble(taken, stack_id, part_id, pose)
        except Exception as error:
            known = ros_support.as_ps_error(self, error, ErrorCode.SEQUENCER_INTERNAL)
            self.failures += 1
            self.last_error = f'{known.code.name}: {known.message}'
            # also after an early success: the exposures ended well, but no stack will follow
            self._publish_done(stack_id, False, known.code, known.message)
            raise known from error
        self._stack.publish(stack_to_message(stack))
        self.captures += 1
        self.last_error = ''
        progress(Stage.PUBLISHED, len(stack.images), True)
        return stack, taken

    def _acquire(self, recipe: Recipe, progress: Progress = lambda *_: None) -> Acquisition:
        self._open_camera()
        taken = self._acquirer.acquire(recipe, progress)
        self.motion_px = taken.motion_px
        return taken

    def _open_camera(self) -> None:
        if not self._camera_open:
            self.camera.open()
            self._camera_open = True

    # ------------------------------------------------------------------ the stack

    def _assemble(self, taken: Acquisition, stack_id: str, part_id: str, pose: Pose) -> Stack:
        stack = Stack(
            images=[frame.image for frame in taken.frames],
            lights=with_exposure_scale(taken.lights),
            ambient=taken.ambient.image if taken.ambient else None, stack_id=stack_id,
            part_id=part_id, session_id=self.session_id, stamp_ns=taken.stamp_ns,
            head_pose=pose)
        source = self.camera.source_stack
        if source is not None:
            return self._with_source(stack, source)
        calibration, head = self.calibration, apply(self.head, self.calibration)
        camera = calibration.camera if calibration else (
            self.camera.camera_geometry or self.head.camera)
        stack = replace(
            stack, camera=_fit(camera, stack.shape),
            geometry=Geometry.CALIBRATED if calibration and calibration.covers(taken.lights)
            else Geometry.NOMINAL,
            calibration_id=calibration.calibration_id if calibration else '',
            plane=Plane(calibration.plane_normal, calibration.plane_offset)
            if calibration else Plane())
        try:
            # from above, the panels stand as if at more counts: their tilt tells
            tilts = [light.tilt for light in taken.lights if light.mode == Mode.BRIGHT_FIELD]
            counts = (BrightFieldKinematics(head).motor_counts(tilts[0]) if tilts
                      else taken.lights[0].motor_counts)
            solution = convergence_radius.forward(head, counts)
            stack = replace(stack, convergence_radius=solution.convergence_radius,
                            light_height=solution.light_height)
        except PsError:
            pass     # the axes do not meet the plane: CR stays NaN, the stack is good all the same
        if self.flat is not None:
            gains = self.flat.for_lights(taken.lights)
            if gains:
                stack = replace(stack, gain_maps=gains, flat_id=self.flat.flat_id)
            else:
                self.get_logger().warning(
                    f'{self.flat.flat_id} was taken under another illumination and is not used')
        return stack

    @staticmethod
    def _with_source(stack: Stack, source: Stack) -> Stack:
        """Pictures from a folder bring their own lights, camera and flat field."""
        by_panel = {(light.mode, light.panel): i for i, light in enumerate(source.lights)}
        missing = [light.name for light in stack.lights
                   if (light.mode, light.panel) not in by_panel]
        if missing:
            raise PsError(ErrorCode.SEQUENCER_BAD_REQUEST,
                          f'the folder states no light for {", ".join(missing)}; use a recipe of '
                          'the single panels it has')
        own = source.subset([by_panel[light.mode, light.panel] for light in stack.lights])
        return replace(
            stack, camera=source.camera, geometry=source.geometry, plane=source.plane,
            mask=source.mask, gain_maps=own.gain_maps, flat_id='folder' if own.gain_maps else '',
            lights=[replace(geometry, strobe_counter=light.strobe_counter,
                            frame_counter=light.frame_counter,
                            device_time_ns=light.device_time_ns)
                    for light, geometry in zip(stack.lights, own.lights, strict=True)])

    def _publish_done(self, stack_id: str, success: bool, code: int, message: str) -> None:
        done = ps.AcquisitionDone(
            stack_id=stack_id, success=success, error_code=int(code), message=message)
        done.header.stamp = self.get_clock().now().to_msg()
        done.header.frame_id = OPTICAL_FRAME
        self._done.publish(done)

    def _diagnose(self) -> ros_support.Report:
        values = {'back end': self.parameters['camera'],
                  'sequencing': self.parameters['sequencing'], 'captures': self.captures,
                  'failures': self.failures, 'busy': self._busy.locked(),
                  'motion in the last stack': _motion_text(self.motion_px),
                  'flat field': self.flat.flat_id if self.flat else 'none',
                  'calibration': self.calibration.calibration_id if self.calibration else 'none'}
        if self.last_error:
            return ros_support.ERROR, self.last_error, values
        return ros_support.OK, 'ready', values

    def close(self) -> None:
        """Let go of the camera."""
        self._cancel.set()
        self.camera.cancel()
        self.camera.close()


def _recipe_path() -> Path:
    return nominal_head_path().with_name('recipes.yaml')


def _new_id(kind: str) -> str:
    return f'{kind}-{time.strftime("%Y%m%dT%H%M%S", time.gmtime())}-{uuid.uuid4().hex[:8]}'


def _motion_text(motion_px: float) -> str:
    return 'not known' if math.isnan(motion_px) else f'{motion_px:.1f} px'


def _fit(camera: CameraGeometry, shape: tuple[int, int]) -> CameraGeometry:
    """The intrinsics for pictures of another size of the same field of view."""
    height, width = shape
    return camera if (camera.height_px, camera.width_px) == shape else scaled_camera(
        camera, width, height)


def main() -> None:
    """Run the node."""
    ros_support.run_node(CameraSequencer)


if __name__ == '__main__':
    main()
