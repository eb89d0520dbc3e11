"""Fake camera: renders what the emulator's panels and motor really did at each trigger."""
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
import threading
import time
from typing import Any

from ps_head_driver.camera_model import scaled_camera
from ps_head_driver.cameras.base import Camera, Frame, Light
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.fake.renderer import Renderer, Sensor, make_renderer
from ps_head_driver.fake.trigger_socket import StrobeEvent, TriggerListener
from ps_head_driver.head_model import CameraGeometry, HeadModel

_CONNECT_TIMEOUT_S = 3.0
_POLL_S = 0.1


@dataclass
class FrameFaults:
    """What goes wrong between sensor and host; frames are counted from 1 after each arm.

    :param drop: frames that are exposed but never arrive.
    :param duplicate: frames that arrive twice.
    :param swap: frames that arrive after their successor.
    :param delay: s, by which the frame given arrives late.
    """

    drop: set[int] = field(default_factory=set)
    duplicate: set[int] = field(default_factory=set)
    swap: set[int] = field(default_factory=set)
    delay: dict[int, float] = field(default_factory=dict)


@dataclass(frozen=True)
class _Exposure:
    """One exposure: index since arming, frame count, s open, s lit of it, dB, start."""

    index: int
    frame_counter: int
    exposure: float
    lit_s: float
    gain: float
    host_time_ns: int


