"""Light transport of the fake camera: rays, a surface of cubic B-splines, sampled emitters.

Shares no code with light_model.py: agreement between renderer and solver has to mean something.
A surface is a grid of control heights; the uniform cubic B-spline over them is the true surface
(twice differentiable, so that normals are exact). All lengths in metres, frame ps_head_plane.
"""
import math
import threading

import numba as nb
import numpy as np
from numpy.typing import NDArray

NARROW, WIDE, HUGE = 8, 32, 128     # grid cells along a side of the blocks of the shadow search
COARSE_AZIMUTHS = 7            # directions across a panel in which shadows are looked for
FINE_AZIMUTHS = 13             # and where there are some
_PI = math.pi

# numba's fallback threading layer aborts the process when two threads run parallel kernels
KERNEL_LOCK = threading.Lock()


@nb.njit(cache=True, inline='always')
def _weights(t):  # type: ignore[no-untyped-def]
    """Cubic B-spline weights and their derivatives at the fraction t of a cell."""
    s = 1.0 - t
    w = (s * s * s / 6.0, (4.0 - 6.0 * t * t + 3.0 * t * t * t) / 6.0,
         (4.0 - 6.0 * s * s + 3.0 * s * s * s) / 6.0, t * t * t / 6.0)
    d = (-0.5 * s * s, 1.5 * t * t - 2.0 * t, -1.5 * s * s + 2.0 * s, 0.5 * t * t)
    return w, d


@nb.njit(cache=True, inline='always')
def _cell(u, n):  # type: ignore[no-untyped-def]
    """First of the four control points around grid coordinate u, and the fraction."""
    i = min(max(math.floor(u), 1), n - 3)
    return i - 1, min(max(u - i, 0.0), 1.0)


@nb.njit(cache=True)
def _spline(grid, x0, y0, pitch, x, y):  # type: ignore[no-untyped-def]
    """Height and slopes dz/dx, dz/dy; held constant beyond the grid."""
    i, fx = _cell((x - x0) / pitch, grid.shape[1])
    j, fy = _cell((y - y0) / pitch, grid.shape[0])
    wx, dx = _weights(fx)
    wy, dy = _weights(fy)
    z = p = q = 0.0
    for b in range(4):
        row = grid[j + b]
        along = (wx[0] * row[i] + wx[1] * row[i + 1] + wx[2] * row[i + 2] + wx[3] * row[i + 3])
        slope = (dx[0] * row[i] + dx[1] * row[i + 1] + dx[2] * row[i + 2] + dx[3] * row[i + 3])
        z += wy[b] * along
        p += wy[b] * slope
        q += dy[b] * along
    return z, p / pitch, q / pitch


@nb.njit(cache=True)
def _bilinear(grid, x0, y0, pitch, x, y):  # type: ignore[no-untyped-def]
    u = min(max((x - x0) / pitch, 0.0), grid.shape[1] - 1.001)
    v = min(max((y - y0) / pitch, 0.0), grid.shape[0] - 1.001)
    i, j = int(u), int(v)
    fx, fy = u - i, v - j
    low = grid[j, i] * (1.0 - fx) + grid[j, i + 1] * fx
    high = grid[j + 1, i] * (1.0 - fx) + grid[j + 1, i + 1] * fx
    return low * (1.0 - fy) + high * fy


@nb.njit(cache=True)
def evaluate(grid, x0, y0, pitch, x, y):  # type: ignore[no-untyped-def]
    """Height and slopes at flat arrays of points.

    :param grid: (ny, nx) float64 control heights; (x0, y0) is the first, rows go along +y.
    :param x: (N,) m.
    :param y: (N,) m.
    :returns: (3, N) float64: z, dz/dx, dz/dy.
    """
    out = np.empty((3, x.size))
    for k in range(x.size):
        out[0, k], out[1, k], out[2, k] = _spline(grid, x0, y0, pitch, x[k], y[k])
    return out


