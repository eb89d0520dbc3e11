"""Pictures of a half-ring target with exactly vertical walls, for trying out the calibration.

The height fields of scenes.py round every edge by a grid pitch; the edge of the ring has to be
sharp to a micrometre. Here rays are followed through the solid itself: base plate, upper face,
walls, slits. Emitters are sampled over each panel and tested one by one, so soft shadows come out
by themselves. Shares no code with the calibration.
"""
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
import math
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from ps_head_driver.camera_model import camera_center, pixel_rays
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.fake.kernels import FAST, KERNEL_LOCK, RUN, TURNS
from ps_head_driver.fake.renderer import OFF, Renderer, Sensor, emitters
from ps_head_driver.fake.scenes import checked_arguments
from ps_head_driver.head_model import HeadModel
from ps_head_driver.kinematics import PanelPose
from ps_head_driver.stack import Truth

_FREE = (6, 4)              # emitters along a panel's width and height where no shadow falls
_PARTS = (5, 3)             # of a panel along width and height, for shadows
_DISTANCE = 1.2e-3          # m; of emitters in a part that is partly hidden, at most
# their numbers: they lie on a lattice of two neighbours of Fibonacci's, so that no edge, however
# it lies, hides whole rows of them at once, as it would of a grid
_FIBONACCI = (13, 21, 34, 55, 89, 144, 233, 377, 610)
_CLEAR = 2.0                # fraction of a way at which nothing is met


def _default_dots() -> NDArray:
    return np.array([[-20.0, -15.0], [20.0, -15.0], [-20.0, 15.0], [20.0, 15.0], [0.0, -17.0],
                     [12.0, -9.0]]) * 1e-3


@dataclass(frozen=True)
class RingSolid:
    """A half ring on a plate, in its own frame (z out of the plate, ring centre at the origin).

    The defaults are the target shipped with ps_calibration.

    :param radii: inner and outer, m.
    :param height: of the wall, m; 0 leaves the plate alone.
    :param arc: first and last azimuth of the wall, at most half a turn apart.
    :param slits: azimuths of the slits.
    :param slit_width: m.
    :param plate: size of the base, m.
    :param dots: (F, 2) centres of printed dots, m.
    :param reflectance: of the wall, the base and the dots.
    """

    radii: tuple[float, float] = (0.010, 0.012)
    height: float = 0.004
    arc: tuple[float, float] = (0.0, math.pi)
    slits: Sequence[float] = (0.2618, 0.7854, 1.5708, 2.3562, 2.8798)
    slit_width: float = 0.0008
    plate: tuple[float, float] = (0.060, 0.050)
    dots: NDArray = field(default_factory=_default_dots)
    dot_radius: float = 0.0008
    reflectance: tuple[float, float, float] = (0.30, 0.80, 0.05)


@dataclass(frozen=True)
class Placement:
    """Where the target's frame is in ps_head_plane.

    :param position: of its origin, m.
    :param rotation: (3, 3); columns are the target's axes.
    """

    position: NDArray
    rotation: NDArray


def placement(x: float = 0.0, y: float = 0.0, z: float = 0.0, turn: float = 0.0,
              tilt_x: float = 0.0, tilt_y: float = 0.0) -> Placement:
    """Place a target.

    :param turn: about its normal, rad.
    :param tilt_x: the plane rises along +x by this, rad; tilt_y the same along +y.
    """
    normal = np.array([-math.tan(tilt_x), -math.tan(tilt_y), 1.0])
    normal /= np.linalg.norm(normal)
    along = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
    along /= np.linalg.norm(along)
    across = np.cross(normal, along)
    c, s = math.cos(turn), math.sin(turn)
    return Placement(np.array([x, y, z]), np.stack(
        [c * along + s * across, -s * along + c * across, normal], axis=1))


@nb.njit(forceinline=True, **FAST)
def _beyond(offset, slope, begin, end):  # type: ignore[no-untyped-def]
    """Part of begin..end in which offset + s * slope is positive; empty if begin >= end."""
    first, last = offset + begin * slope, offset + end * slope
    if first > 0.0 and last > 0.0:
        return begin, end
    if first <= 0.0 and last <= 0.0:
        return end, end
    s = -offset / slope
    return (s, end) if slope > 0.0 else (begin, s)


