"""Single features that surfaces are made of: smooth steps, grooves, random texture. Metres."""
import math

import numpy as np
from numpy.typing import NDArray


def smoothstep(edge0: float, edge1: float, x: NDArray) -> NDArray:
    """0 below edge0, 1 above edge1, smooth between."""
    t = np.clip((x - edge0) / (edge1 - edge0), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def scratch(x: NDArray, y: NDArray, along: float, length: float, width: float, depth: float,
            bend: float = 0.0) -> NDArray:
    """A straight or slightly bent groove with raised lips that runs out at both ends.

    :param along: azimuth of its direction, rad.
    :param width: at which the groove is 1/e deep, to either side of its middle, m.
    :param bend: curvature of its line, half of it 1/m.
    :returns: height to add, m; negative in the groove.
    """
    u = x * math.cos(along) + y * math.sin(along)
    v = y * math.cos(along) - x * math.sin(along) - bend * u * u
    ends = 1 - smoothstep(0.35 * length, 0.5 * length, np.abs(u))
    shape = np.exp(-(v / width) ** 2) - 0.35 * np.exp(-((np.abs(v) - 2 * width) / width) ** 2)
    return -depth * ends * shape


def random_texture(shape: tuple[int, int], pitch: float, correlation: tuple[float, float],
                   random: np.random.Generator) -> NDArray:
    """Gaussian random field of mean 0 and variance 1 over the grid.

    Its autocorrelation at the distance (x, y) is exp(-(x/cx)^2 - (y/cy)^2), ISO 25178's Sal
    (fall to 0.2) being 1.27 times the correlation length. It repeats beyond the grid.

    :param shape: (ny, nx).
    :param correlation: lengths cx and cy, m.
    """
    along_y, along_x = (np.fft.fftfreq(n, pitch) for n in shape)
    along_x = along_x[:shape[1] // 2 + 1]
    spectrum = np.fft.rfft2(random.standard_normal(shape))
    # the filter's autocorrelation is the surface's, so its own exponent is doubled
    spectrum *= np.exp(-0.5 * (math.pi * correlation[0] * along_x) ** 2)
    spectrum *= np.exp(-0.5 * (math.pi * correlation[1] * along_y[:, None]) ** 2)
    texture = np.fft.irfft2(spectrum, shape)
    texture -= texture.mean()
    return np.asarray(texture / texture.std())


def control_heights(height: NDArray) -> NDArray:
    """Control heights of the cubic B-spline through these heights, for fine smooth texture.

    Heights used as control heights are flattened a little: by 4 % at a wavelength of 12 pitches.
    Not for steps, beside which the exact spline overshoots.
    """
    from scipy.ndimage import spline_filter
    return np.asarray(spline_filter(height, order=3, mode='mirror'))