@nb.njit(cache=True, parallel=True)
def intersect(grid, albedo, x0, y0, pitch, low, high, ray_x, ray_y, standoff):  # type: ignore[no-untyped-def]
    """First intersection of every camera ray with the surface.

    A ray is (standoff on the z axis) + s * (ray_x, ray_y, -1).

    :param low: a height below the whole surface, m.
    :param high: a height above it, m.
    :param ray_x: (N,) float64.
    :param ray_y: (N,) float64.
    :returns: (6, N) float32: x, y, z, dz/dx, dz/dy, albedo.
    """
    out = np.empty((6, ray_x.size), np.float32)
    for k in nb.prange(ray_x.size):
        rx, ry = ray_x[k], ray_y[k]
        # march in steps of half a cell sideways until the ray is below the surface
        sideways = (high - low) * math.sqrt(rx * rx + ry * ry)
        steps = int(sideways / (0.5 * pitch)) + 1
        near = standoff - high
        step = (high - low) / steps
        above = high - _spline(grid, x0, y0, pitch, near * rx, near * ry)[0]
        far, below = near, above
        for _ in range(steps):
            far = near + step
            below = standoff - far - _spline(grid, x0, y0, pitch, far * rx, far * ry)[0]
            if below <= 0.0:
                break
            near, above = far, below
        # then false position, bracketed (Illinois)
        s = far
        for _ in range(60):
            if abs(far - near) < 1e-10 or above <= below:
                break
            s = near + (far - near) * above / (above - below)
            gap = standoff - s - _spline(grid, x0, y0, pitch, s * rx, s * ry)[0]
            if abs(gap) < 1e-10:
                break
            if gap > 0.0:
                near, above = s, gap
                below *= 0.5
            else:
                far, below = s, gap
                above *= 0.5
        x, y = s * rx, s * ry
        z, p, q = _spline(grid, x0, y0, pitch, x, y)
        out[0, k], out[1, k], out[2, k], out[3, k], out[4, k] = x, y, z, p, q
        out[5, k] = _bilinear(albedo, x0, y0, pitch, x, y)
    return out


@nb.njit(cache=True)
def _roofs(surface, x0, y0, pitch, block):  # type: ignore[no-untyped-def]
    """Plane over each block of cells that the surface nowhere pierces.

    :returns: (by, bx, 3) float64: a, b, c of a + b x + c y.
    """
    last_j, last_i = surface.shape[0] - 1, surface.shape[1] - 1
    rows, columns = (last_j + block - 1) // block, (last_i + block - 1) // block
    roofs = np.empty((rows, columns, 3))
    for row in range(rows):
        for column in range(columns):
            j0, i0 = row * block, column * block
            j1, i1 = min(j0 + block, last_j), min(i0 + block, last_i)
            # inclined like the block's corners, so that it lies close to a smooth surface
            low, high = surface[j0, i0], surface[j1, i1]
            left, right = surface[j1, i0], surface[j0, i1]
            b = (right - low + high - left) / (2 * pitch * (i1 - i0))
            c = (left - low + high - right) / (2 * pitch * (j1 - j0))
            a = -np.inf
            for j in range(j0, j1 + 1):
                for i in range(i0, i1 + 1):
                    a = max(a, surface[j, i] - b * (x0 + i * pitch) - c * (y0 + j * pitch))
            roofs[row, column, 0], roofs[row, column, 1], roofs[row, column, 2] = a, b, c
    return roofs


def shadow_grids(grid: NDArray, x0: float, y0: float,
                 pitch: float) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """What shadows are traced through.

    :param grid: (ny, nx) control heights.
    :returns: surface heights at the grid points, (ny, nx) float32, and the roofs over blocks of
        NARROW, WIDE and HUGE cells.
    """
    padded = np.pad(grid, 1, mode='edge')
    rows = (padded[:-2] + 4 * padded[1:-1] + padded[2:]) / 6
    surface = ((rows[:, :-2] + 4 * rows[:, 1:-1] + rows[:, 2:]) / 6).astype(np.float32)
    return surface, *(_roofs(surface, x0, y0, pitch, block) for block in (NARROW, WIDE, HUGE))