@nb.njit(forceinline=True, **FAST)
def _past_slit(x, y, dx, dy, begin, end, half_width, slits):  # type: ignore[no-untyped-def]
    """Where the way from begin to end, all within the ring, meets the wall; _CLEAR if nowhere."""
    for k in range(slits.shape[0]):
        offset = slits[k, 0] * y - slits[k, 1] * x
        slope = slits[k, 0] * dy - slits[k, 1] * dx
        if (abs(offset + begin * slope) <= half_width
                and slits[k, 0] * (x + begin * dx) + slits[k, 1] * (y + begin * dy) > 0.0):
            # it starts in this slit
            if abs(offset + end * slope) <= half_width:
                return _CLEAR
            return (math.copysign(half_width, slope) - offset) / slope
    return begin


@nb.njit(forceinline=True, **FAST)
def _meets(x, y, dx, dy, ring, ends, slits):  # type: ignore[no-untyped-def]
    """Fraction of the way (dx, dy) from (x, y) at which the wall is met; _CLEAR if it is not.

    :param ring: inner and outer radius, height, half the width of a slit.
    :param ends: cosine and sine of the wall's first azimuth, and of its last.
    :param slits: (K, 2) cosines and sines of the slits.
    """
    a, b, square = dx * dx + dy * dy, x * dx + y * dy, x * x + y * y
    within = b * b - a * (square - ring[1] * ring[1])
    if within <= 0.0 or a <= 0.0:
        return _CLEAR
    root, per = math.sqrt(within), 1.0 / a
    begin, end = max((-b - root) * per, 0.0), min((-b + root) * per, 1.0)
    if begin >= end:
        return _CLEAR
    begin, end = _beyond(ends[0] * y - ends[1] * x, ends[0] * dy - ends[1] * dx, begin, end)
    begin, end = _beyond(ends[3] * x - ends[2] * y, ends[3] * dx - ends[2] * dy, begin, end)
    if begin >= end:
        return _CLEAR
    # what is left, less the way across the hollow of the ring
    hollow = b * b - a * (square - ring[0] * ring[0])
    if hollow <= 0.0:
        return _past_slit(x, y, dx, dy, begin, end, ring[3], slits)
    root = math.sqrt(hollow)
    first, last = min((-b - root) * per, end), max((-b + root) * per, begin)
    met = _CLEAR
    if begin < first:
        met = _past_slit(x, y, dx, dy, begin, first, ring[3], slits)
    if met == _CLEAR and last < end:
        met = _past_slit(x, y, dx, dy, last, end, ring[3], slits)
    return met


@nb.njit(parallel=True, **FAST)
def _look(origin, rays, ring, ends, slits, plate, dots, dot_radius, reflectance, pixel):  # type: ignore[no-untyped-def]
    """What each ray of the camera meets, in the target frame.

    :returns: (N, 4): point, reflectance.
    """
    out = np.empty((rays.shape[0], 4))
    height = ring[2]
    for k in nb.prange(rays.shape[0]):
        foot = -origin[2] / rays[k, 2]
        crown = (height - origin[2]) / rays[k, 2]
        x, y, z = origin[0] + crown * rays[k, 0], origin[1] + crown * rays[k, 1], height
        dx, dy = (foot - crown) * rays[k, 0], (foot - crown) * rays[k, 1]
        met = _meets(x, y, dx, dy, ring, ends, slits) if height > 0.0 else _CLEAR
        albedo = reflectance[0]
        if met == _CLEAR:
            x, y, z = x + dx, y + dy, 0.0
            albedo = reflectance[1]
            if abs(x) > plate[0] / 2 or abs(y) > plate[1] / 2:
                albedo = 0.0
            for d in range(dots.shape[0]):
                # a pixel on the edge of a dot sees some of both
                beyond = math.hypot(x - dots[d, 0], y - dots[d, 1]) - dot_radius
                part = min(max(0.5 - beyond / pixel, 0.0), 1.0)
                albedo += part * (reflectance[2] - albedo)
        elif met > 0.0:
            # the wall's own shading is of no use to anybody: give it that of a level face; a
            # little in front of it, so that it does not shadow itself by chance
            met -= 1e-6
            x, y, z = x + met * dx, y + met * dy, height * (1.0 - met)
            albedo *= 0.5
        out[k, 0], out[k, 1], out[k, 2], out[k, 3] = x, y, z, albedo
    return out


