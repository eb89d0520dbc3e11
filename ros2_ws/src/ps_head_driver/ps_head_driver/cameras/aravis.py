"""The part of the Aravis library (0.8) that a triggered camera needs, through ctypes.

Not through PyGObject: that would have to be compiled against the introspection library of each
distribution, while this works in any Python as soon as libaravis-0.8.so.0 is installed.
"""
from collections.abc import Callable, Iterator
import ctypes
from ctypes import POINTER, byref, c_char_p, c_double, c_int, c_size_t, c_uint, c_uint32, c_uint64
from ctypes import c_void_p as pointer
from dataclasses import dataclass
import functools
import threading
from typing import Any

import numpy as np
from numpy.typing import NDArray

_CONTINUOUS = 0             # ArvAcquisitionMode
_AUTO_OFF = 0               # ArvAuto
_SUCCESS = 0                # ArvBufferStatus
_LOST_CALLBACK = ctypes.CFUNCTYPE(None, pointer, pointer)

# result and arguments of the functions that report no error, and of those that do
_PLAIN: dict[str, tuple[Any, ...]] = {
    'arv_update_device_list': (None,),
    'arv_get_n_devices': (c_uint,),
    'arv_get_device_id': (c_char_p, c_uint),
    'arv_camera_get_device': (pointer, pointer),
    'arv_buffer_new_allocate': (pointer, c_size_t),
    'arv_buffer_get_status': (c_int, pointer),
    'arv_buffer_get_data': (pointer, pointer, POINTER(c_size_t)),
    'arv_buffer_get_frame_id': (c_uint64, pointer),
    'arv_buffer_get_timestamp': (c_uint64, pointer),
    'arv_buffer_get_system_timestamp': (c_uint64, pointer),
    'arv_buffer_get_image_width': (c_int, pointer),
    'arv_buffer_get_image_height': (c_int, pointer),
    'arv_buffer_get_image_pixel_format': (c_uint32, pointer),
    'arv_stream_push_buffer': (None, pointer, pointer),
    'arv_stream_try_pop_buffer': (pointer, pointer),
    'arv_stream_timeout_pop_buffer': (pointer, pointer, c_uint64),
}
_FAILING: dict[str, tuple[Any, ...]] = {
    'arv_camera_new': (pointer, c_char_p),
    'arv_camera_get_vendor_name': (c_char_p, pointer),
    'arv_camera_get_model_name': (c_char_p, pointer),
    'arv_camera_get_device_serial_number': (c_char_p, pointer),
    'arv_camera_dup_available_pixel_formats_as_strings': (
        POINTER(c_char_p), pointer, POINTER(c_uint)),
    'arv_camera_dup_available_trigger_sources': (POINTER(c_char_p), pointer, POINTER(c_uint)),
    'arv_camera_set_pixel_format_from_string': (None, pointer, c_char_p),
    'arv_camera_get_pixel_format_as_string': (c_char_p, pointer),
    'arv_camera_is_exposure_auto_available': (c_int, pointer),
    'arv_camera_set_exposure_time_auto': (None, pointer, c_int),
    'arv_camera_get_exposure_time_bounds': (None, pointer, POINTER(c_double), POINTER(c_double)),
    'arv_camera_set_exposure_time': (None, pointer, c_double),
    'arv_camera_get_exposure_time': (c_double, pointer),
    'arv_camera_is_gain_available': (c_int, pointer),
    'arv_camera_is_gain_auto_available': (c_int, pointer),
    'arv_camera_set_gain_auto': (None, pointer, c_int),
    'arv_camera_get_gain_bounds': (None, pointer, POINTER(c_double), POINTER(c_double)),
    'arv_camera_set_gain': (None, pointer, c_double),
    'arv_camera_get_gain': (c_double, pointer),
    'arv_camera_set_acquisition_mode': (None, pointer, c_int),
    'arv_camera_set_trigger': (None, pointer, c_char_p),
    'arv_camera_get_trigger_source': (c_char_p, pointer),
    'arv_camera_software_trigger': (None, pointer),
    'arv_camera_get_payload': (c_uint, pointer),
    'arv_camera_create_stream': (pointer, pointer, pointer, pointer),
    'arv_camera_start_acquisition': (None, pointer),
    'arv_camera_stop_acquisition': (None, pointer),
}


class AravisError(Exception):
    """What Aravis says about a call that failed."""


class _GError(ctypes.Structure):
    _fields_ = (('domain', c_uint32), ('code', c_int), ('message', c_char_p))


