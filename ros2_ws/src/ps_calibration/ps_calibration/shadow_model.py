"""Light of one panel on the target's base plate, with the soft shadow of the half ring.

Seen from a point of the plate, the wall hides everything up to an elevation that depends on the
azimuth: its tangent is the wall's height over the way to the wall. A Lambertian panel gives the
point 1/2 sin^2 of elevation per radian of azimuth, between its lower and upper edge; so what the
wall hides is an integral over the azimuth alone. It is cut where faces of the wall and edges of
the panel begin and end, which leaves smooth parts for quadrature: exact to 1e-4 of the panel, and
differentiable. Everything is in the target frame.
"""
import math
import threading
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from ps_head_driver.kinematics import PanelPose

_NODES_4, _WEIGHTS_4 = np.polynomial.legendre.leggauss(4)
_NODES_3, _WEIGHTS_3 = np.polynomial.legendre.leggauss(3)
# no division by zero happens, so none need be looked for
_FAST: dict[str, Any] = {'cache': True, 'fastmath': True, 'error_model': 'numpy'}
_PARTS = 8                         # the panel's width is divided into, at least
THREADS = threading.Lock()         # numba's plain threading layer allows one caller at a time
_NEVER = 1.0                       # m; farther than any shadow reaches
_STRIPES = 64
RATES = 9                          # derivatives, see light_and_rates


@nb.njit(inline='always', **_FAST)
def _in_wall(x, y, f):  # type: ignore[no-untyped-def]
    """Whether (x, y) is inside the footprint, circles left to the caller."""
    if f[2, 0] * y - f[2, 1] * x < -1e-12 or x * f[3, 1] - y * f[3, 0] < -1e-12:
        return False
    for k in range(4, f.shape[0]):
        if (abs(f[k, 0] * y - f[k, 1] * x) < f[1, 0] - 1e-12
                and f[k, 0] * x + f[k, 1] * y > 0.0):
            return False
    return True


@nb.njit(**_FAST)
def first_wall(x, y, ux, uy, limit, f):  # type: ignore[no-untyped-def]
    """Way from a free point along a horizontal unit vector to the wall, m; _NEVER beyond limit.

    :returns: way, and x and y of a normal, of any length, of the face that is met.
    """
    along, square = x * ux + y * uy, x * x + y * y
    outer = along * along - square + f[0, 1] * f[0, 1]
    if outer <= 0.0:
        return _NEVER, 0.0, 0.0
    outer = math.sqrt(outer)
    if -along + outer <= 0.0 or -along - outer >= limit:
        return _NEVER, 0.0, 0.0
    best, nx, ny = limit, 0.0, 0.0
    # through the circles
    inner = along * along - square + f[0, 0] * f[0, 0]
    t = -along - outer
    if 0.0 <= t < best and _in_wall(x + t * ux, y + t * uy, f):
        best, nx, ny = t, x + t * ux, y + t * uy
    if inner > 0.0:
        t = -along + math.sqrt(inner)
        if 0.0 <= t < best and _in_wall(x + t * ux, y + t * uy, f):
            best, nx, ny = t, x + t * ux, y + t * uy
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
            best, nx, ny = t, -ay, ax
    return best if best < limit else _NEVER, nx, ny


@nb.njit(inline='always', **_FAST)
def _panel(x, y, centre, axis, right, up, size, lobe, rates):  # type: ignore[no-untyped-def]
    """Irradiance under the whole panel, by quadrature exact to 1e-6.

    :param rates: (RATES,) or (0,): its derivatives by the panel's motion are added to it.
    """
    total = 0.0
    for j in range(3):
        for i in range(4):
            u, v = _NODES_4[i] * size[0] / 2, _NODES_3[j] * size[1] / 2
            weight = _WEIGHTS_4[i] * _WEIGHTS_3[j] * size[0] * size[1] / 4
            rx, ry, rz = (u * right[0] + v * up[0], u * right[1] + v * up[1],
                          u * right[2] + v * up[2])
            dx, dy, dz = centre[0] + rx - x, centre[1] + ry - y, centre[2] + rz
            square = dx * dx + dy * dy + dz * dz
            facing = -(axis[0] * dx + axis[1] * dy + axis[2] * dz)
            if facing <= 0.0 or dz <= 0.0:
                continue
            light = weight * dz / (square * square)
            light *= facing if lobe == 1.0 else facing * (facing / math.sqrt(square))**(lobe - 1)
            total += light
            if rates.size:
                # by the emitter's place and by the axis
                a, b = -lobe / facing, -(3.0 + lobe) / square
                px, py = light * (a * axis[0] + b * dx), light * (a * axis[1] + b * dy)
                pz = light * (a * axis[2] + b * dz + 1.0 / dz)
                ax, ay, az = light * a * dx, light * a * dy, light * a * dz
                rates[0] += px
                rates[1] += py
                rates[2] += pz
                rates[3] += ry * pz - rz * py + axis[1] * az - axis[2] * ay
                rates[4] += rz * px - rx * pz + axis[2] * ax - axis[0] * az
                rates[5] += rx * py - ry * px + axis[0] * ay - axis[1] * ax
    return total


