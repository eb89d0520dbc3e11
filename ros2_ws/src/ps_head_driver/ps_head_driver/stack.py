"""The photometric stack as plain data: what one capture yields, without ROS.

Mirrors ps_interfaces/PhotometricStack; conversions.py converts between the two, stack_folder.py
reads and writes it as files.
"""
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from ps_head_driver.head_model import CameraGeometry

Vector = tuple[float, float, float]


class Mode(IntEnum):
    """Which ring of panels; values of ps_interfaces/Panel."""

    BRIGHT_FIELD = 0
    DARK_FIELD = 1
    BOTH = 2


class Panel(IntEnum):
    """Which panel of a ring; values of ps_interfaces/Panel. NONE is an ambient frame."""

    E = 0
    N = 1
    W = 2
    S = 3
    ALL = 4
    NONE = 5


class Geometry(IntEnum):
    """How far the light geometry can be trusted; values of ps_interfaces/Panel."""

    NOMINAL = 0
    CALIBRATED = 1
    ASSUMED = 2


def panel_name(mode: Mode, panel: Panel) -> str:
    """As in 'BF_E', 'DF_ALL', 'BOTH_N'."""
    return f'{("BF", "DF", "BOTH")[mode]}_{panel.name}'


@dataclass(frozen=True)
class Light:
    """The light of one frame, in ps_head_plane (metres).

    A distant light has ``distant=True``; then ``axis`` is the unit direction in which its light
    travels (from light to scene) and ``position`` and ``size`` mean nothing.
    """

    panel: Panel = Panel.NONE
    mode: Mode = Mode.BRIGHT_FIELD
    position: Vector = (0.0, 0.0, 0.0)
    axis: Vector = (0.0, 0.0, -1.0)
    right: Vector = (1.0, 0.0, 0.0)
    size: tuple[float, float] = (0.0, 0.0)
    lobe_exponent: float = 1.0
    intensity: float | Vector = 1.0      # relative radiance; three values for RGB (DiLiGenT)
    distant: bool = False
    motor_counts: int = 0
    tilt: float = 0.0
    strobe_duration: float = 0.0         # s
    exposure_time: float = 0.0           # s
    gain: float = 0.0                    # dB
    exposure_scale: float = 1.0          # strobe x gain, relative to the other frames
    strobe_counter: int = 0
    frame_counter: int = 0
    device_time_ns: int = 0
    name: str = ''

    @property
    def is_equation(self) -> bool:
        """Whether the frame is one photometric equation: exactly one panel lit it."""
        return self.distant or (
            self.panel in (Panel.E, Panel.N, Panel.W, Panel.S) and self.mode != Mode.BOTH)


def exposure(light: Light) -> float:
    """Light collected per unit irradiance: the strobe as far as the shutter is open, times the
    gain.
    """
    times = [t for t in (light.strobe_duration, light.exposure_time) if t > 0]
    return (min(times) if times else 1.0) * 10 ** (light.gain / 20)


def with_exposure_scale(lights: Sequence[Light]) -> list[Light]:
    """Set ``exposure_scale`` of every light relative to the longest exposure of the stack."""
    exposures = [exposure(light) for light in lights]
    longest = max(exposures)
    return [replace(light, exposure_scale=own / longest)
            for light, own in zip(lights, exposures, strict=True)]


@dataclass(frozen=True)
class Plane:
    """The real measurement plane in ps_head_plane: normal . x = offset."""

    normal: Vector = (0.0, 0.0, 1.0)
    offset: float = 0.0


@dataclass(frozen=True)
class Pose:
    """Pose of ps_head_link in a frame of the robot; position in metres, quaternion x y z w."""

    frame_id: str = ''
    position: Vector = (0.0, 0.0, 0.0)
    quaternion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Stack:
    """Frames and the light of each.

    :param images: list of (H, W) or (H, W, 3) arrays, uint8, uint16 or float32, linear; RGB order.
        All of one shape and dtype.
    :param lights: one per image, same order.
    :param camera: intrinsics for these images; None where unknown (orthographic view).
    :param ambient: like one image, or None.
    :param mask: (H, W) bool, or None for all pixels.
    :param gain_maps: per image a (h, w) float32 picture of a flat matt board under the same light,
        relative, at any (reduced) resolution over the same field of view; empty list for none.
    """

    images: list[NDArray]
    lights: list[Light]
    camera: CameraGeometry | None = None
    ambient: NDArray | None = None
    mask: NDArray | None = None
    gain_maps: list[NDArray] = field(default_factory=list)
    plane: Plane = Plane()
    geometry: Geometry = Geometry.NOMINAL
    stack_id: str = ''
    session_id: str = ''
    part_id: str = ''
    calibration_id: str = ''
    flat_id: str = ''
    stamp_ns: int = 0
    head_pose: Pose = Pose()
    convergence_radius: float = float('nan')
    light_height: float = float('nan')

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        height, width = self.images[0].shape[:2]
        return height, width

    def equations(self) -> 'Stack':
        """Only the frames that are photometric equations: without ALL, NONE and BOTH frames."""
        keep = [i for i, light in enumerate(self.lights) if light.is_equation]
        return self.subset(keep)

    def subset(self, indices: list[int]) -> 'Stack':
        """Only the frames of the given 0-based indices, in that order."""
        return replace(
            self,
            images=[self.images[i] for i in indices],
            lights=[self.lights[i] for i in indices],
            gain_maps=[self.gain_maps[i] for i in indices] if self.gain_maps else [])


@dataclass(frozen=True)
class Truth:
    """Ground truth of a rendered or benchmark scene.

    :param normal: (H, W, 3) float32, n_plane (x right, y up, z to the viewer), NaN where unknown.
    :param height: (H, W) float32, ps_head_plane z in metres, NaN where unknown; or None.
    """

    normal: NDArray
    height: NDArray | None = None


def angular_error_deg(normal: NDArray, truth: NDArray) -> NDArray:
    """Angle between two fields of unit normals.

    :param normal: (..., 3).
    :param truth: (..., 3), same frame.
    :returns: (...) float, degrees; NaN where either is NaN.
    """
    a, b = np.asarray(normal, np.float64), np.asarray(truth, np.float64)
    # atan2 of cross and dot keeps its precision near zero, where arccos loses it
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1)))
