"""Light that the wall of the half ring throws onto the base plate around it.

A wall that sends back 30 % of its light adds 13 % to the plate at the foot of its lit side, and
some to its own shadow: left out, it moves panels by centimetres. The wall is cut into upright
strips of a few levels. Each is lit by the panel and by the plate around, both where the wall does
not hide them, and throws its light onto the plate like any matt surface. Light that has come this
way lights the wall a second time; what comes later is left out, as is light from one face of the
wall to another. Everything is in the target frame.
"""
from collections.abc import Sequence
import math
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from ps_calibration.ring_target import RingTarget
from ps_calibration.shadow_model import THREADS, first_wall, plate_irradiance
from ps_head_driver.kinematics import PanelPose

_WIDTH = 5e-4            # of a strip, m
_PLATE = 1e-3            # edge of the cells of the plate that light the wall, m
_AROUND = 0.012          # m around the ring, the cells that count
_LEVELS = 4              # a strip is divided into
_EMITTERS, _EMITTER_WEIGHTS = np.polynomial.legendre.leggauss(3)
_OFF = 1e-7              # m in front of a face
_FAST: dict[str, Any] = {'cache': True, 'fastmath': True, 'error_model': 'numpy'}


def wall_glow(points: NDArray, panels: Sequence[PanelPose], target: RingTarget) -> NDArray:
    """Irradiance of the base plate by way of the wall, for each of P panels.

    :param points: (N, 2) float64 on the plate, not under the wall, m.
    :param panels: in the target frame.
    :param target: its reflectances are taken as they are.
    :returns: (P, N) float64.
    """
    footprint, strips, cells = target.footprint, _strips(target), _cells(target)
    sent = target.base.reflectance * _PLATE**2 / math.pi
    bare = np.stack([panel.intensity * plate_irradiance(cells, panel, target.height, footprint)
                     for panel in panels])
    direct = np.stack([panel.intensity * _from_panel(
        strips, panel.center, panel.axis, panel.right, np.cross(panel.axis, panel.right),
        np.array(panel.size), panel.lobe_exponent, target.height, footprint) for panel in panels])

    def thrown(onto: NDArray, lit: NDArray) -> NDArray:
        """By the wall onto points of the plate, its cells lit so."""
        radiance = target.wall_reflectance / math.pi * (
            direct + _from_plate(strips, cells, sent * lit, target.height, footprint))
        with THREADS:
            return np.asarray(_onto_plate(onto, strips, radiance, target.height, footprint))

    return thrown(np.ascontiguousarray(points), bare + thrown(cells, bare))


def _strips(target: RingTarget) -> NDArray:
    """Upright strips of the wall: x, y, outward normal x, y, width; (M, 5)."""
    first, last = target.arc
    rows = []
    for radius, side in ((target.outer_radius, 1.0), (target.inner_radius, -1.0)):
        count = math.ceil((last - first) * radius / _WIDTH)
        azimuth = first + (np.arange(count) + 0.5) * (last - first) / count
        free = np.ones(count, bool)
        for slit in target.slits.azimuths:
            free &= abs(radius * np.sin(azimuth - slit)) > target.slits.width / 2
        out = np.stack([np.cos(azimuth), np.sin(azimuth)])[:, free]
        rows.append(np.vstack([(radius + side * _OFF) * out, side * out,
                               np.full(out.shape[1], radius * (last - first) / count)]))
    half = target.slits.width / 2
    faces = [(first, 0.0, -1.0), (last, 0.0, 1.0),
             *((slit, side * half, -side) for slit in target.slits.azimuths for side in (-1, 1))]
    count = math.ceil((target.outer_radius - target.inner_radius) / _WIDTH)
    width = (target.outer_radius - target.inner_radius) / count
    along = target.inner_radius + (np.arange(count) + 0.5) * width
    for at, offset, side in faces:
        ahead = np.array([[math.cos(at)], [math.sin(at)]])
        across = np.array([[-ahead[1, 0]], [ahead[0, 0]]])
        rows.append(np.vstack([along * ahead + (offset + side * _OFF) * across,
                               np.tile(side * across, count), np.full(count, width)]))
    return np.ascontiguousarray(np.hstack(rows).T)


