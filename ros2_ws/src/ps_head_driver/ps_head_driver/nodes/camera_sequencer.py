"""Node camera_sequencer: triggers lights, collects frames, publishes one stack a capture."""
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
import math
from pathlib import Path
import threading
import time
from typing import Any
import uuid

import numpy as np
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import Trigger

from ps_head_driver import convergence_radius, ros_support, sequence
from ps_head_driver.calibration_file import HeadCalibration, apply
from ps_head_driver.camera_model import scaled_camera
from ps_head_driver.cameras.base import Camera, Frame
from ps_head_driver.cameras.factory import CAMERAS, CameraSettings, make_camera
from ps_head_driver.conversions import (
    exposure,
    message_to_calibration,
    message_to_light,
    message_to_pose,
    stack_to_message,
    with_exposure_scale,
)
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.frames import OPTICAL_FRAME
from ps_head_driver.head_model import CameraGeometry, load_head, nominal_head_path
from ps_head_driver.ros_support import Parameter, answers, call
from ps_head_driver.stack import Geometry, Light, Panel, Plane, Pose, Stack
from ps_interfaces import msg as ps
from ps_interfaces.action import AcquireStack
from ps_interfaces.srv import Capture, CaptureFlat, RunStrobeProgram, SetIllumination

PARAMETERS = [
    Parameter('camera', 'fake', 'Camera back end', choices=CAMERAS, read_only=True),
    Parameter('head_file', '', 'Head geometry (YAML); empty: the nominal head', read_only=True),
    Parameter('recipe_file', '', 'Recipes (YAML); empty: the ones shipped', read_only=True),
    Parameter('default_exposure', 0.004, 'Exposure of steps that state none', 's', 1e-5, 10.0),
    Parameter('gain', 0.0, 'Camera gain', 'dB', 0.0, 48.0),
    Parameter('settle', 0.002, 'Panels on before the camera is triggered', 's', 0.0, 1.0),
    Parameter('frame_period', 1 / 60, 'Shortest time between two triggers', 's', 0.001, 10.0),
    Parameter('frame_timeout', 5.0, 'Longest wait for the frames of a finished program', 's',
              0.1, 120.0),
    Parameter('time_tolerance', 0.002, 'Allowed difference of frame and strobe times', 's',
              0.0, 1.0),
    Parameter('move_timeout', 30.0, 'Longest wait for a move of the panels', 's', 1.0, 300.0),
    Parameter('program_margin', 5.0, 'Longest wait for a strobe program beyond its own duration',
              's', 0.5, 60.0),
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
]


@dataclass
class _Flat:
    """A flat field: the lights it was taken with and one gain map for each."""

    flat_id: str
    lights: list[Light]
    gain_maps: list[np.ndarray]

    def for_lights(self, lights: list[Light], tolerance_counts: int,
                   tolerance_tilt: float) -> list[np.ndarray]:
        """Gain maps in the order of the lights, or an empty list if one light is not covered.

        The stored maps are per unit intensity; what is returned is for the intensity of now.
        """
        maps = []
        for light in lights:
            found = [gain * np.float32(np.mean(light.intensity))
                     for own, gain in zip(self.lights, self.gain_maps, strict=True)
                     if (own.mode, own.panel) == (light.mode, light.panel)
                     and abs(own.motor_counts - light.motor_counts) <= tolerance_counts
                     and abs(own.tilt - light.tilt) <= tolerance_tilt]
            if not found:
                return []
            maps.append(found[0])
        return maps


@dataclass
class _Acquisition:
    """Frames and lights of a finished recipe, matched."""

    frames: list[Frame]
    lights: list[Light]
    ambient: Frame | None
    duration: float      # first strobe to end of last exposure, s


