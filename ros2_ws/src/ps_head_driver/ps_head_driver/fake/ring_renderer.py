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
from ps_head_driver.fake.kernels import KERNEL_LOCK
from ps_head_driver.fake.renderer import OFF, Renderer, Sensor, emitters
from ps_head_driver.fake.scenes import checked_arguments
from ps_head_driver.head_model import HeadModel
from ps_head_driver.kinematics import PanelPose
from ps_head_driver.stack import Truth

_FREE = (6, 4)              # emitters along a panel's width and height where no shadow falls
# and elsewhere, on a lattice of two neighbours of Fibonacci's: no edge, however it lies, hides
# whole rows of it at once, as it would of a grid along the sides of the panel
_SHADOWED, _TURN = 610, 377
_PROBES = (7, 5)            # on its edges and inside: where all are free, nothing is in the way


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


@nb.njit(cache=True)
def _solid(x, y, ring, ends, slits):  # type: ignore[no-untyped-def]
    """Whether the wall stands above (x, y)."""
    square = x * x + y * y
    if square < ring[0] * ring[0] or square > ring[1] * ring[1]:
        return False
    if ends[0] * y - ends[1] * x < 0.0 or x * ends[3] - y * ends[2] < 0.0:
        return False
    for k in range(slits.shape[0]):
        if (abs(slits[k, 0] * y - slits[k, 1] * x) < ring[3]
                and slits[k, 0] * x + slits[k, 1] * y > 0.0):
            return False
    return True


@nb.njit(cache=True)
def _crossings(x, y, dx, dy, ring, ends, slits, out):  # type: ignore[no-untyped-def]
    """Fractions 0..1 of the way (dx, dy) from (x, y) at which a face may be crossed, sorted."""
    n = 0
    a, b = dx * dx + dy * dy, x * dx + y * dy
    for k in range(2):
        c = x * x + y * y - ring[k] * ring[k]
        inside = b * b - a * c
        if inside > 0.0 and a > 0.0:
            root = math.sqrt(inside)
            for s in ((-b - root) / a, (-b + root) / a):
                if 0.0 < s < 1.0:
                    out[n] = s
                    n += 1
    for k in range(2):
        slope = ends[2 * k] * dy - ends[2 * k + 1] * dx
        if slope != 0.0:
            s = -(ends[2 * k] * y - ends[2 * k + 1] * x) / slope
            if 0.0 < s < 1.0:
                out[n] = s
                n += 1
    for k in range(slits.shape[0]):
        slope = slits[k, 0] * dy - slits[k, 1] * dx
        if slope != 0.0:
            offset = slits[k, 0] * y - slits[k, 1] * x
            for s in ((ring[3] - offset) / slope, (-ring[3] - offset) / slope):
                if 0.0 < s < 1.0:
                    out[n] = s
                    n += 1
    out[:n].sort()
    return n


@nb.njit(cache=True)
def _enters(x, y, dx, dy, ring, ends, slits, buffer):  # type: ignore[no-untyped-def]
    """Fraction of the way at which the wall is first met; 2 if it is not."""
    if _solid(x, y, ring, ends, slits):
        return 0.0
    # most ways stay clear of the whole ring
    a, b, square = dx * dx + dy * dy, x * dx + y * dy, x * x + y * y
    s = min(max(-b / a, 0.0), 1.0)
    if square + s * (2.0 * b + s * a) > ring[1] * ring[1]:
        return 2.0
    if max(square, square + 2.0 * b + a) < ring[0] * ring[0]:
        return 2.0
    n = _crossings(x, y, dx, dy, ring, ends, slits, buffer)
    for k in range(n):
        after = 0.5 * (buffer[k] + (buffer[k + 1] if k + 1 < n else 1.0))
        if _solid(x + after * dx, y + after * dy, ring, ends, slits):
            return buffer[k]
    return 2.0


@nb.njit(cache=True, inline='always')
def _beyond(offset, slope, begin, end):  # type: ignore[no-untyped-def]
    """Part of begin..end in which offset + s * slope is positive."""
    if slope == 0.0:
        return (begin, end) if offset > 0.0 else (1.0, 0.0)
    s = -offset / slope
    return (max(begin, s), end) if slope > 0.0 else (begin, min(end, s))


