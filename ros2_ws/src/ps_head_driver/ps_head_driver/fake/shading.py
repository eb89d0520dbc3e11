"""Light of a panel that points of a surface send to the camera: emitters summed, shadows traced.

Shares no code with light_model.py: agreement between renderer and solver has to mean something.
All lengths in metres, frame ps_head_plane.
"""
import math

import numba as nb
import numpy as np

from ps_head_driver.fake.kernels import FAST, RUN, TURNS
from ps_head_driver.fake.shadows import clears_all, horizon, nearest

COARSE = 7                     # directions across a panel in which shadows are looked for,
AZIMUTHS = 2 * COARSE - 1      # and with those between where there are some
_PI = math.pi


@nb.njit(forceinline=True, **FAST)
def _contribution(dx, dy, dz, area, axis, lobe, normal, view, finish):  # type: ignore[no-untyped-def]
    """Radiance that an emitter (dx, dy, dz) away sends to the camera over a point.

    Lambert plus GGX microfacets (Walter et al. 2007) with Smith's shadowing and Schlick's Fresnel
    term. No branches, so that the compiler can take several emitters at once.

    :param normal: unit vector; so is view, towards the camera.
    :param finish: of :func:`_finish`.
    """
    diffuse, specular, a2, cos_v, shade_v = finish
    nearness = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
    cos_l = max(normal[0] * dx + normal[1] * dy + normal[2] * dz, 0.0) * nearness
    cos_e = max(-(axis[0] * dx + axis[1] * dy + axis[2] * dz), 0.0) * nearness
    reflected = diffuse
    if specular > 0.0:
        # cos^2 of half the angle between light and view, which is that of either to the facets
        half = 0.5 + 0.5 * (view[0] * dx + view[1] * dy + view[2] * dz) * nearness
        cos_h2 = 0.25 * (cos_l + cos_v) * (cos_l + cos_v) / half
        spread = 1.0 + cos_h2 * (a2 - 1.0)
        shade_l = cos_l + math.sqrt(a2 + (1.0 - a2) * cos_l * cos_l)
        grazing = 1.0 - math.sqrt(half)
        square = grazing * grazing
        fresnel = specular + (1.0 - specular) * square * square * grazing
        reflected += a2 * fresnel / (_PI * spread * spread * shade_l * shade_v)
    emission = cos_e if lobe is None else cos_e ** lobe
    return reflected * emission * cos_l * nearness * nearness * area


@nb.njit(forceinline=True, **FAST)
def _finish(albedo, gloss, normal, view):  # type: ignore[no-untyped-def]
    """What the sums over emitters have in common at one point.

    :param gloss: reflectance at normal incidence, 0 for a matt surface, and GGX roughness.
    :returns: diffuse and specular reflectance, square of the roughness, cosine of the view and
        Smith's denominator for it.
    """
    a2 = gloss[1] * gloss[1]
    cos_v = max(normal[0] * view[0] + normal[1] * view[1] + normal[2] * view[2], 1e-3)
    shade_v = cos_v + math.sqrt(a2 + (1.0 - a2) * cos_v * cos_v)
    return albedo / _PI, gloss[0], a2, cos_v, shade_v


@nb.njit(**FAST)
def _sum_all(emitters, panel, lobe, point, normal, view, finish):  # type: ignore[no-untyped-def]
    """Radiance towards the camera under all emitters of a panel."""
    axis = (panel[0, 0], panel[0, 1], panel[0, 2])
    radiance = 0.0
    for e in range(emitters.shape[1]):
        radiance += _contribution(
            emitters[0, e] - point[0], emitters[1, e] - point[1], emitters[2, e] - point[2],
            emitters[3, e], axis, lobe, normal, view, finish)
    return radiance


@nb.njit(**FAST)
def _sum_visible(emitters, panel, lobe, point, normal, view, finish, horizons, first, spacing):  # type: ignore[no-untyped-def]
    """Radiance towards the camera under the emitters that stand above the horizon.

    An emitter stands for its part of the panel, so one that the horizon cuts counts in part.

    :param horizons: (K,) tangents at equal steps of sideways / forward, from ``first``.
    """
    axis = (panel[0, 0], panel[0, 1], panel[0, 2])
    radiance = 0.0
    for e in range(emitters.shape[1]):
        dx, dy, dz = (emitters[0, e] - point[0], emitters[1, e] - point[1],
                      emitters[2, e] - point[2])
        forward = dx * panel[5, 0] + dy * panel[5, 1]
        sideways = dx * panel[4, 0] + dy * panel[4, 1]
        k = min(max((sideways / forward - first) / spacing, 0.0), horizons.size - 1.001)
        i = int(k)
        hidden = horizons[i] + (k - i) * (horizons[i + 1] - horizons[i])
        flat = math.sqrt(dx * dx + dy * dy)
        tangent = dz / flat
        # how far the tangent changes over this part of the panel
        across = tangent * (panel[1, 0] * dx + panel[1, 1] * dy) / flat - panel[1, 2]
        along = tangent * (panel[2, 0] * dx + panel[2, 1] * dy) / flat - panel[2, 2]
        extent = (abs(across) * panel[3, 0] + abs(along) * panel[3, 1]) / flat
        seen = min(max((tangent - hidden) / extent + 0.5, 0.0), 1.0)
        if seen > 0.0:
            radiance += seen * _contribution(dx, dy, dz, emitters[3, e], axis, lobe, normal, view,
                                             finish)
    return radiance


