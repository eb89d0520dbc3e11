"""Crank-slider kinematics of the bright-field panels and the servo tilt of the dark-field panels.

All in ps_head_plane (x right, y up, z towards the camera), metres and radians. The crank-slider of
one panel moves in the plane through the optical axis at the panel's azimuth; (r, z) are its
coordinates there (paper, section 2.1).
"""
from dataclasses import dataclass
import math
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.head_model import DIRECTIONS, BrightField, DarkField, Direction, HeadModel
from ps_head_driver.stack import Light, Mode, Panel

# closer to a dead point than this (rad of crank angle) the tilt is not defined by the motor
DEAD_POINT_MARGIN = 1e-3
_VERTICAL = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class PanelPose:
    """Where one panel is: centre, unit axis out of its face, unit width direction; each (3,)."""

    center: NDArray
    axis: NDArray
    right: NDArray
    size: tuple[float, float]      # width, height, m
    lobe_exponent: float
    intensity: float


class PanelRing:
    """The four panels of a ring, E N W S, as functions of their common tilt.

    The tolerances of a panel come on top of the nominal geometry: ``tilt_offset`` adds to the
    tilt, ``twist`` turns it about the vertical through the hinge, ``shift`` moves it along its
    radial, tangential and z axes.
    """

    def __init__(self, field: BrightField | DarkField) -> None:
        own = [field.panels[name] for name in DIRECTIONS]
        self.size, self.lobe_exponent = field.panel_size, field.lobe_exponent
        self.intensities = [panel.intensity for panel in own]
        self._tilt_offset = np.array([panel.tilt_offset for panel in own])
        azimuth = np.array([panel.azimuth for panel in own])
        twisted = azimuth + [panel.twist for panel in own]
        self.radial, tangential = _turned(azimuth)
        self._outward, self.right = _turned(twisted)
        hinge = field.hinge if isinstance(field, BrightField) else field.pivot
        shift = np.array([panel.shift for panel in own])
        self.hinges = ((hinge.r + shift[:, :1]) * self.radial + shift[:, 1:2] * tangential
                       + (hinge.z + shift[:, 2:]) * _VERTICAL)
        arm = (field.arm.along, field.arm.out) if isinstance(field, BrightField) else (0.0, 0.0)
        #: what the compiled function axes() wants to know
        self.arrays = (self._tilt_offset, self.hinges, self._outward, *arm)

    def axes(self, tilt: ArrayLike) -> tuple[NDArray, NDArray]:
        """Centres and unit axes at nominal tilts.

        :param tilt: (...), rad; axis = -sin(tilt) radial - cos(tilt) z.
        :returns: (..., 4, 3) and (..., 4, 3).
        """
        tilt = np.asarray(tilt, np.float64)
        center, axis = axes(np.atleast_1d(tilt).ravel(), *self.arrays)
        return center.reshape(*tilt.shape, 4, 3), axis.reshape(*tilt.shape, 4, 3)

    def pose(self, direction: Direction, tilt: float) -> PanelPose:
        """Pose of one panel at a nominal tilt, rad."""
        index = DIRECTIONS.index(direction)
        center, axis = self.axes(tilt)
        return PanelPose(center=center[index], axis=axis[index], right=self.right[index],
                         size=self.size, lobe_exponent=self.lobe_exponent,
                         intensity=self.intensities[index])

    def poses(self, tilt: float) -> list[PanelPose]:
        """Poses of all panels, E N W S, at a nominal tilt, rad."""
        return [self.pose(direction, tilt) for direction in DIRECTIONS]


@nb.njit(cache=True)
def axes(tilt, offset, hinge, outward, along, out):  # type: ignore[no-untyped-def]
    """Centres and axes (n, 4, 3) at tilts (n,); the panels' own data as in PanelRing."""
    center, axis = np.empty((len(tilt), 4, 3)), np.empty((len(tilt), 4, 3))
    for i in range(len(tilt)):
        for k in range(4):
            sine, cosine = math.sin(tilt[i] + offset[k]), math.cos(tilt[i] + offset[k])
            for c in range(3):
                vertical = 1.0 if c == 2 else 0.0
                axis[i, k, c] = -sine * outward[k, c] - cosine * vertical
                center[i, k, c] = (hinge[k, c] + out * axis[i, k, c]
                                   + along * (cosine * outward[k, c] - sine * vertical))
    return center, axis


@nb.njit(cache=True)
def _crank_angles(dz, dx, radius, rod, branch):  # type: ignore[no-untyped-def]
    """Crank angles (n,) with the slider joint (dx, dz) from the hinge; NaN out of reach."""
    angle = np.empty(len(dz))
    for i in range(len(dz)):
        distance = math.hypot(dx, dz[i])
        cosine = (radius**2 + distance**2 - rod**2) / (2 * radius * distance)
        angle[i] = np.nan if abs(cosine) > 1 else (
            branch * math.acos(cosine) - math.atan2(dz[i], dx))
    return angle