@nb.njit(inline='always', **_FAST)
def _column(t, forward, side, edges):  # type: ignore[no-untyped-def]
    """Part of the panel seen in the direction forward + t side.

    :param edges: (4, 3) normals of the planes through the point and an edge, pointing outwards.
    :returns: tangents of the lowest and highest elevation, and the edges they are on (-1: the
        horizon); the first is the larger one where the panel is missed.
    """
    x, y = forward[0] + t * side[0], forward[1] + t * side[1]
    low, high, below, above = 0.0, 1e9, -1, -1
    for k in range(4):
        slope = edges[k, 2]
        if slope == 0.0:
            continue
        bound = -(edges[k, 0] * x + edges[k, 1] * y) / slope
        if slope > 0.0 and bound < high:
            high, above = bound, k
        elif slope < 0.0 and bound > low:
            low, below = bound, k
    length = math.sqrt(1.0 + t * t)
    return low / length, high / length, below, above


@nb.njit(inline='always', **_FAST)
def _wall(t, x, y, forward, side, limit, f):  # type: ignore[no-untyped-def]
    """The same as first_wall in the direction forward + t side."""
    length = math.sqrt(1.0 + t * t)
    return first_wall(x, y, (forward[0] + t * side[0]) / length,
                      (forward[1] + t * side[1]) / length, limit, f)


@nb.njit(inline='always', **_FAST)
def _density(tangent, facing, axis, lobe):  # type: ignore[no-untyped-def]
    """Irradiance per radian of azimuth and unit of the tangent of elevation."""
    square = 1.0 + tangent * tangent
    density = tangent / (square * square)
    if lobe != 1.0:
        density *= max(-(facing + tangent * axis[2]) / math.sqrt(square), 1e-9) ** (lobe - 1.0)
    return density


@nb.njit(inline='always', **_FAST)
def _strip(low, high, below, above, wall, t, weight, forward, side, edges, turns, axis, lobe,  # type: ignore[no-untyped-def]
           rates):
    """Irradiance from between two elevations, times weight; its derivatives are taken off rates.

    :param below, above: edges of the panel that the ends are on; -1: the horizon, and the wall.
    :param wall: as from first_wall.
    :param turns: (4, 6, 3) derivatives of edges.
    """
    length = math.sqrt(1.0 + t * t)
    x, y = (forward[0] + t * side[0]) / length, (forward[1] + t * side[1]) / length
    facing = axis[0] * x + axis[1] * y
    if rates.size:
        for end, edge, sign in ((low, below, 1.0), (high, above, -1.0)):
            if edge >= 0:
                gain = weight * sign * _density(end, facing, axis, lobe) / edges[edge, 2]
                for i in range(6):
                    rates[i] -= gain * (turns[edge, i, 0] * x + turns[edge, i, 1] * y
                                        + turns[edge, i, 2] * end)
        if above < 0:
            way, nx, ny = wall
            gain = weight * _density(high, facing, axis, lobe) / way
            rates[8] -= gain
            gain *= high / (nx * x + ny * y)
            rates[6] -= gain * nx
            rates[7] -= gain * ny
    if lobe == 1.0:
        return 0.5 * weight * (high * high / (1.0 + high * high) - low * low / (1.0 + low * low))
    total = 0.0
    for k in range(4):
        tangent = low + (high - low) * (0.5 + 0.5 * _NODES_4[k])
        part = 0.5 * weight * (high - low) * _WEIGHTS_4[k] * _density(tangent, facing, axis, lobe)
        total += part
        if rates.size:
            gain = part * (lobe - 1.0) / (facing + tangent * axis[2])
            rates[3] -= gain * (axis[1] * tangent - axis[2] * y)
            rates[4] -= gain * (axis[2] * x - axis[0] * tangent)
            rates[5] -= gain * (axis[0] * y - axis[1] * x)
    return total