@nb.njit(forceinline=True, **FAST)
def _extent(point, normal, corners, panel):  # type: ignore[no-untyped-def]
    """A panel as seen from a point; all extremes are at its corners.

    :returns: how many corners are behind the point's facet or see the panel's back; lowest and
        highest tangent of elevation; leftmost and rightmost sideways / forward.
    """
    behind = 0
    lowest, left, right = 1e9, 1e9, -1e9
    nearest, rise = 1e9, 0.0
    for c in range(4):
        dx, dy, dz = (corners[c, 0] - point[0], corners[c, 1] - point[1],
                      corners[c, 2] - point[2])
        if (normal[0] * dx + normal[1] * dy + normal[2] * dz <= 0.0
                or panel[0, 0] * dx + panel[0, 1] * dy + panel[0, 2] * dz >= 0.0):
            behind += 1
        forward = max(dx * panel[5, 0] + dy * panel[5, 1], 1e-4)
        sideways = (dx * panel[4, 0] + dy * panel[4, 1]) / forward
        left, right = min(left, sideways), max(right, sideways)
        nearest, rise = min(nearest, forward), max(rise, dz)
        lowest = min(lowest, dz / math.sqrt(dx * dx + dy * dy))
    return behind, lowest, rise / nearest, left, right


@nb.njit(forceinline=True, **FAST)
def _radiance(point, slope, albedo, gloss, lobe, coarse, coarse_panel, fine, fine_panel, corners,  # type: ignore[no-untyped-def]
              surface, narrow, wide, huge, frame, standoff, horizons):
    """Radiance towards the camera of one point, see :func:`shade`.

    :param horizons: (AZIMUTHS,) to work in.
    """
    length = math.sqrt(1.0 + slope[0] * slope[0] + slope[1] * slope[1])
    normal = (-slope[0] / length, -slope[1] / length, 1.0 / length)
    x, y, z = -point[0], -point[1], standoff - point[2]
    length = math.sqrt(x * x + y * y + z * z)
    view = (x / length, y / length, z / length)
    behind, lowest, highest, left, right = _extent(point, normal, corners, coarse_panel)
    if behind == 4:
        return 0.0
    whole, dark, way = behind == 0, True, 0.0
    spacing = (right - left) / (AZIMUTHS - 1)
    if clears_all(frame, point[2], lowest, nearest(frame)):
        dark = False
    else:
        # every other azimuth first: most points are in no shadow or in a full one
        for n in range(AZIMUTHS):
            a = 2 * n if n < COARSE else 2 * (n - COARSE) + 1
            if n == COARSE and (whole or dark):
                break
            along = left + spacing * a
            dx, dy = (coarse_panel[5, 0] + along * coarse_panel[4, 0],
                      coarse_panel[5, 1] + along * coarse_panel[4, 1])
            length = math.sqrt(dx * dx + dy * dy)
            horizons[a], way = horizon(
                surface, narrow, wide, huge, frame, point[0], point[1], point[2], dx / length,
                dy / length, lowest, highest, way)
            whole, dark = whole and horizons[a] <= lowest, dark and horizons[a] >= highest
    if dark:
        return 0.0
    finish = _finish(albedo, gloss, normal, view)
    if whole:
        return _sum_all(coarse, coarse_panel, lobe, point, normal, view, finish)
    return _sum_visible(fine, fine_panel, lobe, point, normal, view, finish, horizons, left,
                        spacing)


@nb.njit(parallel=True, **FAST)
def shade(points, gloss, lobe, coarse, coarse_panel, fine, fine_panel, corners, intensity,  # type: ignore[no-untyped-def]
          surface, narrow, wide, huge, frame, standoff):
    """Radiance towards the camera of every visible point under one panel.

    Where the whole panel is above the point's own facet and above the horizon, the coarse
    emitters are summed; elsewhere (penumbra, terminator) the fine ones with a finer horizon.

    :param points: (6, N) float32 as from spline_surface.intersect.
    :param gloss: reflectance at normal incidence, 0 for a matt surface, and GGX roughness.
    :param lobe: exponent of the panel's emission; None for 1, a Lambertian panel.
    :param coarse: (4, E) emitters: position and area; and (6, 3) the panel: axis, right, up,
        (width and height of an emitter's part, 0), and the horizontal unit vectors sideways and
        forward that horizons refer to.
    :param fine: (4, F) and (6, 3), the same panel in smaller parts.
    :param corners: (4, 3) of the panel.
    :param intensity: radiance of the panel.
    :param surface: with narrow, wide, huge and frame what shadows.shadow_ground makes.
    :returns: (N,) float32.
    """
    count = points.shape[1]
    out = np.empty(count, np.float32)
    for turn in nb.prange(TURNS):
        horizons = np.empty(AZIMUTHS)
        for start in range(turn * RUN, count, TURNS * RUN):
            for k in range(start, min(start + RUN, count)):
                point = (float(points[0, k]), float(points[1, k]), float(points[2, k]))
                out[k] = intensity * _radiance(
                    point, (float(points[3, k]), float(points[4, k])), float(points[5, k]), gloss,
                    lobe, coarse, coarse_panel, fine, fine_panel, corners, surface, narrow, wide,
                    huge, frame, standoff, horizons)
    return out