@nb.njit(cache=True, inline='always')
def _clear_until(roofs, t, x, y, z, i, j, dx, dy, tangent, inverse_x, inverse_y, x0, y0, side):  # type: ignore[no-untyped-def]
    """Where the line leaves block (i, j), and whether it stays above the block's roof."""
    edge_x = x0 + (i + (1 if dx > 0.0 else 0)) * side
    edge_y = y0 + (j + (1 if dy > 0.0 else 0)) * side
    leave = max(t, min((edge_x - x) * inverse_x, (edge_y - y) * inverse_y))
    a, b, c = roofs[j, i, 0], roofs[j, i, 1], roofs[j, i, 2]
    start = z - a - b * x - c * y
    slope = tangent - b * dx - c * dy
    return leave, min(start + t * slope, start + leave * slope) > 0.0


@nb.njit(cache=True, fastmath=True)
def _horizon(surface, narrow, wide, huge, top, x0, y0, pitch, x, y, z, dx, dy, lowest, highest):  # type: ignore[no-untyped-def]
    """Tangent of the elevation below which the surface hides the sky, seen from (x, y, z).

    :param narrow: roofs of the small blocks; wide and huge those of the larger ones.
    :param top: highest point of all, m.
    :param dx: horizontal unit direction, with dy.
    :param lowest: lower tangents are of no interest and are returned as this.
    :param highest: the search ends where the tangent has reached this.
    """
    tangent = lowest
    step = 0.7 * pitch
    # the facet that the point lies on is the business of n.l: leave it out
    t = 1.5 * step
    past = 0.01 * pitch
    side = NARROW * pitch
    per_side, per_pitch = 1.0 / side, 1.0 / pitch
    inverse_x = 1.0 / dx if abs(dx) > 1e-9 else 1e9
    inverse_y = 1.0 / dy if abs(dy) > 1e-9 else 1e9
    columns, rows = surface.shape[1] - 1.001, surface.shape[0] - 1.001
    while True:
        if tangent >= highest or (z + t * tangent > top and tangent >= 0.0):
            return tangent
        u, v = (x + t * dx - x0) * per_side, (y + t * dy - y0) * per_side
        if u < 0.0 or v < 0.0 or u >= narrow.shape[1] or v >= narrow.shape[0]:
            return tangent
        i, j = int(u), int(v)
        leave, clear = _clear_until(huge, t, x, y, z, i // (HUGE // NARROW), j // (HUGE // NARROW),
                                    dx, dy, tangent, inverse_x, inverse_y, x0, y0, HUGE * pitch)
        if not clear:
            leave, clear = _clear_until(
                wide, t, x, y, z, i // (WIDE // NARROW), j // (WIDE // NARROW), dx, dy, tangent,
                inverse_x, inverse_y, x0, y0, WIDE * pitch)
        if not clear:
            leave, clear = _clear_until(narrow, t, x, y, z, i, j, dx, dy, tangent, inverse_x,
                                        inverse_y, x0, y0, side)
        if clear:
            t = leave + past
            continue
        leave += past
        while t < leave:
            u = min(max((x + t * dx - x0) * per_pitch, 0.0), columns)
            v = min(max((y + t * dy - y0) * per_pitch, 0.0), rows)
            i, j = int(u), int(v)
            u -= i
            v -= j
            low = surface[j, i] + u * (surface[j, i + 1] - surface[j, i])
            high = surface[j + 1, i] + u * (surface[j + 1, i + 1] - surface[j + 1, i])
            rise = low + v * (high - low) - z
            if rise > tangent * t:
                tangent = rise / t
            t += step


@nb.njit(cache=True, inline='always')
def _microfacet(cos_l, cos_v, cos_h, cos_d, specular, alpha):  # type: ignore[no-untyped-def]
    """GGX reflection (Walter et al. 2007), Smith's shadowing, Schlick's Fresnel term."""
    a2 = alpha * alpha
    spread = cos_h * cos_h * (a2 - 1.0) + 1.0
    facets = a2 / (_PI * spread * spread)
    shade_l = cos_l + math.sqrt(a2 + (1.0 - a2) * cos_l * cos_l)
    shade_v = cos_v + math.sqrt(a2 + (1.0 - a2) * cos_v * cos_v)
    fresnel = specular + (1.0 - specular) * (1.0 - cos_d) ** 5
    return facets * fresnel / (shade_l * shade_v)