@nb.njit(cache=True)
def _passes_slit(x, y, dx, dy, begin, end, half_width, slits):  # type: ignore[no-untyped-def]
    """Whether the way from begin to end, all within the ring, lies in one slit."""
    for k in range(slits.shape[0]):
        offset = slits[k, 0] * y - slits[k, 1] * x
        slope = slits[k, 0] * dy - slits[k, 1] * dx
        if (abs(offset + begin * slope) <= half_width and abs(offset + end * slope) <= half_width
                and slits[k, 0] * (x + begin * dx) + slits[k, 1] * (y + begin * dy) > 0.0):
            return True
    return False


@nb.njit(cache=True)
def _blocked(x, y, dx, dy, ring, ends, slits):  # type: ignore[no-untyped-def]
    """Whether the way (dx, dy) from (x, y) meets the wall; the same answer as _enters, sooner."""
    a, b, square = dx * dx + dy * dy, x * dx + y * dy, x * x + y * y
    within = b * b - a * (square - ring[1] * ring[1])
    if within <= 0.0 or a <= 0.0:
        return False
    root = math.sqrt(within)
    begin, end = max((-b - root) / a, 0.0), min((-b + root) / a, 1.0)
    begin, end = _beyond(ends[0] * y - ends[1] * x, ends[0] * dy - ends[1] * dx, begin, end)
    begin, end = _beyond(ends[3] * x - ends[2] * y, ends[3] * dx - ends[2] * dy, begin, end)
    if begin >= end:
        return False
    # what is left, less the way across the hollow of the ring
    hollow = b * b - a * (square - ring[0] * ring[0])
    if hollow <= 0.0:
        return not _passes_slit(x, y, dx, dy, begin, end, ring[3], slits)
    root = math.sqrt(hollow)
    first, last = min((-b - root) / a, end), max((-b + root) / a, begin)
    return ((begin < first and not _passes_slit(x, y, dx, dy, begin, first, ring[3], slits))
            or (last < end and not _passes_slit(x, y, dx, dy, last, end, ring[3], slits)))


@nb.njit(cache=True, parallel=True)
def _look(origin, rays, ring, ends, slits, plate, dots, dot_radius, reflectance, pixel):  # type: ignore[no-untyped-def]
    """What each ray of the camera meets, in the target frame.

    :returns: (N, 7): point, normal, reflectance.
    """
    out = np.zeros((rays.shape[0], 7))
    height = ring[2]
    for k in nb.prange(rays.shape[0]):
        buffer = np.empty(32)
        foot = -origin[2] / rays[k, 2]
        crown = (height - origin[2]) / rays[k, 2]
        x, y = origin[0] + crown * rays[k, 0], origin[1] + crown * rays[k, 1]
        dx, dy = (foot - crown) * rays[k, 0], (foot - crown) * rays[k, 1]
        met = _enters(x, y, dx, dy, ring, ends, slits, buffer) if height > 0.0 else 2.0
        if met == 0.0:
            out[k] = np.array([x, y, height, 0.0, 0.0, 1.0, reflectance[0]])
        elif met < 1.0:
            # the wall's own shading is of no use to anybody: give it that of a level face; a
            # little in front of it, so that it does not shadow itself by chance
            met -= 1e-6
            out[k] = np.array([x + met * dx, y + met * dy, height * (1.0 - met),
                               0.0, 0.0, 1.0, 0.5 * reflectance[0]])
        else:
            x, y = x + dx, y + dy
            albedo = reflectance[1]
            if abs(x) > plate[0] / 2 or abs(y) > plate[1] / 2:
                albedo = 0.0
            for d in range(dots.shape[0]):
                # a pixel on the edge of a dot sees some of both
                beyond = math.hypot(x - dots[d, 0], y - dots[d, 1]) - dot_radius
                part = min(max(0.5 - beyond / pixel, 0.0), 1.0)
                albedo += part * (reflectance[2] - albedo)
            out[k] = np.array([x, y, 0.0, 0.0, 0.0, 1.0, albedo])
    return out


@nb.njit(cache=True, inline='always')
def _emission(point, dx, dy, dz, axis, lobe):  # type: ignore[no-untyped-def]
    """Irradiance of a point under a unit of area of the panel, (dx, dy, dz) away."""
    facing = -(axis[0] * dx + axis[1] * dy + axis[2] * dz)
    steep = point[3] * dx + point[4] * dy + point[5] * dz
    if facing <= 0.0 or steep <= 0.0:
        return 0.0
    square = dx * dx + dy * dy + dz * dz
    distance = math.sqrt(square)
    cos_e = facing / distance
    return (cos_e if lobe == 1.0 else cos_e ** lobe) * steep / (distance * square)