class CameraSequencer(Node):
    """See the README for topics, services, the action and parameters."""

    # positions within this many counts count as the same illumination for a flat field
    FLAT_TOLERANCE_COUNTS = 40
    FLAT_TOLERANCE_TILT = 2e-3     # rad

    def __init__(self) -> None:
        super().__init__('camera_sequencer')
        self.parameters = ros_support.Parameters(
            self, PARAMETERS, ErrorCode.SEQUENCER_BAD_REQUEST)
        self.head = load_head(self.parameters['head_file'] or nominal_head_path())
        self.recipes = sequence.load_recipes(self.parameters['recipe_file'] or _recipe_path())
        self.calibration: HeadCalibration | None = None
        self.session_id = ''
        self.flat: _Flat | None = None
        self.captures = self.failures = 0
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
        # the replies must be able to arrive while a capture waits for them
        clients = MutuallyExclusiveCallbackGroup()
        self._illuminate = self.create_client(
            SetIllumination, 'set_illumination', callback_group=clients)
        self._run_program = self.create_client(
            RunStrobeProgram, 'head_driver/run_strobe_program', callback_group=clients)
        self._stop = self.create_client(Trigger, 'head_driver/stop', callback_group=clients)
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
            self._stop_head()
        return CancelResponse.ACCEPT

    def _stop_head(self) -> None:
        """Panels off and motor stopped; does not wait for the answer."""
        if self._stop.service_is_ready():
            self._stop.call_async(Trigger.Request())

    # ------------------------------------------------------------------ requests

    @answers(ErrorCode.SEQUENCER_INTERNAL)
    def _on_capture(self, request: Capture.Request, response: Capture.Response) -> str:
        with self._exclusive():
            stack, taken = self._capture(self.recipes.get(request.recipe), request.part_id)
        response.stack_id = stack.stack_id
        return f'{len(stack.images)} frames in {taken.duration * 1e3:.0f} ms'

    @answers(ErrorCode.SEQUENCER_INTERNAL)
    def _on_flat(self, request: CaptureFlat.Request, response: CaptureFlat.Response) -> str:
        if request.clear:
            self.flat = None
            return 'no flat field'
        recipe = self.recipes.get(request.recipe)
        with self._exclusive():
            rounds = [self._acquire(recipe, lambda *_: None)
                      for _ in range(request.averages or 4)]
        lights = rounds[0].lights
        if not all(light.is_equation for light in lights):
            raise PsError(ErrorCode.SEQUENCER_BAD_REQUEST,
                          'a flat field needs a recipe of single panels')
        gains = [sequence.gain_map(
            [taken.frames[i].image for taken in rounds],
            rounds[0].ambient.image if rounds[0].ambient else None,
            self.parameters['flat_height']) for i in range(len(lights))]
        for i, light in enumerate(lights):
            gains[i] /= exposure(light) * float(np.mean(light.intensity))
        peak = max(float(gain.max()) for gain in gains)
        self.flat = _Flat(_new_id('flat'), lights, [gain / peak for gain in gains])
        response.flat_id = self.flat.flat_id
        return f'flat field of {len(lights)} lights, {len(rounds)} pictures each'

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
            result.duration = taken.duration
            goal.succeed()
        except Exception as error:
            known = ros_support.as_ps_error(self, error, ErrorCode.SEQUENCER_INTERNAL)
            ros_support.fill_error(result, known)
            if goal.is_cancel_requested:
                goal.canceled()
            else:
                goal.abort()
        return result

    def _recipe_of(self, request: AcquireStack.Goal) -> sequence.Recipe:
        if not request.steps:
            recipe = self.recipes.get(request.recipe)
            if not request.ambient_frame:
                return recipe
        try:
            if not request.steps:
                return sequence.Recipe.model_validate({**recipe.model_dump(), 'ambient': True})
            modes, panels = ('BRIGHT_FIELD', 'DARK_FIELD', 'BOTH'), tuple(Panel.__members__)
            steps = [{
                'mode': modes[step.mode], 'panel': panels[step.panel],
                'convergence_radius': step.convergence_radius, 'exposure': step.exposure_time,
                'intensity': step.intensity or 1.0} for step in request.steps]
            return sequence.Recipe.model_validate(
                {'steps': steps, 'ambient': request.ambient_frame})
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
        self, recipe: sequence.Recipe, part_id: str, pose: Pose = Pose(),  # noqa: B008
        progress: Callable[[int, int, bool], None] = lambda *_: None,
    ) -> tuple[Stack, _Acquisition]:
        """Take one stack and publish it; acquisition_done goes out as soon as the light is off."""
        stack_id = _new_id('stack')
        done_sent = False

        def on_progress(state: int, frames: int, safe_to_move: bool) -> None:
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
        progress(AcquireStack.Feedback.PUBLISHED, len(stack.images), True)
        return stack, taken

    def _acquire(
        self, recipe: sequence.Recipe, progress: Callable[[int, int, bool], None],
    ) -> _Acquisition:
        """Run the programs of a recipe and collect its frames."""
        state = AcquireStack.Feedback
        self._open_camera()
        frames: list[Frame] = []
        lights: list[Light] = []
        duration = 0.0
        segments = sequence.plan(recipe, self.parameters['default_exposure'])
        for segment in segments:
            last = segment is segments[-1]
            if segment.convergence_radius > 0:
                progress(state.MOVING, len(frames), False)
                self._ask_head(self._illuminate, SetIllumination.Request(
                    by=SetIllumination.Request.BY_CONVERGENCE_RADIUS,
                    convergence_radius=segment.convergence_radius),
                    self.parameters['move_timeout'])
            self._check_cancelled()
            progress(state.ARMING, len(frames), False)
            shots = segment.shots
            self.camera.arm([shot.exposure for shot in shots],
                            panels=[(shot.mode, shot.panel) for shot in shots],
                            gain=self.parameters['gain'])
            try:
                self._check_cancelled()
                progress(state.EXPOSING, len(frames), False)
                steps = [self._strobe_step(shot) for shot in shots]
                duration_s = sum(s.settle + s.strobe_duration + s.period for s in steps)
                answer = self._ask_head(self._run_program, RunStrobeProgram.Request(steps=steps),
                                        duration_s + self.parameters['program_margin'])
                own = [
                    replace(message_to_light(light), exposure_time=shot.exposure,
                            gain=self.parameters['gain'])
                    for light, shot in zip(answer.lights, shots, strict=True)]
                progress(state.COLLECTING, len(frames), last)
                arrived = self.camera.collect(len(shots), self.parameters['frame_timeout'])
                self._check_cancelled()
                matched = sequence.match(arrived, own, self.parameters['time_tolerance'])
            finally:
                self.camera.disarm()
            frames += matched
            lights += [replace(light, frame_counter=frame.frame_counter)
                       for light, frame in zip(own, matched, strict=True)]
            duration += ((own[-1].device_time_ns - own[0].device_time_ns) * 1e-9
                         + shots[-1].exposure)
        sequence.check_images(frames)
        ambient = None
        if recipe.ambient:
            ambient, frames, lights = frames[-1], frames[:-1], lights[:-1]
        return _Acquisition(frames, lights, ambient, duration)

    def _open_camera(self) -> None:
        if not self._camera_open:
            self.camera.open()
            self._camera_open = True

    def _strobe_step(self, shot: sequence.Shot) -> ps.StrobeStep:
        return ps.StrobeStep(
            mode=int(shot.mode), panel=int(shot.panel), intensity=shot.intensity,
            settle=self.parameters['settle'], strobe_duration=shot.exposure,
            period=max(self.parameters['frame_period'], shot.exposure))

    def _ask_head(self, client: Any, request: Any, timeout: float) -> Any:
        try:
            answer = call(client, request, timeout, ErrorCode.SEQUENCER_HEAD_UNAVAILABLE)
        except PsError:
            self._stop_head()      # it may still be moving or flashing
            raise
        if not answer.success:
            name = _code_name(answer.error_code)
            self._check_cancelled()
            raise PsError(ErrorCode.SEQUENCER_HEAD_FAILED, f'head: {name}: {answer.message}')
        return answer

    def _check_cancelled(self) -> None:
        if self._cancel.is_set():
            raise PsError(ErrorCode.SEQUENCER_CANCELLED, 'cancelled; no stack was published')

    # ------------------------------------------------------------------ the stack

    def _assemble(self, taken: _Acquisition, stack_id: str, part_id: str, pose: Pose) -> Stack:
        stack = Stack(
            images=[frame.image for frame in taken.frames],
            lights=with_exposure_scale(taken.lights),
            ambient=taken.ambient.image if taken.ambient else None, stack_id=stack_id,
            part_id=part_id, session_id=self.session_id, stamp_ns=_mid_exposure(taken),
            head_pose=pose)
        source = self.camera.source_stack
        if source is not None:
            return self._with_source(stack, source)
        calibration, head = self.calibration, apply(self.head, self.calibration)
        camera = calibration.camera if calibration else (
            self.camera.camera_geometry or self.head.camera)
        stack = replace(
            stack, camera=_fit(camera, stack.shape),
            geometry=Geometry.CALIBRATED if calibration else Geometry.NOMINAL,
            calibration_id=calibration.calibration_id if calibration else '',
            plane=Plane(calibration.plane_normal, calibration.plane_offset)
            if calibration else Plane())
        try:
            solution = convergence_radius.forward(head, taken.lights[0].motor_counts)
            stack = replace(stack, convergence_radius=solution.convergence_radius,
                            light_height=solution.light_height)
        except PsError:
            pass     # the axes do not meet the plane: CR stays NaN, the stack is good all the same
        if self.flat is not None:
            gains = self.flat.for_lights(
                taken.lights, self.FLAT_TOLERANCE_COUNTS, self.FLAT_TOLERANCE_TILT)
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
        values = {'back end': self.parameters['camera'], 'captures': self.captures,
                  'failures': self.failures, 'busy': self._busy.locked(),
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


def _code_name(code: int) -> str:
    return ErrorCode(code).name if code in ErrorCode._value2member_map_ else str(code)


def _mid_exposure(taken: _Acquisition) -> int:
    first, last = taken.frames[0], taken.frames[-1]
    end = last.host_time_ns + int(last.exposure_time * 1e9)
    return (first.host_time_ns + end) // 2


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