def _cells(target: RingTarget) -> NDArray:
    """Middles of the cells of the plate that light the wall, (K, 2)."""
    reach = target.outer_radius + _AROUND
    half = np.minimum(np.array(target.base.size) / 2, reach)
    x, y = (np.arange(-n + 0.5, n) * _PLATE for n in np.floor(half / _PLATE))
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return np.ascontiguousarray(grid[target.distance(grid[:, 0], grid[:, 1]) > _PLATE / 4])


@nb.njit(**_FAST)
def _from_panel(strips, centre, axis, right, up, size, lobe, height, f):  # type: ignore[no-untyped-def]
    """Irradiance of each strip's levels by the panel, (M, _LEVELS)."""
    out = np.zeros((strips.shape[0], _LEVELS))
    for m in range(strips.shape[0]):
        x, y, nx, ny = strips[m, 0], strips[m, 1], strips[m, 2], strips[m, 3]
        for i in range(3):
            for j in range(3):
                u, v = _EMITTERS[i] * size[0] / 2, _EMITTERS[j] * size[1] / 2
                weight = _EMITTER_WEIGHTS[i] * _EMITTER_WEIGHTS[j] * size[0] * size[1] / 4
                dx = centre[0] + u * right[0] + v * up[0] - x
                dy = centre[1] + u * right[1] + v * up[1] - y
                dz = centre[2] + u * right[2] + v * up[2]
                ahead, way = dx * nx + dy * ny, math.hypot(dx, dy)
                if ahead <= 0.0 or dz <= height:
                    continue
                met = first_wall(x, y, dx / way, dy / way, height * way / dz, f)[0]
                for k in range(_LEVELS):
                    z = (k + 0.5) * height / _LEVELS
                    rise = dz - z
                    facing = -(axis[0] * dx + axis[1] * dy + axis[2] * rise)
                    if facing <= 0.0 or z + met * rise / way < height:
                        continue
                    square = way * way + rise * rise
                    out[m, k] += (weight * ahead * facing / (square * square)
                                  * (facing / math.sqrt(square))**(lobe - 1.0))
    return out


@nb.njit(inline='always', **_FAST)
def _seen(x, y, strip, f):  # type: ignore[no-untyped-def]
    """How far a point of the plate is in front of a strip, and squared way; 0 if not seen."""
    dx, dy = x - strip[0], y - strip[1]
    ahead, square = dx * strip[2] + dy * strip[3], dx * dx + dy * dy
    if ahead <= 0.0:
        return 0.0, square
    way = math.sqrt(square)
    if first_wall(strip[0], strip[1], dx / way, dy / way, way, f)[0] < way:
        return 0.0, square
    return ahead, square


@nb.njit(inline='always', **_FAST)
def _exchanged(square, level, step):  # type: ignore[no-untyped-def]
    """Integral of z / (square + z^2)^2 over one level's heights."""
    low, high = level * step, (level + 1) * step
    return 0.5 / (square + low * low) - 0.5 / (square + high * high)


@nb.njit(**_FAST)
def _from_plate(strips, cells, power, height, f):  # type: ignore[no-untyped-def]
    """Irradiance of each strip's levels by cells of the plate, (P, M, _LEVELS).

    :param power: (P, K) of each cell per steradian.
    """
    out = np.zeros((power.shape[0], strips.shape[0], _LEVELS))
    step = height / _LEVELS
    for m in range(strips.shape[0]):
        for n in range(cells.shape[0]):
            ahead, square = _seen(cells[n, 0], cells[n, 1], strips[m], f)
            if ahead > 0.0:
                for k in range(_LEVELS):
                    part = ahead * _exchanged(square, k, step) / step
                    for p in range(power.shape[0]):
                        out[p, m, k] += power[p, n] * part
    return out


@nb.njit(parallel=True, **_FAST)
def _onto_plate(points, strips, radiance, height, f):  # type: ignore[no-untyped-def]
    """Irradiance of points of the plate by the strips' levels, (P, N).

    :param radiance: (P, M, _LEVELS).
    """
    out, step = np.zeros((radiance.shape[0], points.shape[0])), height / _LEVELS
    for n in nb.prange(points.shape[0]):
        for m in range(strips.shape[0]):
            ahead, square = _seen(points[n, 0], points[n, 1], strips[m], f)
            if ahead > 0.0:
                for k in range(_LEVELS):
                    part = strips[m, 4] * ahead * _exchanged(square, k, step)
                    for p in range(radiance.shape[0]):
                        out[p, n] += radiance[p, m, k] * part
    return out
