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
from ps_reconstruction.integration import BAND, divergence, laplace_eigenvalues, solve_poisson

# sigma of the ISO 16610 Gaussian over its cut-off wavelength: sqrt(ln 2 / 2) / pi
SIGMA_PER_CUTOFF = float(np.sqrt(np.log(2) / 2) / np.pi)
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
    # derivatives across three pixels; rows count downwards, y upwards
    n_x[~valid] = np.nan
    n_y[~valid] = np.nan
    out = np.full(valid.shape, np.nan, np.float32)
    scale = np.float32(-0.25 / pitch)
    out[1:-1, 1:-1] = scale * (
        n_x[1:-1, 2:] - n_x[1:-1, :-2] + n_y[:-2, 1:-1] - n_y[2:, 1:-1])
    if min(out.shape) > 2:
        out[0], out[-1], out[:, 0], out[:, -1] = out[1], out[-2], out[:, 1], out[:, -2]
    out[~valid] = np.nan
    return out


def shape_image(
    relief: NDArray[np.float32], valid: NDArray[np.bool_], contrast: float = 1.0,
) -> NDArray[np.uint8]:
    """Grey picture of a relief: raised bright, sunk dark, flat and invalid pixels mid-grey.

    :param relief: (H, W) band-passed height, any unit.
    :param contrast: 1 maps three robust standard deviations to 76 % of the range; what stands out
        further is compressed, not clipped.
    """
    lattice = max(1, int(np.sqrt(relief.size / 50000)))
    sample = relief[::lattice, ::lattice][valid[::lattice, ::lattice]]
    if sample.size == 0:
        return np.full(relief.shape, NEUTRAL, np.uint8)
    middle = np.float32(np.median(sample))
    spread = max(1.4826 * float(np.median(np.abs(sample - middle))), 1e-30)
    out = np.empty(relief.shape, np.uint8)
    gain = np.float32(contrast / (3 * spread))
    for_bands(len(relief), BAND, lambda i, j: _grey_rows(
        relief[i:j], valid[i:j], middle, gain, out[i:j]))
    return out


def band_passed(du: NDArray[np.float32], dv: NDArray[np.float32], short_px: float, long_px: float
                ) -> NDArray[np.float32]:
    """Integrate gradients and keep the form between two Gaussian filters, in one solution.

    :param du, dv: (H, W) gradients along columns and rows per pixel, NaN counts as 0.
    :param short_px: sigma below which form is smoothed away; 0 for none.
    :param long_px: sigma above which form is flattened away; 0 for none.
    """
    right = divergence(du, dv)
    transfers = []
    for sigma in (short_px, long_px):
        transfers.append([np.exp(0.5 * sigma ** 2 * laplace_eigenvalues(n)).astype(np.float32)
                          for n in right.shape])
    (short_y, short_x), (long_y, long_x) = transfers
    response = np.outer(short_y, short_x)
    if long_px > 0:
        response -= np.outer(long_y, long_x)
    return solve_poisson(right, response)


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
    height = band_passed(du, dv, short, long)[inside].astype(np.float64) * metres
    height -= height.mean()
    square = np.zeros(height.shape)
    slopes = slope(normal)
    for a in (0, 1):
        band = smooth(slopes[..., a], valid, short) - smooth(slopes[..., a], valid, long)
        square += band[inside].astype(np.float64) ** 2
    return Roughness(
        sa=float(np.abs(height).mean()), sq=float(np.sqrt((height ** 2).mean())),
        sdq=float(np.sqrt(square.mean())), sdr=float(np.sqrt(1 + square).mean() - 1))


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
def _grey_rows(relief, valid, middle, gain, out):    # type: ignore[no-untyped-def]
    rows, width = relief.shape
    for y in range(rows):
        for x in range(width):
            grey = np.float32(0)
            if valid[y, x]:
                grey = np.tanh((relief[y, x] - middle) * gain)
            out[y, x] = np.uint8(np.float32(NEUTRAL) + np.float32(127) * grey + np.float32(0.5))