@nb.njit(cache=True)
def tilts(m, loop):  # type: ignore[no-untyped-def]
    """Tilts (n,) at motor positions (n,); ``loop`` as in BrightFieldKinematics."""
    z, dz_dm, m0, dx, radius, rod, branch, angle_at_m0, tilt_at_m0 = loop
    turned = _crank_angles(z + dz_dm * (m - m0), dx, radius, rod, branch) - angle_at_m0
    return tilt_at_m0 - ((math.pi - turned) % (2 * math.pi) - math.pi)


def _turned(azimuth: NDArray) -> tuple[NDArray, NDArray]:
    """Radial and tangential unit vectors (n, 3) at azimuths (n,)."""
    c, s, zero = np.cos(azimuth), np.sin(azimuth), np.zeros_like(azimuth)
    return np.stack([c, s, zero], axis=1), np.stack([-s, c, zero], axis=1)


class BrightFieldKinematics:
    """Loop closure of the crank-slider: tilt from motor counts and back, exactly.

    The assembly branch is the one on which the head is at ``m0_counts``; the range of the motor is
    cut off at dead points (rod and crank collinear), so a branch is never silently crossed.

    :raises PsError: HEAD_BAD_REQUEST if the parts cannot be assembled at ``m0_counts``.
    """

    def __init__(self, head: HeadModel) -> None:
        field = head.bright_field
        self.ring = PanelRing(field)
        self._hinge = np.array([field.hinge.r, field.hinge.z])
        self._radius, self._offset = field.crank.radius, field.crank.offset
        self._rod, self._slider = field.rod_length, field.slider
        self._dz_dm = field.slider.direction / field.slider.counts_per_metre
        self._dx = field.slider.r - field.hinge.r
        try:
            candidates = [self._crank_angle(self._height(field.slider.m0_counts), branch)
                          for branch in (-1, 1)]
        except PsError as error:
            raise PsError(ErrorCode.HEAD_BAD_REQUEST,
                          f'{head.name}: bright_field: crank, rod and slider cannot be assembled '
                          'at m0_counts') from error
        tilts = [_wrap(angle - self._offset) for angle in candidates]
        # of the two the one nearer to facing down
        low, high = field.tilt_range
        middle = 0.0 if low <= 0.0 <= high else (low + high) / 2
        chosen = int(np.argmin([abs(tilt - middle) for tilt in tilts]))
        self._branch, self._tilt_at_m0 = (-1, 1)[chosen], float(tilts[chosen])
        self._angle_at_m0 = float(candidates[chosen])
        #: what the compiled function tilts() wants to know
        self.loop = (self._slider.z_at_m0 - float(self._hinge[1]), self._dz_dm,
                     float(self._slider.m0_counts), self._dx, self._radius, self._rod,
                     self._branch, self._angle_at_m0, self._tilt_at_m0)
        self.limits_counts = self._usable_interval()

    def _height(self, m_counts: ArrayLike) -> Any:
        return self._slider.z_at_m0 + self._dz_dm * (
            np.asarray(m_counts, np.float64) - self._slider.m0_counts)

    def _crank_angle(self, slider_z: ArrayLike, branch: int) -> Any:
        """Angle a of the pin, pin = hinge + radius (cos a, -sin a), on one assembly branch."""
        dz = np.asarray(slider_z, np.float64) - self._hinge[1]
        angle = _crank_angles(np.atleast_1d(dz).ravel(), self._dx, self._radius, self._rod, branch)
        if np.isnan(angle).any():
            raise PsError(ErrorCode.CR_OUT_OF_LIMITS,
                          'the rod does not reach from the slider to the crank there')
        return angle.reshape(dz.shape)[()]

    def _usable_interval(self) -> tuple[int, int]:
        """Soft limits, cut off before the next dead points on either side of ``m0_counts``."""
        # rod and crank are in line where slider and hinge are |rod - crank| or rod + crank apart
        across = self._radius * math.sin(DEAD_POINT_MARGIN)
        if self._rod > across:
            reach = math.sqrt(self._rod**2 - across**2)
            along = self._radius * math.cos(DEAD_POINT_MARGIN)
            nearest, farthest = abs(reach - along), reach + along
            start = self._slider.z_at_m0 - self._hinge[1]
            if nearest < math.hypot(self._dx, start) < farthest:
                end = math.sqrt(farthest**2 - self._dx**2)
                hole = math.sqrt(max(nearest**2 - self._dx**2, 0.0))
                # without a hole around the hinge the slider may pass it
                dz = (-end, end) if nearest <= abs(self._dx) else (
                    (hole, end) if start > 0 else (-end, -hole))
                m = sorted(self._slider.m0_counts + (z - start) / self._dz_dm for z in dz)
                low, high = self._slider.limits_counts
                low, high = max(low, math.ceil(m[0])), min(high, math.floor(m[1]))
                if low < high:
                    return low, high
        raise PsError(ErrorCode.HEAD_BAD_REQUEST,
                      'bright_field: m0_counts is at a dead point of the crank, or all of '
                      'limits_counts is beyond one')

    def check_counts(self, m_counts: ArrayLike) -> None:
        """Refuse motor counts outside the usable interval.

        :raises PsError: CR_OUT_OF_LIMITS with the interval.
        """
        m = np.asarray(m_counts)
        low, high = self.limits_counts
        if m.size and not (m.min() >= low and m.max() <= high):
            wrong = m[~((m >= low) & (m <= high))].ravel()[0]
            raise PsError(ErrorCode.CR_OUT_OF_LIMITS,
                          f'motor counts {wrong:g} are outside {low} to {high}')

    def tilt(self, m_counts: ArrayLike) -> Any:
        """Nominal tilt of all four panels, rad; 0 faces straight down.

        :param m_counts: scalar or array.
        :raises PsError: CR_OUT_OF_LIMITS.
        """
        self.check_counts(m_counts)
        m = np.asarray(m_counts, np.float64)
        return tilts(np.atleast_1d(m).ravel(), self.loop).reshape(m.shape)[()]

    def dtilt_dm(self, m_counts: ArrayLike) -> Any:
        """Exact derivative of the tilt, rad per count."""
        self.check_counts(m_counts)
        z = self._height(m_counts)
        angle = self._crank_angle(z, self._branch)
        dz = z - self._hinge[1]
        sine, cosine = np.sin(angle), np.cos(angle)
        return -(dz + self._radius * sine) / (
            self._radius * (sine * self._dx + cosine * dz)) * self._dz_dm

    def motor_position(self, tilt: ArrayLike) -> Any:
        """Motor counts for a tilt, not rounded.

        :raises PsError: HEAD_OUT_OF_LIMITS if the tilt cannot be reached.
        """
        angle = np.asarray(tilt, np.float64) + self._offset
        pin_r = self._hinge[0] + self._radius * np.cos(angle)
        pin_z = self._hinge[1] - self._radius * np.sin(angle)
        below = self._rod**2 - (self._slider.r - pin_r)**2
        if np.all(below >= 0):
            m = self._slider.m0_counts + (
                pin_z + np.sqrt(below) - self._slider.z_at_m0) / self._dz_dm
            first, last = self.limits_counts
            if np.all((m >= first - 0.5) & (m <= last + 0.5)):
                m = np.clip(m, first, last)
                if np.allclose(self.tilt(m), tilt, rtol=0, atol=1e-4):
                    return m
        low, high = self.tilt_limits
        raise PsError(ErrorCode.HEAD_OUT_OF_LIMITS,
                      f'tilt {np.degrees(np.max(tilt)):.2f} deg cannot be reached; the motor '
                      f'covers {math.degrees(low):.2f} to {math.degrees(high):.2f} deg')

    def motor_counts(self, tilt: float) -> int:
        """Motor counts nearest to a tilt (rad)."""
        return int(np.round(self.motor_position(tilt)))

    @property
    def tilt_limits(self) -> tuple[float, float]:
        """Smallest and largest tilt the motor reaches, rad."""
        ends = [float(self.tilt(m)) for m in self.limits_counts]
        return min(ends), max(ends)

    def panel_pose(self, direction: Direction, tilt: float) -> PanelPose:
        """Pose of one panel at a nominal tilt (rad), its own tolerances included."""
        return self.ring.pose(direction, tilt)


