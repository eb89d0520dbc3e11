"""GenICam camera (GigE Vision, USB3 Vision) through Aravis."""
from collections.abc import Callable, Sequence
import threading
import time
from typing import TypeVar

from ps_head_driver.cameras import aravis
from ps_head_driver.cameras.aravis import AravisCamera, AravisError, RawFrame
from ps_head_driver.cameras.base import Camera, Frame, Light
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.pixel_formats import PFNC, SUPPORTED

T = TypeVar('T')
_POLL_S = 0.05
_SPARE_BUFFERS = 2


class GenicamCamera(Camera):
    """Triggered by the board on an input line, or by software where the host steps the sequence.

    A camera that was lost is looked for again each time it is armed.

    :param camera_id: as Aravis lists it, or its IP address; empty: the first one found.
    :param trigger_line: the input that the board triggers.
    :param pixel_format: PFNC name; empty: as the camera is set.
    :raises PsError: SEQUENCER_BAD_REQUEST if Aravis is not installed.
    """

    def __init__(self, camera_id: str, trigger_line: str = 'Line0',
                 pixel_format: str = '') -> None:
        if not aravis.is_installed():
            raise PsError(ErrorCode.SEQUENCER_BAD_REQUEST,
                          'camera genicam needs the Aravis library: sudo apt install '
                          'libaravis-0.8-0')
        self._id, self._line, self._pixel_format = camera_id, trigger_line, pixel_format
        self._device: AravisCamera | None = None
        self._cancelled = threading.Event()
        self._frames: list[Frame] = []
        self._exposure = self._gain = 0.0       # asked for
        self._reached = (0.0, 0.0)              # exposure and gain as the camera has them
        self._counter = 0
        self._last_id: int | None = None        # of the frame before, while armed

    @property
    def camera_geometry(self) -> None:
        """Unknown to a GenICam camera: the head file or the calibration has it."""

    def open(self) -> None:
        """Find the camera and set it up."""
        self.close()
        device = self._device = self._or_lost(lambda: AravisCamera(self._id))
        if self._pixel_format:
            self._check_choice('pixel_format', self._pixel_format,
                               self._or_lost(lambda: device.pixel_formats))
        self._check_choice('trigger_line', self._line,
                           self._or_lost(lambda: device.trigger_sources))
        self._or_lost(lambda: self._set_up(device))

    def _set_up(self, device: AravisCamera) -> None:
        if self._pixel_format:
            device.pixel_format = self._pixel_format
        device.trigger_source = self._line
        self._exposure, self._gain = device.exposure, device.gain
        device.start()

    def _check_choice(self, parameter: str, value: str, choices: Sequence[str]) -> None:
        if value not in choices:
            self.close()
            raise PsError(ErrorCode.SEQUENCER_BAD_REQUEST,
                          f'parameter {parameter}: the camera has no {value!r}, but '
                          + ', '.join(choices))

    def close(self) -> None:
        """Let go of the camera."""
        self.cancel()
        device, self._device = self._device, None
        if device is not None:
            device.close()

    def _connected(self) -> AravisCamera:
        if self._device is None or self._device.lost.is_set():
            self.open()
        assert self._device is not None
        return self._device

    def arm(self, exposures: Sequence[float], panels: Sequence[Light] | None = None,
            gain: float = 0.0, software_trigger: bool = False) -> None:
        """See Camera; all exposures must be equal. Reopens a lost camera (seconds)."""
        exposure = exposures[0]
        if any(other != exposure for other in exposures):
            raise PsError(ErrorCode.SEQUENCER_BAD_REQUEST,
                          'a GenICam camera has one exposure time for all frames of a program')
        device = self._connected()
        source = 'Software' if software_trigger else self._line

        def prepare() -> None:
            if device.trigger_source != source:
                device.stop()
                device.trigger_source = source
                device.start()
            if exposure != self._exposure:
                self._check_range('exposure', exposure, device.exposure_bounds, 's')
                device.exposure = self._exposure = exposure
            if gain != self._gain:
                self._check_range('gain', gain, device.gain_bounds, 'dB')
                device.gain = self._gain = gain
            self._reached = (device.exposure, device.gain)
            device.reserve(len(exposures) + _SPARE_BUFFERS)

        self._or_lost(prepare)
        self._frames, self._last_id = [], None
        self._cancelled.clear()

    @staticmethod
    def _check_range(name: str, value: float, bounds: tuple[float, float], unit: str) -> None:
        low, high = bounds
        if not low <= value <= high:
            raise PsError(ErrorCode.SEQUENCER_BAD_REQUEST,
                          f'{name} {value:g} {unit}: the camera takes {low:g} to {high:g}')

    def trigger(self) -> None:
        """Software trigger."""
        device = self._connected()
        self._or_lost(device.trigger)

    def collect(self, count: int, timeout: float) -> list[Frame]:
        """See Camera. A frame with lost packets counts as one that never came."""
        deadline = time.monotonic() + timeout
        while len(self._frames) < count and not self._cancelled.is_set():
            device = self._device
            if device is None or device.lost.is_set():
                raise self._lost('it does not answer any more')
            left = deadline - time.monotonic()
            if left <= 0:
                break
            for raw in device.frames(min(_POLL_S, left)):
                self._take(device, raw)
        return list(self._frames)

    def _take(self, device: AravisCamera, raw: RawFrame) -> None:
        # the camera's own count says whether frames are missing in between
        self._counter += (
            1 if self._last_id is None else frames_between(self._last_id, raw.frame_id))
        self._last_id = raw.frame_id
        if raw.data is None:
            return
        if raw.pixel_format not in PFNC:
            name = self._or_lost(lambda: device.pixel_format)
            raise PsError(ErrorCode.SEQUENCER_BAD_IMAGE,
                          f'pixel format {name} is not supported; set parameter pixel_format to '
                          f'one of {SUPPORTED}')
        try:
            image = PFNC[raw.pixel_format].decode(raw.data, raw.width, raw.height)
        except ValueError as error:
            raise PsError(ErrorCode.SEQUENCER_BAD_IMAGE,
                          f'frame {raw.frame_id}: {error}') from error
        exposure, gain = self._reached
        self._frames.append(Frame(
            image=image, frame_counter=self._counter, trigger_counter=None,
            # its first packet leaves when the exposure has ended
            device_time_ns=raw.timestamp_ns, host_time_ns=raw.system_ns - round(exposure * 1e9),
            exposure_time=exposure, gain=gain))

    def disarm(self) -> None:
        """Frames that come now are thrown away by the next arm."""

    def cancel(self) -> None:
        """Make a waiting collect return."""
        self._cancelled.set()

    # ------------------------------------------------------------------ errors

    def _or_lost(self, action: Callable[[], T]) -> T:
        """Do something with the camera; a failure means that it has gone."""
        try:
            return action()
        except AravisError as error:
            raise self._lost(str(error)) from error

    def _lost(self, reason: str) -> PsError:
        device, self._device = self._device, None
        if device is not None:
            device.lost.set()        # no more words to it
            device.close()
        return PsError(ErrorCode.SEQUENCER_CAMERA_LOST,
                       f'camera {self._id or "(the first one found)"}: {reason}; check power, '
                       'cable and camera_id; it is looked for again at the next capture')


def frames_between(last: int, now: int) -> int:
    """Step of a camera's frame number from one frame to the next.

    GigE Vision counts in 16 bits from 1 and leaves 0 out; some cameras do not leave it out.
    """
    step = (now - last) % (1 << 16) if now < last else now - last
    return step - 1 if now < last and now > 0 else step