class _Library:
    """The functions above as attributes without their prefix; failing ones raise AravisError."""

    def __init__(self) -> None:
        aravis = ctypes.CDLL('libaravis-0.8.so.0')
        self._glib = ctypes.CDLL('libglib-2.0.so.0')
        self._gobject = ctypes.CDLL('libgobject-2.0.so.0')
        self._glib.g_error_free.argtypes = [POINTER(_GError)]
        self._glib.g_free.argtypes = [pointer]
        self._gobject.g_object_unref.argtypes = [pointer]
        self._gobject.g_signal_connect_data.argtypes = [
            pointer, c_char_p, _LOST_CALLBACK, pointer, pointer, c_int]
        for table, fails in ((_PLAIN, False), (_FAILING, True)):
            for name, (result, *arguments) in table.items():
                function = getattr(aravis, name)
                function.restype = result
                function.argtypes = [*arguments, POINTER(POINTER(_GError))] if fails else arguments
                setattr(self, name.removeprefix('arv_'),
                        self._raising(function) if fails else function)

    def __getattr__(self, name: str) -> Any:      # for the type checker; all are set above
        raise AttributeError(name)

    def _raising(self, function: Any) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            error = POINTER(_GError)()
            result = function(*arguments, byref(error))
            if error:
                message = error.contents.message.decode(errors='replace')
                self._glib.g_error_free(error)
                raise AravisError(message)
            return result
        return call

    def unref(self, thing: int | None) -> None:
        if thing:
            self._gobject.g_object_unref(thing)

    def connect_lost(self, device: int, callback: Any) -> int:
        handler: int = self._gobject.g_signal_connect_data(
            device, b'control-lost', callback, None, None, 0)
        return handler

    def strings(self, function: Callable[..., Any], camera: int) -> list[str]:
        """What a dup_available_... function lists."""
        count = c_uint()
        names = function(camera, byref(count))
        found = [names[i].decode() for i in range(count.value)]
        self._glib.g_free(names)
        return found


@functools.cache
def _library() -> _Library:
    return _Library()


def is_installed() -> bool:
    """Whether the library is there, in a version that has all we use."""
    try:
        _library()
    except (OSError, AttributeError):
        return False
    return True


@dataclass(frozen=True)
class RawFrame:
    """One frame as it came.

    :param data: bytes of the picture; None if the frame is damaged or incomplete.
    :param pixel_format: PFNC code.
    :param timestamp_ns: on the camera's clock.
    :param system_ns: when its first packet came, host time.
    """

    data: NDArray | None
    width: int
    height: int
    pixel_format: int
    frame_id: int
    timestamp_ns: int
    system_ns: int


