"""Folder camera: plays the pictures of a folder, each when its panel is asked for."""
from collections.abc import Sequence
from pathlib import Path
import time

from numpy.typing import NDArray

from ps_head_driver.cameras.base import Camera, Frame, Light
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.head_model import CameraGeometry
from ps_head_driver.stack import Mode, Panel, Stack
from ps_head_driver.stack_folder import read_stack


class FolderCamera(Camera):
    """A stack folder or four-direction folder in place of a camera.

    The pictures were taken elsewhere, so light geometry, intrinsics and flat field come from the
    folder too: :attr:`source_stack`. Needs no trigger: the frames are there once it is armed.

    :param path: see stack_folder.py for what it may hold.
    :param slant: assumed angle of the light to the optical axis where the folder states none, rad.
    """

    def __init__(self, path: str | Path, slant: float) -> None:
        self._path, self._slant = Path(path), slant
        self._stack: Stack | None = None
        self._frames: list[Frame] = []
        self._frame_counter = 0

    def open(self) -> None:
        """Read the folder.

        :raises PsError: as of read_stack; SEQUENCER_BAD_REQUEST if no picture belongs to a panel.
        """
        stack, _ = read_stack(self._path, slant=self._slant)
        if not any(light.is_equation and not _any_direction(stack, i)
                   for i, light in enumerate(stack.lights)):
            raise PsError(ErrorCode.SEQUENCER_BAD_REQUEST,
                          f'{self._path}: none of its pictures belongs to a panel E, N, W or S, '
                          'so a recipe cannot ask for them; use ps_reconstruct for such a folder')
        self._stack = stack

    def close(self) -> None:
        """Forget the pictures."""
        self._stack, self._frames = None, []

    @property
    def camera_geometry(self) -> CameraGeometry | None:
        """Intrinsics stated in the folder."""
        return self._stack.camera if self._stack else None

    @property
    def source_stack(self) -> Stack | None:
        """The whole folder as a stack; None while closed."""
        return self._stack

    def arm(self, exposures: Sequence[float], panels: Sequence[Light] | None = None,
            gain: float = 0.0, software_trigger: bool = False) -> None:
        """Choose the pictures of the given panels, or the first ones if none are given.

        :raises PsError: SEQUENCER_BAD_REQUEST if the folder lacks a picture; names those it has.
        """
        stack = self._stack
        if stack is None:
            raise PsError(ErrorCode.SEQUENCER_CAMERA_LOST, 'the folder camera is not open')
        if panels is not None:
            images = [self._image(stack, light) for light in panels]
        elif len(exposures) <= len(stack.images):
            images = stack.images[:len(exposures)]
        else:
            raise PsError(ErrorCode.SEQUENCER_BAD_REQUEST,
                          f'{self._path}: {len(exposures)} frames asked for, but it has '
                          f'{len(stack.images)} pictures')
        now, self._frames = time.time_ns(), []
        for image, exposure in zip(images, exposures, strict=True):
            self._frame_counter += 1
            self._frames.append(Frame(
                image=image, frame_counter=self._frame_counter, trigger_counter=None,
                device_time_ns=None, host_time_ns=now, exposure_time=exposure, gain=gain))

    def trigger(self) -> None:
        """Nothing to do: the picture is there."""

    def collect(self, count: int, timeout: float) -> list[Frame]:
        """All frames of the armed sequence; they need no waiting."""
        return list(self._frames)

    def disarm(self) -> None:
        """Forget the chosen pictures."""
        self._frames = []

    def cancel(self) -> None:
        """Nothing waits here."""

    def _image(self, stack: Stack, wanted: Light) -> NDArray:
        """Picture of one panel, or of the ambient light."""
        for i, light in enumerate(stack.lights):
            if (light.mode, light.panel) == wanted and not _any_direction(stack, i):
                return stack.images[i]
        if wanted[1] == Panel.NONE and stack.ambient is not None:
            return stack.ambient
        here = [_name((light.mode, light.panel)) for i, light in enumerate(stack.lights)
                if not _any_direction(stack, i)]
        here += ['ambient (NONE)'] if stack.ambient is not None else []
        raise PsError(ErrorCode.SEQUENCER_BAD_REQUEST,
                      f'{self._path} has no picture of panel {_name(wanted)}; it has '
                      + ', '.join(here) + '; choose a recipe that asks for these only')


def _any_direction(stack: Stack, index: int) -> bool:
    """Whether a picture's light is a mere direction that belongs to no panel."""
    light = stack.lights[index]
    return light.distant and light.panel == Panel.NONE


def _name(light: Light) -> str:
    mode, panel = light
    return f'{Mode(mode).name} {Panel(panel).name}'
