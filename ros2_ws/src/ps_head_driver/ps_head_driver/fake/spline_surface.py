"""A surface of cubic B-splines: heights, slopes, and where the camera's rays meet it.

A surface is a grid of control heights; the uniform cubic B-spline over them is the true surface
(twice differentiable, so that normals are exact). All lengths in metres, frame ps_head_plane.
"""
import math

import numba as nb
import numpy as np


@nb.njit(inline='always', cache=True, error_model='numpy')
def _weights(t):  # type: ignore[no-untyped-def]
    """Cubic B-spline weights and their derivatives at the fraction t of a cell."""
    s = 1.0 - t
    w = (s * s * s / 6.0, (4.0 - 6.0 * t * t + 3.0 * t * t * t) / 6.0,
         (4.0 - 6.0 * s * s + 3.0 * s * s * s) / 6.0, t * t * t / 6.0)
    d = (-0.5 * s * s, 1.5 * t * t - 2.0 * t, -1.5 * s * s + 2.0 * s, 0.5 * t * t)
    return w, d


@nb.njit(inline='always', cache=True, error_model='numpy')
def _cell(u, n):  # type: ignore[no-untyped-def]
    """First of the four control points around grid coordinate u, and the fraction."""
    i = min(max(math.floor(u), 1), n - 3)
    return i - 1, min(max(u - i, 0.0), 1.0)


@nb.njit(cache=True, error_model='numpy')
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


@nb.njit(cache=True, error_model='numpy')
def _bilinear(grid, x0, y0, pitch, x, y):  # type: ignore[no-untyped-def]
    u = min(max((x - x0) / pitch, 0.0), grid.shape[1] - 1.001)
    v = min(max((y - y0) / pitch, 0.0), grid.shape[0] - 1.001)
    i, j = int(u), int(v)
    fx, fy = u - i, v - j
    low = grid[j, i] * (1.0 - fx) + grid[j, i + 1] * fx
    high = grid[j + 1, i] * (1.0 - fx) + grid[j + 1, i + 1] * fx
    return low * (1.0 - fy) + high * fy


@nb.njit(cache=True, error_model='numpy')
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


@nb.njit(parallel=True, cache=True, error_model='numpy')
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