@nb.njit(forceinline=True, **FAST)
def _emission(dx, dy, dz, axis, lobe):  # type: ignore[no-untyped-def]
    """Irradiance of a level point under a unit of area of the panel, (dx, dy, dz) away."""
    facing = max(-(axis[0] * dx + axis[1] * dy + axis[2] * dz), 0.0)
    nearness = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
    cos_e = facing * nearness
    return (cos_e if lobe is None else cos_e ** lobe) * max(dz, 0.0) * nearness ** 3


@nb.njit(forceinline=True, **FAST)
def _piece(x, y, slits):  # type: ignore[no-untyped-def]
    """Number, from 1, of the piece of wall between slits at (x, y)."""
    piece = 1
    for k in range(slits.shape[0]):
        piece += slits[k, 0] * y - slits[k, 1] * x > 0.0
    return piece


@nb.njit(forceinline=True, **FAST)
def _passes_by(x, y, nodes, ring):  # type: ignore[no-untyped-def]
    """Whether the whole ring lies to the left or to the right of a panel, seen from (x, y)."""
    left = right = True
    last = nodes.shape[1] - 1
    for e in (0, _PARTS[0], last - _PARTS[0], last):
        dx, dy = nodes[0, e] - x, nodes[1, e] - y
        aside = dx * y - dy * x
        width = ring[1] * math.sqrt(dx * dx + dy * dy)
        left, right = left and aside > width, right and aside < -width
    return left or right


@nb.njit(forceinline=True, **FAST)
def _visible(x, y, z, shift, nodes, sides, axis, lobe, lattice, ring, ends, slits, blocked, light):  # type: ignore[no-untyped-def]
    """Part of a panel's light that passes the wall, by the parts of the panel.

    A part whose four corners are free is free; one whose corners are all behind the same piece of
    wall is dark; the others are sampled.

    :param shift: (2,) of the emitters in a part, in fractions of its sides.
    :param nodes: (3, N) corners of the parts; blocked and light are (N,) to work in.
    :param sides: (2, 3) of a part.
    """
    found = False
    for e in range(nodes.shape[1]):
        dx, dy, s = nodes[0, e] - x, nodes[1, e] - y, (ring[2] - z) / (nodes[2, e] - z)
        met = _meets(x, y, s * dx, s * dy, ring, ends, slits)
        blocked[e] = 0
        if met != _CLEAR:
            blocked[e] = _piece(x + met * s * dx, y + met * s * dy, slits)
            found = True
    if not found:
        return 1.0
    for e in range(nodes.shape[1]):
        light[e] = _emission(nodes[0, e] - x, nodes[1, e] - y, nodes[2, e] - z, axis, lobe)
    seen = whole = 0.0
    for j in range(_PARTS[1]):
        for i in range(_PARTS[0]):
            n = j * (_PARTS[0] + 1) + i
            m = n + _PARTS[0] + 1
            a, b, c, d = light[n], light[n + 1], light[m], light[m + 1]
            whole += a + b + c + d
            by = blocked[n]
            if by == blocked[n + 1] and by == blocked[m] and by == blocked[m + 1]:
                seen += a + b + c + d if by == 0 else 0.0
                continue
            free = 0.0
            for e in range(lattice.shape[0]):
                u, v = lattice[e, 0] + shift[0], lattice[e, 1] + shift[1]
                u -= u >= 1.0
                v -= v >= 1.0
                dx = nodes[0, n] - x + u * sides[0, 0] + v * sides[1, 0]
                dy = nodes[1, n] - y + u * sides[0, 1] + v * sides[1, 1]
                dz = nodes[2, n] - z + u * sides[0, 2] + v * sides[1, 2]
                s = (ring[2] - z) / dz
                if _meets(x, y, s * dx, s * dy, ring, ends, slits) == _CLEAR:
                    free += (1.0 - v) * (a + u * (b - a)) + v * (c + u * (d - c))
            seen += 4.0 * free / lattice.shape[0]
    return seen / whole if whole > 0.0 else 0.0


