"""Surface measures from normals: slope, curvature, shape-enhanced image, roughness.

Filters are Gaussian. A standard deviation in pixels is called sigma_px; a roughness nesting index
(cut-off wavelength, ISO 16610-61) is in metres, its Gaussian has 50 % transmission there.
"""
from dataclasses import dataclass

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from ps_reconstruction.bands import for_bands
from ps_reconstruction.integration import BAND, poisson, remove_plane

# sigma of the ISO 16610 Gaussian over its cut-off wavelength: sqrt(ln 2 / 2) / pi
SIGMA_PER_CUTOFF = float(np.sqrt(np.log(2) / 2) / np.pi)
FLAT_RELIEF_PX = 1e-4         # least spread of the shape image, in pixel pitches of height
DARK_SHARE = 0.25             # of the bright parts' albedo: there a slope counts half
NEUTRAL = 128                 # grey of a flat surface in the shape-enhanced image


@dataclass(frozen=True)
class Roughness:
    """ISO 25178-2 parameters of the S-L surface; metres, slopes dimensionless."""

    sa: float = float('nan')
    sq: float = float('nan')
    sdq: float = float('nan')
    sdr: float = float('nan')


def slope(normal: NDArray[np.float32]) -> NDArray[np.float32]:
    """Slopes (p, q) = (dz/dx, dz/dy) in ps_head_plane axes, (H, W, 3) to (H, W, 2)."""
    out = np.empty((*normal.shape[:2], 2), np.float32)
    for_bands(len(normal), BAND, lambda i, j: _slope_rows(normal[i:j], out[i:j]))
    return out


def mean_curvature(normal: NDArray[np.float32], pitch: float, sigma_px: float = 1.0
                   ) -> NDArray[np.float32]:
    """Mean curvature (k1 + k2) / 2, 1/m; positive in a hollow, negative on a bump.

    H = -1/2 (dn_x/dx + dn_y/dy), exact for any slope.

    :param normal: (H, W, 3), n_plane.
    :param pitch: pixel distance on the surface, m.
    :param sigma_px: smoothing before the derivative.
    """
    valid = np.isfinite(normal[..., 2])
    n_x, n_y = (smooth(normal[..., a], valid, sigma_px) for a in (0, 1))
    if min(valid.shape) < 3:
        return np.full(valid.shape, np.nan, np.float32)
    out = np.empty(valid.shape, np.float32)
    scale = np.float32(-0.25 / pitch)
    for_bands(len(out), BAND, lambda i, j: _curvature_rows(n_x, n_y, valid, scale, i, j, out))
    return out