class FakeCamera(Camera):
    """A camera on the trigger cable of the fake head.

    Pictures are rendered after the exposure, in a thread of their own, so that no trigger is
    missed; times and counters are those of the exposure.

    :param head: the head as it really is.
    :param scene: name of what lies under it, see fake/scenes.py.
    :param trigger_socket: where the emulator announces its strobes.
    :param scale: picture size relative to the head's camera.
    :param bit_depth: 8 or 16.
    :param noise: shot and read noise.
    :param seed: of the noise.
    :param max_frame_rate: Hz; a trigger that comes sooner after the last one is missed.
    :param scene_parameters: see fake/scenes.py.
    :param sensor: replaces bit_depth and noise.
    """

    def __init__(self, head: HeadModel, scene: str, trigger_socket: str | Path,
                 scale: float = 1.0, bit_depth: int = 8, noise: bool = True, seed: int = 1,
                 max_frame_rate: float = 200.0, scene_parameters: dict[str, Any] | None = None,
                 sensor: Sensor | None = None) -> None:
        self.faults = FrameFaults()
        self._head, self._scene, self._scale, self._seed = head, scene, scale, seed
        self._scene_parameters = scene_parameters or {}
        self._sensor = sensor or Sensor(bit_depth=bit_depth, noise=noise)
        self._socket = trigger_socket
        # a little tolerance: the limit itself must be reachable
        self._shortest_ns = 0.99e9 / max_frame_rate
        self._renderer: Renderer | None = None
        self._listener: TriggerListener | None = None
        self._thread: threading.Thread | None = None
        self._closing = threading.Event()
        self._changed = threading.Condition()
        self._frames: list[Frame] = []
        self._held: Frame | None = None
        self._exposures: list[float] = []
        self._gain = 0.0
        self._armed = self._cancelled = self._rendering = False
        self._software_trigger = False
        self._triggered_ns: int | None = None           # host time of a trigger() not yet exposed
        self._error: PsError | None = None
        self._frame_counter = 0
        self._armings = self._exposed = 0
        self._first: tuple[int, int] | None = None      # device and host time of the first frame
        self._last_device_ns: int | None = None
        self._last_trigger: tuple[int, int] | None = None
        self._progress_s = 0.0

    @property
    def camera_geometry(self) -> CameraGeometry:
        """Intrinsics of the frames."""
        camera = self._head.camera
        return scaled_camera(camera, round(camera.width_px * self._scale),
                             round(camera.height_px * self._scale))

    @property
    def renderer(self) -> Renderer:
        """What makes the pictures; it knows the truth. Only after open."""
        if self._renderer is None:
            raise PsError(ErrorCode.SEQUENCER_CAMERA_LOST, 'the fake camera is not open')
        return self._renderer

    def open(self) -> None:
        """Build the scene (seconds) and start to listen for triggers."""
        if self._renderer is None:
            renderer = make_renderer(self._scene, self._head, self._sensor, self._scale,
                                     self._seed, **self._scene_parameters)
            renderer.warm_up()
            self._renderer = renderer
        if self._thread is None:
            self._closing.clear()
            self._listener = TriggerListener(self._socket)
            self._thread = threading.Thread(target=self._run, name='fake-camera', daemon=True)
            self._thread.start()

    def close(self) -> None:
        """Stop to listen."""
        self.cancel()
        self._closing.set()
        if self._listener is not None:
            self._listener.close()
        if self._thread is not None:
            self._thread.join()
        self._listener = self._thread = None

    def arm(self, exposures: Sequence[float], panels: Sequence[Light] | None = None,
            gain: float = 0.0, software_trigger: bool = False) -> None:
        """Forget old frames; every trigger from now on is exposed."""
        listener = self._listener
        if listener is None or not listener.wait_connected(_CONNECT_TIMEOUT_S):
            raise PsError(ErrorCode.SEQUENCER_CAMERA_LOST,
                          f'no fake head announces its strobes at {self._socket}; is head_driver '
                          'running with fake_hardware, with the same namespace and ROS_DOMAIN_ID?')
        with self._changed:
            listener.clear()
            self._frames, self._held, self._error = [], None, None
            self._exposures, self._gain = list(exposures), gain
            self._armings += 1
            self._exposed, self._first, self._last_device_ns = 0, None, None
            self._armed, self._cancelled = True, False
            self._software_trigger, self._triggered_ns = software_trigger, None

    def trigger(self) -> None:
        """Expose from now on; the picture is rendered when the light's end is known."""
        with self._changed:
            self._triggered_ns = time.time_ns()

    def collect(self, count: int, timeout: float) -> list[Frame]:
        """See Camera; the timeout runs while nothing is being rendered."""
        start = time.monotonic()
        with self._changed:
            while not (self._cancelled or len(self._frames) >= count):
                if self._error is not None:
                    raise self._error
                if self._listener is None or not (self._listener.connected or self._rendering):
                    raise PsError(ErrorCode.SEQUENCER_CAMERA_LOST,
                                  f'the fake head at {self._socket} has gone')
                idle = time.monotonic() - max(start, self._progress_s)
                if not self._rendering and idle >= timeout:
                    break
                self._changed.wait(min(_POLL_S, max(timeout - idle, 1e-3)))
            return list(self._frames)

    def disarm(self) -> None:
        """Ignore triggers until armed again."""
        with self._changed:
            self._armed = False

    def cancel(self) -> None:
        """Make a waiting collect return."""
        with self._changed:
            self._cancelled = True
            self._changed.notify_all()

    # ------------------------------------------------------------------ worker thread

    def _run(self) -> None:
        listener = self._listener
        assert listener is not None
        while not self._closing.is_set():
            event = listener.get(0.5)
            if event is None:
                continue
            with self._changed:
                exposed, arming = self._expose(event), self._armings
                self._rendering = exposed is not None
            if exposed is None:
                continue
            try:
                self._deliver(arming, exposed.index, self._render(event, exposed))
            except Exception as error:
                with self._changed:
                    self._error = error if isinstance(error, PsError) else PsError(
                        ErrorCode.SEQUENCER_INTERNAL, f'rendering failed: {error}')
            finally:
                with self._changed:
                    self._rendering = False
                    self._progress_s = time.monotonic()
                    self._changed.notify_all()

    def _expose(self, event: StrobeEvent) -> '_Exposure | None':
        """Take the trigger, if there is one for this strobe."""
        trigger = (event.boot, event.trigger_counter)
        triggered = event.trigger_counter > 0 and trigger != self._last_trigger
        self._last_trigger = trigger
        if self._software_trigger:
            triggered = self._triggered_ns is not None
        if not (self._armed and triggered):
            return None
        last = self._last_device_ns
        if last is not None and 0 <= event.device_time_ns - last < self._shortest_ns:
            return None
        self._last_device_ns = event.device_time_ns
        exposure = self._exposures[min(self._exposed, len(self._exposures) - 1)]
        # the event comes at the end of the strobe
        begun_ns = time.time_ns() - int(event.strobe_s * 1e9)
        lit_s = event.strobe_s
        if self._triggered_ns is not None:
            host_time_ns, self._triggered_ns = self._triggered_ns, None
            lit_s = max(lit_s - max(host_time_ns - begun_ns, 0) * 1e-9, 0.0)
        else:
            if self._first is None:      # later events may have waited for the renderer
                self._first = (event.device_time_ns, begun_ns)
            host_time_ns = self._first[1] + event.device_time_ns - self._first[0]
        self._exposed += 1
        self._frame_counter += 1
        return _Exposure(self._exposed, self._frame_counter, exposure, lit_s, self._gain,
                         host_time_ns)

    def _render(self, event: StrobeEvent, exposed: '_Exposure') -> Frame:
        image = self.renderer.render(
            event.tilt, event.df_tilt, event.bf_levels, event.df_levels, exposed.exposure,
            exposed.lit_s, exposed.gain, exposed.frame_counter)
        by_board = not self._software_trigger
        return Frame(image=image, frame_counter=exposed.frame_counter,
                     trigger_counter=event.trigger_counter if by_board else None,
                     device_time_ns=event.device_time_ns if by_board else None,
                     host_time_ns=exposed.host_time_ns, exposure_time=exposed.exposure,
                     gain=exposed.gain)

    def _deliver(self, arming: int, index: int, frame: Frame) -> None:
        if index in self.faults.delay:
            self._closing.wait(self.faults.delay[index])
        arriving = [] if index in self.faults.drop else [frame]
        if index in self.faults.duplicate:
            arriving *= 2
        with self._changed:
            if arming != self._armings:
                return      # armed again while this picture was being rendered
            if index in self.faults.swap and arriving:
                self._held = frame
                return
            if self._held is not None:
                arriving.append(self._held)
                self._held = None
            self._frames += arriving
            self._changed.notify_all()