@nb.njit(parallel=True, **FAST)
def _light(points, free, nodes, sides, lattice, axis, lobe, ring, ends, slits):  # type: ignore[no-untyped-def]
    """Irradiance of each point under one panel, all in the target frame.

    :param free: (4, E) emitters: position and area, of the whole panel.
    :param nodes: (3, N) corners of the panel's _PARTS, row by row.
    :param sides: (2, 3) of a part.
    :param lattice: (F, 2) emitters in a part where shadows fall, in fractions of its sides.
    """
    count = points.shape[0]
    out = np.empty(count, np.float32)
    # the farthest shadow falls straight away from the lowest side of the panel
    reach = 0.0
    for e in range(nodes.shape[1]):
        far = math.hypot(nodes[0, e], nodes[1, e]) + ring[1]
        reach = max(reach, far * ring[2] / max(nodes[2, e] - ring[2], 1e-6))
    for turn in nb.prange(TURNS):
        blocked, light = np.empty(nodes.shape[1], np.int8), np.empty(nodes.shape[1])
        for start in range(turn * RUN, count, TURNS * RUN):
            for k in range(start, min(start + RUN, count)):
                x, y, z = points[k, 0], points[k, 1], points[k, 2]
                total = 0.0
                for e in range(free.shape[1]):
                    total += free[3, e] * _emission(free[0, e] - x, free[1, e] - y,
                                                    free[2, e] - z, axis, lobe)
                if (z < ring[2] and x * x + y * y < (ring[1] + reach) ** 2
                        and not _passes_by(x, y, nodes, ring)):
                    # every pixel looks at other points of the panel (an additive sequence in two
                    # dimensions), lest soft shadows become stairs alike in neighbouring pixels
                    shift = (0.7548776662466927 * k % 1.0, 0.5698402909980532 * k % 1.0)
                    total *= _visible(x, y, z, shift, nodes, sides, axis, lobe, lattice, ring,
                                      ends, slits, blocked, light)
                out[k] = total
    return out