def relief(
    du: NDArray[np.float32], dv: NDArray[np.float32], albedo: NDArray[np.float32],
    short_px: float, long_px: float,
) -> NDArray[np.float32]:
    """Local relief for people to look at: fine form kept, slow form and dark noise subdued.

    The slopes lose their local mean, so a bowl from imperfect lights does not show; dark pixels,
    whose slopes are mostly noise, count less; the integration fades beyond ``long_px`` with one
    pole (screened Poisson), which rings less at edges than a Gaussian high-pass.

    :param du, dv: (H, W) gradients along columns and rows per pixel, NaN where unknown.
    :param albedo: (H, W) or (H, W, 3), NaN where unknown.
    :param short_px: sigma of the Gaussian smoothing.
    :param long_px: length beyond which form is flattened away.
    """
    light = albedo if albedo.ndim == 2 else albedo.mean(axis=-1)
    lattice = max(1, int(np.sqrt(light.size / 50000)))
    sample = light[::lattice, ::lattice]
    sample = sample[np.isfinite(sample)]
    bright = max(float(np.percentile(sample, 95)), 1e-12) if sample.size else 1.0
    trust, flat_u, flat_v = (np.empty(du.shape, np.float32) for _ in range(3))
    dark = np.float32((DARK_SHARE * bright) ** 2)
    for_bands(len(du), BAND, lambda i, j: _weigh_rows(
        du[i:j], dv[i:j], light[i:j], dark, trust[i:j], flat_u[i:j], flat_v[i:j]))
    factor = max(1, int(long_px / 4))
    size = (max(1, du.shape[1] // factor), max(1, du.shape[0] // factor))

    def local_sum(values: NDArray) -> NDArray:
        small = cv2.resize(values, size, interpolation=cv2.INTER_AREA)
        return np.asarray(cv2.GaussianBlur(small, (0, 0), long_px / factor))

    weight = local_sum(trust) + np.float32(1e-6)
    for weighted in (flat_u, flat_v):
        mean = np.asarray(cv2.resize(local_sum(weighted) / weight, du.shape[::-1],
                                     interpolation=cv2.INTER_LINEAR), np.float32)
        np.multiply(mean, trust, out=mean)
        weighted -= mean
    return poisson(flat_u, flat_v, short_px, pole_px=long_px)


def shape_image(
    relief: NDArray[np.float32], valid: NDArray[np.bool_], contrast: float = 1.0,
    unit_px: float = 1.0,
) -> NDArray[np.uint8]:
    """Grey picture of a relief: raised bright, sunk dark, flat and invalid pixels mid-grey.

    :param relief: (H, W), any unit.
    :param unit_px: what one pixel pitch of height is in that unit; negative if it counts down.
    :param contrast: 1 maps three robust standard deviations to half the range; what stands out
        further is compressed, not clipped.
    """
    lattice = max(1, int(np.sqrt(relief.size / 50000)))
    sample = relief[::lattice, ::lattice][valid[::lattice, ::lattice]]
    if sample.size == 0:
        return np.full(relief.shape, NEUTRAL, np.uint8)
    middle = np.float32(np.median(sample))
    spread = 1.4826 * float(np.median(np.abs(sample - middle)))
    # a perfectly flat part stays grey instead of showing its rounding errors
    spread = max(spread, FLAT_RELIEF_PX * abs(unit_px))
    out = np.empty(relief.shape, np.uint8)
    gain = np.float32(np.copysign(contrast / (3 * spread), unit_px))
    for_bands(len(relief), BAND, lambda i, j: _grey_rows(
        relief[i:j], valid[i:j], middle, gain, out[i:j]))
    return out


def roughness(
    normal: NDArray[np.float32], du: NDArray[np.float32], dv: NDArray[np.float32], pitch: float,
    metres: float, s_filter: float, l_filter: float,
) -> Roughness:
    """Sa, Sq from the band-passed height; Sdq, Sdr from the band-passed slopes.

    The S-L surface of ISO 25178-2: Gaussian S-filter and L-filter (ISO 16610-61). A margin of half
    the L-filter's nesting index is left out, where the picture is wide enough.

    :param normal: (H, W, 3), n_plane.
    :param du, dv: gradients to integrate, see integration.gradients.
    :param pitch: pixel distance, m.
    :param metres: height in metres per unit of the integral.
    :param s_filter: nesting index, m; 0 for none.
    :param l_filter: nesting index, m.
    """
    valid = np.isfinite(normal[..., 2])
    short, long = (SIGMA_PER_CUTOFF * f / pitch for f in (s_filter, l_filter))
    margin = int(l_filter / pitch / 2)
    inside = np.zeros_like(valid)
    if 4 * margin >= min(valid.shape):
        margin = 0
    inside[margin:valid.shape[0] - margin, margin:valid.shape[1] - margin] = True
    inside &= valid
    if not inside.any():
        return Roughness()
    height = poisson(du, dv, short, long)[inside].astype(np.float64) * metres
    height -= height.mean()
    square = np.zeros(height.shape)
    slopes = slope(normal)
    for a in (0, 1):
        band = smooth(slopes[..., a], valid, short) - smooth(slopes[..., a], valid, long)
        square += band[inside].astype(np.float64) ** 2
    return Roughness(
        sa=float(np.abs(height).mean()), sq=float(np.sqrt((height ** 2).mean())),
        sdq=float(np.sqrt(square.mean())), sdr=float(np.sqrt(1 + square).mean() - 1))


def without_slow_form(height: NDArray[np.float32], long_px: float) -> NDArray[np.float32]:
    """Height less its local mean over about ``long_px``; median 0.

    A plane goes first, so that the borders do not bend.
    """
    height = remove_plane(height)
    valid = np.isfinite(height)
    factor = max(1, int(long_px / 16))
    size = (max(1, height.shape[1] // factor), max(1, height.shape[0] // factor))
    share = cv2.resize(valid.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    total = cv2.resize(np.nan_to_num(height), size, interpolation=cv2.INTER_AREA)
    mean = smooth(np.asarray(total / np.maximum(share, np.float32(1e-6)), np.float32),
                  share > 0.5, long_px / factor)
    height = height - np.asarray(cv2.resize(
        mean, height.shape[::-1], interpolation=cv2.INTER_LINEAR))
    return height - np.float32(np.nanmedian(height)) if valid.any() else height


def smooth(values: NDArray[np.float32], valid: NDArray[np.bool_], sigma_px: float
           ) -> NDArray[np.float32]:
    """Gaussian filter that takes nothing from invalid pixels.

    :returns: (H, W) float32; what is invalid gets the mean of its valid surroundings, or 0.
    """
    filled = np.where(valid, values, np.float32(0))
    if sigma_px <= 0:
        return filled
    border = cv2.BORDER_REFLECT
    blurred = cv2.GaussianBlur(filled, (0, 0), sigma_px, borderType=border)
    if valid.all():
        return np.asarray(blurred)
    share = cv2.GaussianBlur(valid.astype(np.float32), (0, 0), sigma_px, borderType=border)
    return np.where(share > 1e-6, blurred / np.maximum(share, np.float32(1e-6)), np.float32(0))


@numba.njit(nogil=True, cache=True, error_model='numpy')
def _slope_rows(normal, out):    # type: ignore[no-untyped-def]
    rows, width = normal.shape[:2]
    for y in range(rows):
        for x in range(width):
            scale = np.float32(-1) / normal[y, x, 2]
            out[y, x, 0] = normal[y, x, 0] * scale
            out[y, x, 1] = normal[y, x, 1] * scale


@numba.njit(nogil=True, cache=True, error_model='numpy')
def _curvature_rows(n_x, n_y, valid, scale, first, last, out):    # type: ignore[no-untyped-def]
    """Divergence across three pixels; a pixel of the border takes its neighbour's."""
    height, width = out.shape
    for row in range(first, last):
        y = min(max(row, 1), height - 2)
        for column in range(width):
            x = min(max(column, 1), width - 2)
            known = (valid[row, column] and valid[y, x - 1] and valid[y, x + 1]
                     and valid[y - 1, x] and valid[y + 1, x])
            # rows count downwards, y upwards
            out[row, column] = scale * (
                n_x[y, x + 1] - n_x[y, x - 1] + n_y[y - 1, x] - n_y[y + 1, x]
            ) if known else np.float32(np.nan)


@numba.njit(nogil=True, cache=True, error_model='numpy')
def _grey_rows(relief, valid, middle, gain, out):    # type: ignore[no-untyped-def]
    rows, width = relief.shape
    for y in range(rows):
        for x in range(width):
            grey = np.float32(0)
            if valid[y, x]:
                value = (relief[y, x] - middle) * gain
                grey = value / (np.float32(1) + abs(value))
            out[y, x] = np.uint8(np.float32(NEUTRAL) + np.float32(127) * grey + np.float32(0.5))


@numba.njit(nogil=True, cache=True, error_model='numpy')
def _weigh_rows(du, dv, light, dark, trust, out_u, out_v):    # type: ignore[no-untyped-def]
    """Trust in the slopes of pixels of some brightness, and the slopes times it."""
    rows, width = du.shape
    zero = np.float32(0)
    for y in range(rows):
        for x in range(width):
            square = light[y, x] * light[y, x]
            share = square / (square + dark)
            known = share == share and du[y, x] == du[y, x] and dv[y, x] == dv[y, x]
            trust[y, x] = share if known else zero
            out_u[y, x] = share * du[y, x] if known else zero
            out_v[y, x] = share * dv[y, x] if known else zero