@nb.njit(cache=True, parallel=True)
def _light(points, free, probes, shadowed, corner, sides, axis, lobe, ring, ends, slits):  # type: ignore[no-untyped-def]
    """Irradiance of each point under one panel, all in the target frame.

    :param shadowed: (E, 2) emitters where shadows fall, in fractions of the panel's sides.
    :param corner: (3,) of the panel, from which its sides (2, 3) run.
    """
    out = np.zeros(points.shape[0], np.float32)
    height = ring[2]
    # the farthest shadow falls straight away from the lowest side of the panel
    reach = 0.0
    for e in range(probes.shape[0]):
        way = math.hypot(probes[e, 0], probes[e, 1]) + ring[1]
        reach = max(reach, way * height / max(probes[e, 2] - height, 1e-6))
    for k in nb.prange(points.shape[0]):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        total = 0.0
        for e in range(free.shape[0]):
            total += free[e, 3] * _emission(points[k], free[e, 0] - x, free[e, 1] - y,
                                            free[e, 2] - z, axis, lobe)
        # the sides and the middle of the panel tell whether any shadow falls here
        near = False
        if z < height and math.hypot(x, y) < ring[1] + reach:
            for e in range(probes.shape[0]):
                dx, dy = probes[e, 0] - x, probes[e, 1] - y
                s = (height - z) / (probes[e, 2] - z)
                if _blocked(x, y, s * dx, s * dy, ring, ends, slits):
                    near = True
                    break
        if near:
            # every pixel looks at other points of the panel (an additive sequence in two
            # dimensions), lest soft shadows become stairs alike in neighbouring pixels
            a, b = 0.7548776662466927 * k % 1.0, 0.5698402909980532 * k % 1.0
            cx, cy, cz = corner[0] - x, corner[1] - y, corner[2] - z
            seen = whole = 0.0
            for e in range(shadowed.shape[0]):
                u, v = shadowed[e, 0] + a, shadowed[e, 1] + b
                u -= u >= 1.0
                v -= v >= 1.0
                dx = cx + u * sides[0, 0] + v * sides[1, 0]
                dy = cy + u * sides[0, 1] + v * sides[1, 1]
                dz = cz + u * sides[0, 2] + v * sides[1, 2]
                light = _emission(points[k], dx, dy, dz, axis, lobe)
                whole += light
                s = (height - z) / dz
                if not _blocked(x, y, s * dx, s * dy, ring, ends, slits):
                    seen += light
            total *= seen / whole if whole > 0.0 else 0.0
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
        self._ring = np.array([*solid.radii, solid.height, solid.slit_width / 2])
        self._ends = np.array([f(a) for a in solid.arc for f in (math.cos, math.sin)])
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
        return self._points[:, 6].astype(np.float32).reshape(self.shape)

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
        radiance = (self._irradiance(self._points, pose) * self._points[:, 6]
                    * pose.intensity / math.pi)
        return np.asarray(radiance.astype(np.float32).reshape(self.shape))

    def _irradiance(self, points: NDArray, pose: PanelPose) -> NDArray:
        """Irradiance of points in the target frame under a panel of unit radiance, (N,)."""
        where = self._where
        free = emitters(pose, _FREE, gauss=True)[0].T.copy()
        free[:, :3] = (free[:, :3] - where.position) @ where.rotation
        sides = np.stack([pose.size[0] * pose.right,
                          pose.size[1] * np.cross(pose.axis, pose.right)])
        corner = pose.center - sides.sum(axis=0) / 2
        u, v = (grid.ravel() for grid in np.meshgrid(*(np.linspace(0, 1, n) for n in _PROBES)))
        probes = corner + np.stack([u, v], axis=1) @ sides
        e = np.arange(_SHADOWED)
        lattice = np.stack([e, _TURN * e % _SHADOWED], axis=1) / _SHADOWED
        with KERNEL_LOCK:
            return np.asarray(_light(
                points, free, (probes - where.position) @ where.rotation, lattice,
                (corner - where.position) @ where.rotation, sides @ where.rotation,
                pose.axis @ where.rotation, pose.lobe_exponent, self._ring, self._ends,
                self._slits))

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