@nb.njit(**_FAST)
def _wall_edges(x, y, forward, side, first, last, limit, f, out, ways):  # type: ignore[no-untyped-def]
    """Write to out the directions, between two, of the wall's vertical edges and its outline.

    :param ways: filled in with their distances, m.
    :returns: their number.
    """
    n = 0
    for k in range(2, f.shape[0]):
        for sign in (-1.0, 1.0):
            if k < 4 and sign > 0.0:
                continue
            offset = sign * f[1, 0] if k >= 4 else 0.0
            for j in range(2):
                along = math.sqrt(f[0, j] * f[0, j] - offset * offset)
                dx = along * f[k, 0] - offset * f[k, 1] - x
                dy = along * f[k, 1] + offset * f[k, 0] - y
                ahead = dx * forward[0] + dy * forward[1]
                if ahead <= 0.0 or dx * dx + dy * dy > limit * limit:
                    continue
                out[n], ways[n] = (dx * side[0] + dy * side[1]) / ahead, math.hypot(dx, dy)
                n += first < out[n] < last
    square = x * x + y * y - f[0, 1] * f[0, 1]
    if 0.0 < square < limit * limit:
        tangent = math.sqrt(square)
        for sign in (-1.0, 1.0):
            dx = -x * tangent + sign * y * f[0, 1]
            dy = -y * tangent - sign * x * f[0, 1]
            ahead = dx * forward[0] + dy * forward[1]
            if ahead > 0.0:
                out[n], ways[n] = (dx * side[0] + dy * side[1]) / ahead, tangent
                n += first < out[n] < last
    return n


@nb.njit(**_FAST)
def _clear(a, b, x, y, forward, side, limit, f):  # type: ignore[no-untyped-def]
    """Whether no wall stands in directions between which no face of it begins or ends."""
    inset = 1e-6 * (b - a)
    for t in (a + inset, 0.5 * (a + b), b - inset):
        if _wall(t, x, y, forward, side, limit, f)[0] < _NEVER:
            return False
    return True


@nb.njit(**_FAST)
def _crossing(a, b, over_a, over_b, low_edge, x, y, forward, side, edges, height, limit, f):  # type: ignore[no-untyped-def]
    """Direction in which the wall's top crosses an edge of the panel (Illinois' rule)."""
    for _ in range(4):
        t = (a * over_b - b * over_a) / (over_b - over_a)
        low, high, _, _ = _column(t, forward, side, edges)
        over = height / _wall(t, x, y, forward, side, limit, f)[0] - (low if low_edge else high)
        if (over > 0.0) == (over_b > 0.0):
            b, over_b, over_a = t, over, 0.5 * over_a
        else:
            a, over_a, over_b = t, over, 0.5 * over_b
    return (a * over_b - b * over_a) / (over_b - over_a)


@nb.njit(**_FAST)
def _hidden_part(begin, end, x, y, forward, side, edges, turns, axis, lobe, height, limit, f,  # type: ignore[no-untyped-def]
                 rates):
    """Irradiance hidden in directions between which no face of the wall begins or ends."""
    inset = 1e-6 * (end - begin)
    begin, end = begin + inset, end - inset
    low_a, high_a, _, _ = _column(begin, forward, side, edges)
    low_b, high_b, _, _ = _column(end, forward, side, edges)
    crown_a = height / _wall(begin, x, y, forward, side, limit, f)[0]
    crown_b = height / _wall(end, x, y, forward, side, limit, f)[0]
    if crown_a <= low_a and crown_b <= low_b:
        return 0.0
    a, b = begin, end
    if crown_a < low_a or crown_b < low_b:
        t = _crossing(begin, end, crown_a - low_a, crown_b - low_b, True, x, y, forward, side,
                      edges, height, limit, f)
        a, b = (t, end) if crown_a < low_a else (begin, t)
    middle = b
    if (crown_a > high_a) != (crown_b > high_b):
        middle = min(max(_crossing(begin, end, crown_a - high_a, crown_b - high_b, False, x, y,
                                   forward, side, edges, height, limit, f), a), b)
    total = 0.0
    # on either side of the middle the wall hides all the panel, or it ends in it
    for start, stop, whole in ((a, middle, crown_a > high_a), (middle, b, crown_b > high_b)):
        for k in range(4 if stop - start > 1e-12 else 0):
            t = 0.5 * (start + stop) + 0.5 * (stop - start) * _NODES_4[k]
            low, high, below, above = _column(t, forward, side, edges)
            wall = (_NEVER, 0.0, 0.0)
            if not whole:
                wall = _wall(t, x, y, forward, side, limit, f)
                if height / wall[0] < high:
                    high, above = height / wall[0], -1
            if high > low:
                total += _strip(low, high, below, above, wall, t,
                                0.5 * (stop - start) * _WEIGHTS_4[k] / (1.0 + t * t), forward,
                                side, edges, turns, axis, lobe, rates)
    return total