class RingRenderer(Renderer):
    """Pictures of one target under one head.

    :param solid: the target as it really is.
    :param where: the target as it really lies.

    The other parameters are those of Renderer.
    """

    def __init__(self, solid: RingSolid, where: Placement, head: HeadModel,
                 sensor: Sensor | None = None, scale: float = 1.0, seed: int = 1) -> None:
        super().__init__(head, sensor, scale, seed)
        self._where = where
        self._ring = (*solid.radii, solid.height, solid.slit_width / 2)
        self._ends = tuple(f(a) for a in solid.arc for f in (math.cos, math.sin))
        self._slits = np.array([[math.cos(a), math.sin(a)] for a in solid.slits]).reshape(-1, 2)
        v, u = np.mgrid[:self.shape[0], :self.shape[1]]
        rays = pixel_rays(self.camera, np.stack([u, v], axis=-1)).reshape(-1, 3)
        with KERNEL_LOCK:
            self._points = _look(
                (camera_center(self.camera) - where.position) @ where.rotation,
                rays @ where.rotation, self._ring, self._ends, self._slits,
                np.array(solid.plate), np.asarray(solid.dots, np.float64).reshape(-1, 2),
                solid.dot_radius, np.array(solid.reflectance),
                self.camera.camera_standoff / self.camera.fx)

    @property
    def albedo(self) -> NDArray:
        """Diffuse reflectance of what each pixel sees, (H, W) float32."""
        return self._points[:, 3].astype(np.float32).reshape(self.shape)

    def truth(self) -> Truth:
        """True normals (n_plane) and heights; NaN normals on the vertical walls."""
        points, where = self._points[:, :3], self._where
        height = points @ where.rotation[2] + where.position[2]
        normal = np.tile(where.rotation[:, 2].astype(np.float32), (len(points), 1))
        normal[(points[:, 2] > 0) & (points[:, 2] < self._ring[2])] = np.nan
        return Truth(normal=normal.reshape(*self.shape, 3),
                     height=height.astype(np.float32).reshape(self.shape))

    def warm_up(self) -> None:
        """Compile the kernels now, not with the first picture."""
        self._irradiance(self._points[:1], self._bright.panel_pose('E', 0.5))

    def _trace(self, pose: PanelPose) -> NDArray:
        radiance = (self._irradiance(self._points, pose) * self._points[:, 3]
                    * pose.intensity / math.pi)
        return np.asarray(radiance.astype(np.float32).reshape(self.shape))

    def _irradiance(self, points: NDArray, pose: PanelPose) -> NDArray:
        """Irradiance of points in the target frame under a panel of unit radiance, (N,)."""
        where = self._where
        free = emitters(pose, _FREE, gauss=True)[0]
        free[:3] = where.rotation.T @ (free[:3] - where.position[:, None])
        sides = np.stack([pose.size[0] * pose.right,
                          pose.size[1] * np.cross(pose.axis, pose.right)]) @ where.rotation
        centre = (pose.center - where.position) @ where.rotation
        u, v = (grid.ravel() for grid in np.meshgrid(*(np.linspace(-0.5, 0.5, n + 1)
                                                       for n in _PARTS)))
        nodes = centre[:, None] + sides.T @ np.stack([u, v])
        wanted = pose.size[0] * pose.size[1] / math.prod(_PARTS) / _DISTANCE ** 2
        n = 1 + min(int(np.searchsorted(_FIBONACCI[1:], wanted)), len(_FIBONACCI) - 2)
        e = np.arange(_FIBONACCI[n])
        lattice = np.stack([e, _FIBONACCI[n - 1] * e % len(e)], axis=1) / len(e)
        lobe = None if pose.lobe_exponent == 1 else pose.lobe_exponent
        with KERNEL_LOCK:
            return np.asarray(_light(
                points, free, nodes, sides / np.array(_PARTS)[:, None], lattice,
                pose.axis @ where.rotation, lobe, self._ring, self._ends, self._slits))

    def capture(self, tilt: float, exposure: float = 1.0) -> list[NDArray]:
        """The six pictures of a calibration: E, N, W, S, ALL at a quarter exposure, NONE.

        :param tilt: of the bright-field panels, rad.
        :param exposure: of the single-light pictures, relative to the sensor's own.
        """
        frames: list[tuple[Sequence[float], float]] = [
            *((list(levels), 1.0) for levels in np.eye(4)), ((1.0,) * 4, 0.25), (OFF, 1.0)]
        return [self.render(tilt, 0.0, levels, exposure=self.sensor.exposure * exposure * part,
                            frame=i) for i, (levels, part) in enumerate(frames)]


DEFECTS = ('none', 'no_wall', 'turned_over', 'blocked_slit')


def make_ring_renderer(name: str, arguments: dict[str, Any], head: HeadModel,
                       sensor: Sensor | None, scale: float, seed: int) -> RingRenderer:
    """Renderer of the scene ``ring``: the shipped half ring as it lies under the head.

    :raises PsError: SEQUENCER_BAD_REQUEST for an unknown argument.
    """
    solid, where = _ring_scene(**checked_arguments(name, _ring_scene, arguments, given=0))
    return RingRenderer(solid, where, head, sensor, scale, seed)


def _ring_scene(x: float = 0.0, y: float = 0.0, z: float = 0.0, turn: float = 0.0,
                tilt_x: float = 0.0, tilt_y: float = 0.0, inner_radius: float = 0.010,
                outer_radius: float = 0.012, height: float = 0.004,
                defect: str = 'none') -> tuple[RingSolid, Placement]:
    """The half ring off its place (m, rad), of other dimensions, or with a defect."""
    if defect not in DEFECTS:
        raise PsError(ErrorCode.SEQUENCER_BAD_REQUEST,
                      f'scene ring: defect {defect!r} is not one of {", ".join(DEFECTS)}')
    solid = RingSolid(radii=(inner_radius, outer_radius), height=height)
    if defect == 'no_wall':
        solid = replace(solid, height=0.0)
    elif defect == 'turned_over':
        # the plate's blank back, as high as the wall it stands on
        solid, z = replace(solid, height=0.0, dots=np.empty((0, 2))), z + height
    elif defect == 'blocked_slit':
        middle = len(solid.slits) // 2
        solid = replace(solid, slits=[*solid.slits[:middle], *solid.slits[middle + 1:]])
    return solid, placement(x, y, z, turn, tilt_x, tilt_y)
