"""Cast shadows on a surface: how high the horizon stands as seen from a point.

Lines towards the light are traced over the facets between the surface's grid points. Roofs over
blocks of cells, in three sizes, let a line pass all that is below it at once. All lengths in
metres, frame ps_head_plane.
"""
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from ps_head_driver.fake.kernels import FAST

NARROW, WIDE, HUGE = 8, 32, 128     # grid cells along a side of the blocks
_STEP = 0.7                         # of a cell, between samples of the facets
_DEEP = -1e9                        # below everything, m


@nb.njit(**FAST)
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
            a = _DEEP
            for j in range(j0, j1 + 1):
                for i in range(i0, i1 + 1):
                    a = max(a, surface[j, i] - b * (x0 + i * pitch) - c * (y0 + j * pitch))
            roofs[row, column, 0], roofs[row, column, 1], roofs[row, column, 2] = a, b, c
    return roofs


def shadow_ground(grid: NDArray, top: float, x0: float, y0: float,
                  pitch: float) -> tuple[Any, ...]:
    """What shadows are traced through.

    :param grid: (ny, nx) control heights, of which (x0, y0) is the first.
    :param top: height above all, m.
    :returns: surface heights at the grid points, (ny, nx) float32, the roofs over blocks of
        NARROW, WIDE and HUGE cells, and (top, x0, y0, pitch).
    """
    padded = np.pad(grid, 1, mode='edge')
    rows = (padded[:-2] + 4 * padded[1:-1] + padded[2:]) / 6
    surface = ((rows[:, :-2] + 4 * rows[:, 1:-1] + rows[:, 2:]) / 6).astype(np.float32)
    roofs = (_roofs(surface, x0, y0, pitch, block) for block in (NARROW, WIDE, HUGE))
    return surface, *roofs, (top, x0, y0, pitch)


@nb.njit(forceinline=True, **FAST)
def _clear_until(roofs, t, x, y, z, i, j, dx, dy, tangent, inverse_x, inverse_y, x0, y0, side):  # type: ignore[no-untyped-def]
    """Where the line leaves block (i, j), and whether it stays above the block's roof."""
    edge_x = x0 + (i + (1 if dx > 0.0 else 0)) * side
    edge_y = y0 + (j + (1 if dy > 0.0 else 0)) * side
    leave = max(t, min((edge_x - x) * inverse_x, (edge_y - y) * inverse_y))
    a, b, c = roofs[j, i, 0], roofs[j, i, 1], roofs[j, i, 2]
    start = z - a - b * x - c * y
    slope = tangent - b * dx - c * dy
    return leave, min(start + t * slope, start + leave * slope) > 0.0


@nb.njit(forceinline=True, **FAST)
def _rise(surface, x0, y0, per_pitch, x, y):  # type: ignore[no-untyped-def]
    """Height of the facets that cast shadows, held constant beyond the grid."""
    u = min(max((x - x0) * per_pitch, 0.0), surface.shape[1] - 1.001)
    v = min(max((y - y0) * per_pitch, 0.0), surface.shape[0] - 1.001)
    i, j = int(u), int(v)
    u -= i
    low = surface[j, i] + u * (surface[j, i + 1] - surface[j, i])
    high = surface[j + 1, i] + u * (surface[j + 1, i + 1] - surface[j + 1, i])
    return low + (v - j) * (high - low)


@nb.njit(forceinline=True, **FAST)
def clears_all(frame, z, tangent, t):  # type: ignore[no-untyped-def]
    """Whether a line upwards from height z is above everything from the way t on."""
    return z + t * tangent > frame[0] and tangent >= 0.0


@nb.njit(forceinline=True, **FAST)
def nearest(frame):  # type: ignore[no-untyped-def]
    """Way from a point at which shadows begin: its own facet is the business of n.l."""
    return 1.5 * _STEP * frame[3]


@nb.njit(forceinline=True, **FAST)
def horizon(surface, narrow, wide, huge, frame, x, y, z, dx, dy, lowest, highest, guess):  # type: ignore[no-untyped-def]
    """Tangent of the elevation below which the surface hides the sky, seen from (x, y, z).

    :param surface: with narrow, wide, huge and frame what :func:`shadow_ground` makes; apart,
        since a tuple of arrays costs a count of references at every call.
    :param dx: horizontal unit direction, with dy.
    :param lowest: lower tangents are of no interest and are returned as this.
    :param highest: the search ends where the tangent has reached this.
    :param guess: way at which the horizon may be, 0 for none: where it was in a direction nearby.
    :returns: the tangent, and the way to the horizon or 0.
    """
    _, x0, y0, pitch = frame
    tangent, way = lowest, 0.0
    per_side, per_pitch = 1.0 / (NARROW * pitch), 1.0 / pitch
    if guess > 0.0:
        rise = _rise(surface, x0, y0, per_pitch, x + guess * dx, y + guess * dy) - z
        if rise > tangent * guess:
            tangent, way = rise / guess, guess
    t = nearest(frame)
    past = 0.01 * pitch
    inverse_x = 1.0 / dx if abs(dx) > 1e-9 else 1e9
    inverse_y = 1.0 / dy if abs(dy) > 1e-9 else 1e9
    while True:
        if tangent >= highest or clears_all(frame, z, tangent, t):
            return tangent, way
        u, v = (x + t * dx - x0) * per_side, (y + t * dy - y0) * per_side
        if u < 0.0 or v < 0.0 or u >= narrow.shape[1] or v >= narrow.shape[0]:
            return tangent, way
        i, j = int(u), int(v)
        leave, clear = _clear_until(huge, t, x, y, z, i // (HUGE // NARROW), j // (HUGE // NARROW),
                                    dx, dy, tangent, inverse_x, inverse_y, x0, y0, HUGE * pitch)
        if not clear:
            leave, clear = _clear_until(
                wide, t, x, y, z, i // (WIDE // NARROW), j // (WIDE // NARROW), dx, dy, tangent,
                inverse_x, inverse_y, x0, y0, WIDE * pitch)
        if not clear:
            leave, clear = _clear_until(narrow, t, x, y, z, i, j, dx, dy, tangent, inverse_x,
                                        inverse_y, x0, y0, NARROW * pitch)
        if clear:
            t = leave + past
            continue
        leave += past
        while t < leave:
            rise = _rise(surface, x0, y0, per_pitch, x + t * dx, y + t * dy) - z
            if rise > tangent * t:
                tangent, way = rise / t, t
            t += _STEP * pitch