@nb.njit(**_FAST)
def _sweep(t, way, gap, x, y, forward, side, edges, turns, axis, lobe, height, limit, f, rates):  # type: ignore[no-untyped-def]
    """Take off rates what an edge of the wall hides as it moves sideways when the point moves.

    :param t, way: direction and distance of the edge.
    :param gap: in t, to look past it on either side.
    """
    jump = 0.0
    for sign in (-1.0, 1.0):
        beside = t + sign * gap
        low, high, _, _ = _column(beside, forward, side, edges)
        wall = _wall(beside, x, y, forward, side, limit, f)
        high = min(high, height / wall[0])
        if high > low:
            jump -= sign * _strip(low, high, -1, -1, wall, beside, 1.0, forward, side, edges,
                                  turns, axis, lobe, rates[:0])
    gain = jump / (way * math.sqrt(1.0 + t * t))
    rates[6] -= gain * (forward[1] + t * side[1])
    rates[7] += gain * (forward[0] + t * side[0])


@nb.njit(inline='always', **_FAST)
def _cross(a, b):  # type: ignore[no-untyped-def]
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@nb.njit(**_FAST)
def _outlines(q, facing, axis, right, up, size, edges, turns, with_turns):  # type: ignore[no-untyped-def]
    """Fill in edges (see _column) and turns (see _strip) of a panel.

    :param q: its centre as seen from the point.
    :param facing: component of q along the axis.
    """
    for e in range(4):
        sign = 1.0 if e % 2 == 0 else -1.0
        along, run, half = (right, up, size[0] / 2) if e < 2 else (up, right, size[1] / 2)
        offset = along[0] * q[0] + along[1] * q[1] + along[2] * q[2] + sign * half
        for i in range(3):
            edges[e, i] = sign * (offset * axis[i] - facing * along[i])
        if not with_turns:
            continue
        # edges[e] = gain (middle of the edge x its run), each moved in six ways
        gain = sign if e < 2 else -sign
        arm = (sign * half * along[0], sign * half * along[1], sign * half * along[2])
        middle = (q[0] + arm[0], q[1] + arm[1], q[2] + arm[2])
        for i, unit in enumerate(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))):
            shifted = _cross(unit, run)
            swung, turned = _cross(_cross(unit, arm), run), _cross(middle, shifted)
            for n in range(3):
                turns[e, i, n] = gain * shifted[n]
                turns[e, 3 + i, n] = gain * (swung[n] + turned[n])


@nb.njit(**_FAST)
def _within(x, y, limit, f, out):  # type: ignore[no-untyped-def]
    """Copy to out what of the footprint is within a distance of a point; number of rows."""
    out[:4] = f[:4]
    n = 4
    for k in range(4, f.shape[0]):
        along = min(max(f[k, 0] * x + f[k, 1] * y, f[0, 0]), f[0, 1])
        if math.hypot(x - along * f[k, 0], y - along * f[k, 1]) < limit + 2.0 * f[1, 0]:
            out[n] = f[k]
            n += 1
    return n


