"""Surfaces as workshops leave them: rough, scratched, welded, painted, laminated.

Like shapes.py: every maker gets the grid and returns height, albedo and gloss. Metres, radians.
"""
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ps_head_driver.fake.features import control_heights, random_texture, scratch, smoothstep


def roughness(x: NDArray, y: NDArray, ra: float = 3.2e-6, correlation: float = 2e-4,
              seed: int = 5, albedo: float = 0.6, specular: float = 0.0,
              gloss: float = 0.3) -> dict[str, Any]:
    """Roughness specimen: an isotropic Gaussian random surface.

    :param ra: mean deviation of the heights from their mean (ISO 21920 Ra, ISO 25178 Sa), m.
    :param correlation: distance at which the autocorrelation has fallen to 1/e, m.
    :param gloss: GGX roughness of what is finer than the grid.
    """
    pitch = _pitch(x)
    if correlation < 3 * pitch:
        raise ValueError(f'correlation must be at least 3 grid pitches, {3 * pitch * 1e6:.0f} um')
    z = random_texture(_shape(x), pitch, (correlation, correlation), np.random.default_rng(seed))
    z *= ra / np.abs(z).mean()
    return {'height': control_heights(z), 'albedo': albedo, 'specular': specular,
            'roughness': gloss}


def scratches(x: NDArray, y: NDArray, depth: float = 1e-5, width: float = 1e-4,
              albedo: float = 0.5, specular: float = 0.1,
              roughness: float = 0.25) -> dict[str, Any]:
    """Scratch plate: scratches of half, once and twice the depth in four directions each.

    :param depth: of the middle row, m.
    :param width: half width of all grooves, m.
    """
    z = np.zeros_like(x)
    for row, relative in enumerate((0.5, 1.0, 2.0)):
        for column in range(4):
            z += scratch(x - (column - 1.5) * 0.011, y - (1 - row) * 0.012,
                         column * math.pi / 4, 0.009, width, relative * depth)
    return {'height': z, 'albedo': albedo, 'specular': specular, 'roughness': roughness}


def weld(x: NDArray, y: NDArray, height: float = 0.0012, width: float = 0.008,
         undercut: float = 8e-5, seed: int = 11, specular: float = 0.15,
         roughness: float = 0.3) -> dict[str, Any]:
    """Weld bead along x with its ripples, undercut toes, heat tint and a few spatters.

    :param undercut: depth of the notches at the toes, m.
    """
    random = np.random.default_rng(seed)
    wander = random_texture((1, x.shape[1]), _pitch(x), (4e-3, 4e-3), random)
    half = width / 2 * (1 + 0.03 * wander)
    across = (y - 1.5e-4 * wander[:, ::-1]) / half
    crown = np.maximum(1 - across ** 2, 0)
    # the melt freezes in crescents that open against the direction of travel
    turns = x / 1.1e-3 + 1.6 * across ** 2 + 0.15 * wander
    z = height * crown * (1 + 0.03 * np.cos(2 * math.pi * turns))
    toes = np.exp(-((np.abs(across) - 1.07) / 0.07) ** 2)
    z -= undercut * toes
    for _ in range(8):
        side = random.choice((-1, 1))
        cx, cy = random.uniform(-0.022, 0.022), side * random.uniform(0.007, 0.017)
        radius = random.uniform(2.5e-4, 6e-4)
        z += 0.5 * radius * np.maximum(1 - ((x - cx) ** 2 + (y - cy) ** 2) / radius ** 2, 0) ** 2
    tint = 0.22 * np.exp(-((np.abs(across) - 1.5) / 0.35) ** 2)
    albedo = 0.45 - tint + 0.06 * smoothstep(1.0, 0.9, np.abs(across))
    return {'height': z, 'albedo': albedo, 'specular': specular, 'roughness': roughness}


def orange_peel(x: NDArray, y: NDArray, amplitude: float = 1.5e-6, wavelength: float = 2.5e-3,
                seed: int = 13, albedo: float = 0.35, specular: float = 0.05,
                roughness: float = 0.12) -> dict[str, Any]:
    """Glossy paint that has not levelled out: waves of about one length in all directions.

    :param amplitude: RMS of the waves, m.
    """
    # the difference of two smoothings keeps a band of wavelengths
    shape, pitch = _shape(x), _pitch(x)
    bands = [random_texture(shape, pitch, (length, length), np.random.default_rng(seed))
             for length in (0.35 * wavelength, 0.5 * wavelength)]
    z = bands[0] - bands[1]
    return {'height': z * (amplitude / z.std()), 'albedo': albedo, 'specular': specular,
            'roughness': roughness}


def copper(x: NDArray, y: NDArray, thickness: float = 0.003, blister: float = 2e-5,
           seed: int = 17, specular: float = 0.06, roughness: float = 0.12) -> dict[str, Any]:
    """Laminated copper plate (paper, Fig. 4): rolled, stained copper under a glossy film.

    The film is not quite flat: it follows the rolling and has blisters. The plate ends inside the
    field of view on the right.

    :param thickness: of the plate above the table, m.
    :param blister: height of the film's blisters, m.
    """
    random = np.random.default_rng(seed)
    shape, pitch = _shape(x), _pitch(x)
    streaks = random_texture(shape, pitch, (1.2e-2, 1.8e-4), random)
    stains = random_texture(shape, pitch, (3e-3, 3e-3), random)
    z = 6e-7 * streaks + 1.2e-6 * random_texture(shape, pitch, (1.5e-3, 1.5e-3), random)
    for _ in range(14):
        cx, cy = random.uniform(-0.023, 0.015), random.uniform(-0.018, 0.018)
        radius = random.uniform(6e-4, 1.8e-3)
        z += blister * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (radius / 2) ** 2)
    on_plate = smoothstep(0.0205, 0.0200, x)
    albedo = 0.38 * (1 + 0.12 * streaks) - 0.10 * smoothstep(0.4, 1.2, stains)
    return {'height': z * on_plate - thickness * (1 - on_plate),
            'albedo': np.clip(albedo, 0.05, 0.9) * on_plate + 0.15 * (1 - on_plate),
            'specular': specular, 'roughness': roughness}


def _pitch(x: NDArray) -> float:
    return float(x[0, 1] - x[0, 0])


def _shape(x: NDArray) -> tuple[int, int]:
    return x.shape[0], x.shape[1]
