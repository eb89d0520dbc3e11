"""Plain bodies with a formula for their height: boards, domes, bosses. Metres, radians.

Every maker gets the grid and returns height and albedo, and gloss where there is some.
"""
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray


def plate(x: NDArray, y: NDArray, albedo: float = 0.8, specular: float = 0.0,
          roughness: float = 0.3) -> dict[str, Any]:
    """Flat board in the plane z = 0, matt unless specular is given."""
    return {'height': np.zeros_like(x), 'albedo': albedo, 'specular': specular,
            'roughness': roughness}


def glossy_plate(x: NDArray, y: NDArray, albedo: float = 0.5, specular: float = 0.05,
                 roughness: float = 0.2) -> dict[str, Any]:
    """Flat board with the gloss of satin paint."""
    return plate(x, y, albedo, specular, roughness)


def tilted_plate(x: NDArray, y: NDArray, tilt_x: float = math.radians(5.0),
                 tilt_y: float = math.radians(-3.0), albedo: float = 0.8) -> dict[str, Any]:
    """Flat matt board that rises by tilt_x (rad) along +x and tilt_y along +y."""
    return {'height': math.tan(tilt_x) * x + math.tan(tilt_y) * y, 'albedo': albedo}


def dome(x: NDArray, y: NDArray, radius: float = 0.015, height: float = 0.003,
         albedo: float = 0.8) -> dict[str, Any]:
    """Spherical cap on a board in the plane z = 0.

    :param radius: of the cap's foot, m.
    """
    sphere = (radius ** 2 + height ** 2) / (2 * height)
    z = np.sqrt(np.maximum(sphere ** 2 - x ** 2 - y ** 2, 0)) - (sphere - height)
    return {'height': np.maximum(z, 0), 'albedo': albedo}


def boss(x: NDArray, y: NDArray, height: float = 0.001, slope: float = math.radians(20.0),
         albedo: float = 0.8, specular: float = 0.0, roughness: float = 0.3) -> dict[str, Any]:
    """Smooth boss, a raised cosine, on a board in the plane z = 0.

    :param slope: the largest, rad; it fixes the boss's radius.
    """
    radius = math.pi * height / (2 * math.tan(slope))
    r = np.minimum(np.hypot(x, y) / radius, 1.0)
    return {'height': height / 2 * (1 + np.cos(math.pi * r)), 'albedo': albedo,
            'specular': specular, 'roughness': roughness}