class DarkFieldKinematics:
    """The dark-field panels, turned about their pivots by a servo."""

    def __init__(self, head: HeadModel) -> None:
        self.ring = PanelRing(head.dark_field)
        self.tilt_limits = head.dark_field.tilt_range

    def panel_pose(self, direction: Direction, tilt: float) -> PanelPose:
        """Pose of one panel at a nominal tilt (rad), its own tolerances included."""
        return self.ring.pose(direction, tilt)


def lights_at(head: HeadModel, m_counts: int, dark_field_tilt: float) -> list[Light]:
    """The eight panels, BF E N W S then DF E N W S, at one position of the head.

    :param m_counts: motor counts.
    :param dark_field_tilt: rad.
    :raises PsError: CR_OUT_OF_LIMITS.
    """
    bright, dark = BrightFieldKinematics(head), DarkFieldKinematics(head)
    lights = []
    for mode, prefix, ring, angle in (
            (Mode.BRIGHT_FIELD, 'BF', bright.ring, float(bright.tilt(m_counts))),
            (Mode.DARK_FIELD, 'DF', dark.ring, dark_field_tilt)):
        for name, pose in zip(DIRECTIONS, ring.poses(angle), strict=True):
            lights.append(as_light(pose, name=f'{prefix}_{name}', mode=mode, panel=Panel[name],
                                   motor_counts=int(m_counts), tilt=angle))
    return lights


def as_light(pose: PanelPose, **known: Any) -> Light:
    """A panel as the light of a frame.

    :param known: what else is known of the frame, fields of Light.
    """
    return Light(position=_vector(pose.center), axis=_vector(pose.axis),
                 right=_vector(pose.right), size=pose.size, lobe_exponent=pose.lobe_exponent,
                 intensity=pose.intensity, **known)


def _vector(array: NDArray) -> tuple[float, float, float]:
    return float(array[0]), float(array[1]), float(array[2])


def _wrap(angle: Any) -> Any:
    """Angle in (-pi, pi]."""
    return -((-angle + math.pi) % (2 * math.pi) - math.pi)