class AravisCamera:
    """One GenICam camera, ready to be triggered.

    :param camera_id: as Aravis lists it, or its IP address; empty: the first one found.
    :raises AravisError: if it is not there or in use; says which cameras there are.
    """

    def __init__(self, camera_id: str) -> None:
        self._lib = lib = _library()
        self._stream: int | None = None
        self._buffers = 0
        self._streaming = False
        #: set once the camera has gone; it must be opened anew then
        self.lost = threading.Event()
        lib.update_device_list()
        try:
            self._camera = lib.camera_new(camera_id.encode() or None)
        except AravisError as error:
            found = [lib.get_device_id(i).decode() for i in range(lib.get_n_devices())]
            raise AravisError(f'{error} (found: {", ".join(found) or "no camera"})') from error
        # kept: C calls it from a thread of Aravis as long as the camera lives
        self._on_lost = _LOST_CALLBACK(lambda *_: self.lost.set())
        lib.connect_lost(lib.camera_get_device(self._camera), self._on_lost)
        self.name = ' '.join(
            (get(self._camera) or b'').decode(errors='replace') for get in (
                lib.camera_get_vendor_name, lib.camera_get_model_name,
                lib.camera_get_device_serial_number))
        if lib.camera_is_exposure_auto_available(self._camera):
            lib.camera_set_exposure_time_auto(self._camera, _AUTO_OFF)
        self.has_gain = bool(lib.camera_is_gain_available(self._camera))
        if self.has_gain and lib.camera_is_gain_auto_available(self._camera):
            lib.camera_set_gain_auto(self._camera, _AUTO_OFF)
        lib.camera_set_acquisition_mode(self._camera, _CONTINUOUS)

    def close(self) -> None:
        """Let go of the camera; not to be used afterwards."""
        if self._camera is None:
            return
        if not self.lost.is_set():
            try:
                self.stop()
            except AravisError:
                self.lost.set()
        self._lib.unref(self._stream)
        self._lib.unref(self._camera)
        self._camera = self._stream = None

    # ------------------------------------------------------------------ settings

    @property
    def pixel_formats(self) -> list[str]:
        """Names of those the camera has."""
        return self._lib.strings(
            self._lib.camera_dup_available_pixel_formats_as_strings, self._camera)

    @property
    def pixel_format(self) -> str:
        """Name of the one in use."""
        name: bytes = self._lib.camera_get_pixel_format_as_string(self._camera)
        return name.decode()

    @pixel_format.setter
    def pixel_format(self, name: str) -> None:
        self._lib.camera_set_pixel_format_from_string(self._camera, name.encode())

    @property
    def trigger_sources(self) -> list[str]:
        """Names of those the camera has."""
        return self._lib.strings(self._lib.camera_dup_available_trigger_sources, self._camera)

    @property
    def trigger_source(self) -> str:
        """Name of the one in use; each trigger is one frame."""
        name: bytes = self._lib.camera_get_trigger_source(self._camera)
        return name.decode()

    @trigger_source.setter
    def trigger_source(self, name: str) -> None:
        self._lib.camera_set_trigger(self._camera, name.encode())

    @property
    def exposure_bounds(self) -> tuple[float, float]:
        """Shortest and longest exposure, s."""
        low, high = self._bounds(self._lib.camera_get_exposure_time_bounds)
        return low * 1e-6, high * 1e-6

    @property
    def exposure(self) -> float:
        """Exposure time, s."""
        return float(self._lib.camera_get_exposure_time(self._camera)) * 1e-6

    @exposure.setter
    def exposure(self, seconds: float) -> None:
        self._lib.camera_set_exposure_time(self._camera, seconds * 1e6)

    @property
    def gain_bounds(self) -> tuple[float, float]:
        """Smallest and largest gain, dB; 0 and 0 where there is none."""
        return self._bounds(self._lib.camera_get_gain_bounds) if self.has_gain else (0.0, 0.0)

    @property
    def gain(self) -> float:
        """Gain, dB."""
        return float(self._lib.camera_get_gain(self._camera)) if self.has_gain else 0.0

    @gain.setter
    def gain(self, decibel: float) -> None:
        if self.has_gain:
            self._lib.camera_set_gain(self._camera, decibel)

    def _bounds(self, function: Callable[..., Any]) -> tuple[float, float]:
        low, high = c_double(), c_double()
        function(self._camera, byref(low), byref(high))
        return low.value, high.value

    # ------------------------------------------------------------------ frames

    def start(self) -> None:
        """Begin to take triggers. Settings that change the size of frames come before."""
        if self._stream is None:
            self._stream = self._lib.camera_create_stream(self._camera, None, None)
        self._lib.camera_start_acquisition(self._camera)
        self._streaming = True

    def stop(self) -> None:
        """Ignore triggers."""
        if self._streaming:
            self._streaming = False
            self._lib.camera_stop_acquisition(self._camera)

    def reserve(self, frames: int) -> None:
        """Throw frames away that have come, and have room for so many."""
        for buffer in iter(lambda: self._lib.stream_try_pop_buffer(self._stream), None):
            self._lib.stream_push_buffer(self._stream, buffer)
        payload = self._lib.camera_get_payload(self._camera) if self._buffers < frames else 0
        while self._buffers < frames:
            self._lib.stream_push_buffer(self._stream, self._lib.buffer_new_allocate(payload))
            self._buffers += 1

    def trigger(self) -> None:
        """Software trigger."""
        self._lib.camera_software_trigger(self._camera)

    def frames(self, timeout: float) -> Iterator[RawFrame]:
        """Frames that have come, or come within the timeout (s) after the one before."""
        while True:
            buffer = self._lib.stream_timeout_pop_buffer(self._stream, round(timeout * 1e6))
            if buffer is None:
                return
            try:
                frame = self._take(buffer)
            finally:
                self._lib.stream_push_buffer(self._stream, buffer)
            yield frame

    def _take(self, buffer: int) -> RawFrame:
        lib = self._lib
        data = None
        if lib.buffer_get_status(buffer) == _SUCCESS:
            size = c_size_t()
            address = lib.buffer_get_data(buffer, byref(size))
            data = np.frombuffer(ctypes.string_at(address, size.value), np.uint8)
        return RawFrame(
            data, lib.buffer_get_image_width(buffer), lib.buffer_get_image_height(buffer),
            lib.buffer_get_image_pixel_format(buffer), lib.buffer_get_frame_id(buffer),
            lib.buffer_get_timestamp(buffer), lib.buffer_get_system_timestamp(buffer))
