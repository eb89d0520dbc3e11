"""Light of one panel on the target's base plate, with the soft shadow of the half ring.

The panel is divided into cells. A cell is hidden from a point of the plate where the line to it
passes through the wall below its upper edge: from the point, the line leaves the wall's height
after the horizontal way L = D h / E_z (D, E_z: horizontal distance and height of the cell), and is
blocked if the wall begins before that. Cells that the shadow's edge crosses are divided again.
Everything is in the target frame.
"""
import math
import threading

import numba as nb
import numpy as np
from numpy.typing import NDArray

from ps_head_driver.kinematics import PanelPose

_CELLS_U, _CELLS_V, _SPLIT = 10, 6, 2
_NODES_U, _WEIGHTS_U = np.polynomial.legendre.leggauss(4)
_NODES_V, _WEIGHTS_V = np.polynomial.legendre.leggauss(3)
_LOCK = threading.Lock()           # numba's plain threading layer allows one caller at a time
_NEVER = 1.0                       # m; farther than any shadow reaches


@nb.njit(cache=True, inline='always')
def _in_wall(x, y, f):  # type: ignore[no-untyped-def]
    """Whether (x, y) is inside the footprint, circles left to the caller."""
    if f[2, 0] * y - f[2, 1] * x < -1e-12 or x * f[3, 1] - y * f[3, 0] < -1e-12:
        return False
    for k in range(4, f.shape[0]):
        if (abs(f[k, 0] * y - f[k, 1] * x) < f[1, 0] - 1e-12
                and f[k, 0] * x + f[k, 1] * y > 0.0):
            return False
    return True