@nb.njit(**_FAST)
def _hidden(x, y, centre, axis, right, up, size, lobe, height, whole, rates):  # type: ignore[no-untyped-def]
    """Irradiance that the wall takes away from a point; its derivatives are taken off rates."""
    q = (centre[0] - x, centre[1] - y, centre[2])
    way = math.hypot(q[0], q[1])
    forward = (q[0] / way, q[1] / way)
    side = (-forward[1], forward[0])
    # the panel's corners: how low it is seen, and between which directions
    breaks = np.empty(8 + 4 * whole.shape[0])
    nearest, lowest, first, last = 1e9, 1e9, 1e9, -1e9
    for c in range(4):
        u, v = (c // 2 - 0.5) * size[0], (c % 2 - 0.5) * size[1]
        dx, dy = q[0] + u * right[0] + v * up[0], q[1] + u * right[1] + v * up[1]
        dz, ahead = q[2] + u * right[2] + v * up[2], dx * forward[0] + dy * forward[1]
        nearest, lowest = min(nearest, ahead), min(lowest, dz / math.hypot(dx, dy))
        breaks[c] = (dx * side[0] + dy * side[1]) / ahead
        first, last = min(first, breaks[c]), max(last, breaks[c])
    limit, radius = height / max(lowest, 1e-3), math.hypot(x, y)
    if nearest <= 0.0 or not whole[0, 0] - limit < radius < whole[0, 1] + limit:
        return 0.0
    f = np.empty(whole.shape)
    f = f[:_within(x, y, limit, whole, f)]
    ways = np.empty(breaks.shape)
    n = 4 + _wall_edges(x, y, forward, side, first, last, limit, f, breaks[4:], ways[4:])
    if n == 4 and _clear(first, last, x, y, forward, side, limit, f):
        return 0.0
    edges, turns = np.empty((4, 3)), np.empty((4 if rates.size else 0, 6, 3))
    _outlines(q, axis[0] * q[0] + axis[1] * q[1] + axis[2] * q[2], axis, right, up, size, edges,
              turns, rates.size > 0)
    for k in range(4, n if rates.size else 0):
        _sweep(breaks[k], ways[k], 1e-6 * (last - first), x, y, forward, side, edges, turns, axis,
               lobe, height, limit, f, rates)
    breaks[:n].sort()
    total = 0.0
    for k in range(n - 1):
        gap = breaks[k + 1] - breaks[k]
        parts = int(gap / (last - first) * _PARTS) + 1 if gap > 1e-9 else 0
        if parts > 1 and _clear(breaks[k], breaks[k + 1], x, y, forward, side, limit, f):
            continue
        for part in range(parts):
            total += _hidden_part(
                breaks[k] + gap * part / parts, breaks[k] + gap * (part + 1) / parts, x, y,
                forward, side, edges, turns, axis, lobe, height, limit, f, rates)
    return total


@nb.njit(parallel=True, **_FAST)
def _irradiance(points, centre, axis, right, up, size, lobe, height, f, with_rates):  # type: ignore[no-untyped-def]
    out = np.zeros((points.shape[0], 1 + RATES if with_rates else 1))
    # points in shadow take longest and lie together: each thread gets some of everywhere
    for stripe in nb.prange(_STRIPES):
        for k in range(stripe, points.shape[0], _STRIPES):
            x, y = points[k, 0], points[k, 1]
            rates = out[k, 1:]
            out[k, 0] = _panel(x, y, centre, axis, right, up, size, lobe, rates)
            if height > 0.0 and out[k, 0] > 0.0:
                out[k, 0] -= _hidden(x, y, centre, axis, right, up, size, lobe, height, f, rates)
            if with_rates:
                # panel, wall and point moved together change nothing
                rates[6] -= rates[0]
                rates[7] -= rates[1]
    return out


def plate_irradiance(points: NDArray, panel: PanelPose, height: float,
                     footprint: NDArray) -> NDArray:
    """Irradiance of the base plate under one panel of radiance 1.

    :param points: (N, 2) float64 on the plate, not under the wall, m, target frame.
    :param panel: in the target frame; its intensity is not included. A panel that is in part
        above the point itself casts no shadow there.
    :param height: of the wall, m; 0 for no wall.
    :param footprint: of the wall, see RingTarget.footprint.
    :returns: (N,) float64.
    """
    return _run(points, panel, height, footprint, False)[:, 0]


def light_and_rates(points: NDArray, panel: PanelPose, height: float,
                    footprint: NDArray) -> tuple[NDArray, NDArray]:
    """The same with its derivatives.

    :returns: (N,), and (N, RATES): by a shift of the panel (per m) and by a turn about its centre
        (per rad), x y z of the target frame each; by a shift of the point along x and y (per m);
        by the wall's height (per m).
    """
    out = _run(points, panel, height, footprint, True)
    return out[:, 0], out[:, 1:]


def _run(points: NDArray, panel: PanelPose, height: float, footprint: NDArray,
         with_rates: bool) -> NDArray:
    with THREADS:
        return np.asarray(_irradiance(
            np.ascontiguousarray(points), panel.center, panel.axis, panel.right,
            np.cross(panel.axis, panel.right), np.array(panel.size), panel.lobe_exponent, height,
            footprint, with_rates))