@nb.njit(cache=True, fastmath=True)
def _reflection(nx, ny, nz, lx, ly, lz, vx, vy, vz, cos_l, diffuse, specular, alpha):  # type: ignore[no-untyped-def]
    """Bidirectional reflectance: Lambert plus microfacets."""
    if specular <= 0.0:
        return diffuse
    hx, hy, hz = lx + vx, ly + vy, lz + vz
    length = math.sqrt(hx * hx + hy * hy + hz * hz)
    cos_v = max(nx * vx + ny * vy + nz * vz, 1e-3)
    cos_h = (nx * hx + ny * hy + nz * hz) / length
    cos_d = (lx * hx + ly * hy + lz * hz) / length
    return diffuse + _microfacet(cos_l, cos_v, cos_h, cos_d, specular, alpha)


@nb.njit(cache=True, fastmath=True)
def _sum_emitters(emitters, panel, x, y, z, nx, ny, nz, vx, vy, vz, diffuse, specular, alpha,  # type: ignore[no-untyped-def]
                  horizons, first, spacing):
    """Radiance towards the camera under the emitters that stand above the horizon.

    An emitter stands for its part of the panel, so one that the horizon cuts counts in part.

    :param emitters: (E, 4) position and area.
    :param panel: rows: axis, right, up, (part width, part height, lobe exponent), sideways,
        forward; the last two are the horizontal unit vectors that horizons refer to.
    :param horizons: (K,) tangents at equal steps of sideways / forward, from ``first``; none: all
        emitters are above the horizon.
    """
    radiance = 0.0
    lobe = panel[3, 2]
    for e in range(emitters.shape[0]):
        dx, dy, dz = emitters[e, 0] - x, emitters[e, 1] - y, emitters[e, 2] - z
        square = dx * dx + dy * dy + dz * dz
        distance = math.sqrt(square)
        lx, ly, lz = dx / distance, dy / distance, dz / distance
        cos_l = nx * lx + ny * ly + nz * lz
        cos_e = -(panel[0, 0] * lx + panel[0, 1] * ly + panel[0, 2] * lz)
        if cos_l <= 0.0 or cos_e <= 0.0:
            continue
        seen = 1.0
        if horizons.size > 0:
            forward = dx * panel[5, 0] + dy * panel[5, 1]
            sideways = dx * panel[4, 0] + dy * panel[4, 1]
            k = min(max((sideways / forward - first) / spacing, 0.0), horizons.size - 1.001)
            i = int(k)
            horizon = horizons[i] + (k - i) * (horizons[i + 1] - horizons[i])
            flat = math.sqrt(dx * dx + dy * dy)
            tangent = dz / flat
            # how far the tangent changes over this part of the panel
            across = tangent * (panel[1, 0] * dx + panel[1, 1] * dy) / flat - panel[1, 2]
            along = tangent * (panel[2, 0] * dx + panel[2, 1] * dy) / flat - panel[2, 2]
            extent = (abs(across) * panel[3, 0] + abs(along) * panel[3, 1]) / flat
            seen = min(max((tangent - horizon) / extent + 0.5, 0.0), 1.0)
            if seen == 0.0:
                continue
        reflected = _reflection(nx, ny, nz, lx, ly, lz, vx, vy, vz, cos_l, diffuse, specular,
                                alpha)
        lobe_gain = cos_e if lobe == 1.0 else cos_e ** lobe
        radiance += seen * reflected * lobe_gain * cos_l / square * emitters[e, 3]
    return radiance