@nb.njit(cache=True)
def first_wall(x, y, ux, uy, limit, f):  # type: ignore[no-untyped-def]
    """Way from a free point along a horizontal unit vector to the wall, m; _NEVER beyond limit."""
    along, square = x * ux + y * uy, x * x + y * y
    outer = along * along - square + f[0, 1] * f[0, 1]
    if outer <= 0.0:
        return _NEVER
    outer = math.sqrt(outer)
    if -along + outer <= 0.0 or -along - outer >= limit:
        return _NEVER
    best = limit
    # through the circles
    inner = along * along - square + f[0, 0] * f[0, 0]
    t = -along - outer
    if 0.0 <= t < best and _in_wall(x + t * ux, y + t * uy, f):
        best = t
    if inner > 0.0:
        t = -along + math.sqrt(inner)
        if 0.0 <= t < best and _in_wall(x + t * ux, y + t * uy, f):
            best = t
    # through the plane faces at the ends and in the slits
    for k in range(4, 2 * f.shape[0]):
        ax, ay = f[k // 2, 0], f[k // 2, 1]
        offset = 0.0 if k < 8 else f[1, 0] if k % 2 else -f[1, 0]
        slope = ax * uy - ay * ux
        if slope == 0.0:
            continue
        t = (offset - ax * y + ay * x) / slope
        if t < 0.0 or t >= best:
            continue
        px, py = x + t * ux, y + t * uy
        radius = px * px + py * py
        if (px * ax + py * ay > 0.0 and f[0, 0] * f[0, 0] <= radius <= f[0, 1] * f[0, 1]
                and _in_wall(px, py, f)):
            best = t
    return best if best < limit else _NEVER


@nb.njit(cache=True, inline='always')
def _gap(x, y, ex, ey, ez, height, limit, f):  # type: ignore[no-untyped-def]
    """How far beyond the wall's beginning the line leaves its height, m; negative: free."""
    dx, dy = ex - x, ey - y
    way = math.sqrt(dx * dx + dy * dy)
    return way * height / ez - first_wall(x, y, dx / way, dy / way, limit, f)


@nb.njit(cache=True, inline='always')
def _emitter(x, y, ex, ey, ez, axis, lobe):  # type: ignore[no-untyped-def]
    """Irradiance under a unit of area at (ex, ey, ez)."""
    dx, dy = ex - x, ey - y
    distance = math.sqrt(dx * dx + dy * dy + ez * ez)
    cosine = -(axis[0] * dx + axis[1] * dy + axis[2] * ez) / distance
    if cosine <= 0.0 or ez <= 0.0:
        return 0.0
    lobe_gain = cosine if lobe == 1.0 else cosine ** lobe
    return lobe_gain * ez / (distance * distance * distance)


@nb.njit(cache=True, parallel=True, fastmath=True)
def _irradiance(points, centre, axis, right, up, size, lobe, height, f, limit):  # type: ignore[no-untyped-def]
    out = np.empty(points.shape[0])
    cell_u, cell_v = size[0] / _CELLS_U, size[1] / _CELLS_V
    for k in nb.prange(points.shape[0]):
        x, y = points[k, 0], points[k, 1]
        gaps = np.full((_CELLS_V + 1, _CELLS_U + 1), -1.0)
        square = x * x + y * y
        near = (f[0, 0] - limit) ** 2 < square < (f[0, 1] + limit) ** 2
        if near:
            near = False
            for j in range(_CELLS_V + 1):
                for i in range(_CELLS_U + 1):
                    u, v = i * cell_u - size[0] / 2, j * cell_v - size[1] / 2
                    gaps[j, i] = _gap(x, y, centre[0] + u * right[0] + v * up[0],
                                      centre[1] + u * right[1] + v * up[1],
                                      centre[2] + u * right[2] + v * up[2], height, limit, f)
                    near = near or gaps[j, i] > 0.0
        total = whole = 0.0
        for j in range(_CELLS_V):
            for i in range(_CELLS_U):
                seen = 1.0
                if near:
                    blocked = 0
                    for b in range(2):
                        for a in range(2):
                            blocked += gaps[j + b, i + a] > 0.0
                    if blocked == 4:
                        seen = 0.0
                    elif blocked > 0:
                        seen = 0.0
                        # the gap's change over a part of the cell softens the step
                        soft = abs(gaps[j, i] - gaps[j + 1, i]) / _SPLIT
                        soft = min(max(soft, 1e-6), 2e-4)
                        for b in range(_SPLIT):
                            for a in range(_SPLIT):
                                u = (i + (a + 0.5) / _SPLIT) * cell_u - size[0] / 2
                                v = (j + (b + 0.5) / _SPLIT) * cell_v - size[1] / 2
                                gap = _gap(x, y, centre[0] + u * right[0] + v * up[0],
                                           centre[1] + u * right[1] + v * up[1],
                                           centre[2] + u * right[2] + v * up[2], height, limit, f)
                                seen += min(max(0.5 - gap / soft, 0.0), 1.0)
                        seen /= _SPLIT * _SPLIT
                u, v = (i + 0.5) * cell_u - size[0] / 2, (j + 0.5) * cell_v - size[1] / 2
                light = _emitter(x, y, centre[0] + u * right[0] + v * up[0],
                                 centre[1] + u * right[1] + v * up[1],
                                 centre[2] + u * right[2] + v * up[2], axis, lobe)
                whole += light
                total += seen * light
            if not near:
                break
        # the unshadowed panel by quadrature, exact to 1e-6
        exact = 0.0
        for j in range(3):
            for i in range(4):
                u, v = _NODES_U[i] * size[0] / 2, _NODES_V[j] * size[1] / 2
                exact += _WEIGHTS_U[i] * _WEIGHTS_V[j] * _emitter(
                    x, y, centre[0] + u * right[0] + v * up[0],
                    centre[1] + u * right[1] + v * up[1],
                    centre[2] + u * right[2] + v * up[2], axis, lobe)
        exact *= size[0] * size[1] / 4
        out[k] = exact * total / whole if whole > 0.0 else 0.0
    return out


def plate_irradiance(points: NDArray, panel: PanelPose, height: float,
                     footprint: NDArray) -> NDArray:
    """Irradiance of the base plate under one panel of radiance 1.

    :param points: (N, 2) float64 on the plate, not under the wall, m, target frame.
    :param panel: in the target frame; its intensity is not included.
    :param height: of the wall, m; 0 for no wall.
    :param footprint: of the wall, see RingTarget.footprint.
    :returns: (N,) float64.
    """
    up = np.cross(panel.axis, panel.right)
    half = (abs(panel.right) * panel.size[0] + abs(up) * panel.size[1]) / 2
    # no line leaves the wall's height later than this, from any point near the ring
    reach = math.hypot(*(abs(panel.center[:2]) + half[:2])) + 2 * footprint[0, 1]
    limit = reach * height / max(panel.center[2] - half[2], height)
    with _LOCK:
        irradiance: NDArray = _irradiance(
            np.ascontiguousarray(points), panel.center, panel.axis, panel.right, up,
            np.array(panel.size), panel.lobe_exponent, height, footprint, limit)
    return irradiance