@nb.njit(cache=True, parallel=True, fastmath=True)
def shade(points, specular, alpha, coarse, coarse_panel, fine, fine_panel, corners, intensity,  # type: ignore[no-untyped-def]
          surface, narrow, wide, huge, top, x0, y0, pitch, standoff):
    """Radiance towards the camera of every visible point under one panel.

    Where the whole panel is above the point's own facet and above the horizon, the coarse
    emitters are summed; elsewhere (penumbra, terminator) the fine ones with a finer horizon.

    :param points: (6, N) float32 as from :func:`intersect`.
    :param specular: normal-incidence reflectance of the gloss; 0 for a matt surface.
    :param alpha: GGX roughness of the gloss.
    :param coarse: (E, 4) emitters and (6, 3) panel, see :func:`_sum_emitters`.
    :param fine: (F, 4), the same panel in smaller parts.
    :param corners: (4, 3) of the panel.
    :param intensity: radiance of the panel.
    :returns: (N,) float32.
    """
    out = np.empty(points.shape[1], np.float32)
    none = np.empty(0)
    for k in nb.prange(points.shape[1]):
        x, y, z = float(points[0, k]), float(points[1, k]), float(points[2, k])
        p, q = float(points[3, k]), float(points[4, k])
        length = math.sqrt(1.0 + p * p + q * q)
        nx, ny, nz = -p / length, -q / length, 1.0 / length
        vx, vy, vz = -x, -y, standoff - z
        length = math.sqrt(vx * vx + vy * vy + vz * vz)
        vx, vy, vz = vx / length, vy / length, vz / length
        diffuse = points[5, k] / _PI
        # the panel's extent as seen from here; all extremes are at its corners
        behind = 0
        lowest, left, right = 1e9, 1e9, -1e9
        nearest, rise = 1e9, 0.0
        for c in range(4):
            dx, dy, dz = corners[c, 0] - x, corners[c, 1] - y, corners[c, 2] - z
            if (nx * dx + ny * dy + nz * dz <= 0.0 or
                    coarse_panel[0, 0] * dx + coarse_panel[0, 1] * dy
                    + coarse_panel[0, 2] * dz >= 0.0):
                behind += 1
            forward = max(dx * coarse_panel[5, 0] + dy * coarse_panel[5, 1], 1e-4)
            sideways = (dx * coarse_panel[4, 0] + dy * coarse_panel[4, 1]) / forward
            left, right = min(left, sideways), max(right, sideways)
            nearest, rise = min(nearest, forward), max(rise, dz)
            lowest = min(lowest, dz / math.sqrt(dx * dx + dy * dy))
        if behind == 4:
            out[k] = 0.0
            continue
        highest = rise / nearest
        whole, dark = behind == 0, True
        for a in range(COARSE_AZIMUTHS):
            along = left + (right - left) * a / (COARSE_AZIMUTHS - 1)
            dx = coarse_panel[5, 0] + along * coarse_panel[4, 0]
            dy = coarse_panel[5, 1] + along * coarse_panel[4, 1]
            length = math.sqrt(dx * dx + dy * dy)
            horizon = _horizon(surface, narrow, wide, huge, top, x0, y0, pitch, x, y, z,
                               dx / length, dy / length, lowest, highest)
            whole, dark = whole and horizon <= lowest, dark and horizon >= highest
            if not whole and not dark:
                break
        if dark:
            out[k] = 0.0
            continue
        if whole:
            out[k] = intensity * _sum_emitters(
                coarse, coarse_panel, x, y, z, nx, ny, nz, vx, vy, vz, diffuse, specular, alpha,
                none, 0.0, 1.0)
            continue
        horizons = np.empty(FINE_AZIMUTHS)
        spacing = (right - left) / (FINE_AZIMUTHS - 1)
        for a in range(FINE_AZIMUTHS):
            along = left + spacing * a
            dx = coarse_panel[5, 0] + along * coarse_panel[4, 0]
            dy = coarse_panel[5, 1] + along * coarse_panel[4, 1]
            length = math.sqrt(dx * dx + dy * dy)
            horizons[a] = _horizon(surface, narrow, wide, huge, top, x0, y0, pitch, x, y, z,
                                   dx / length, dy / length, lowest, highest)
        out[k] = intensity * _sum_emitters(
            fine, fine_panel, x, y, z, nx, ny, nz, vx, vy, vz, diffuse, specular, alpha,
            horizons, left, spacing)
    return out
