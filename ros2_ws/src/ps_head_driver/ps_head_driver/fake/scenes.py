"""What can lie under the fake head: surfaces with known height and reflectance.

The plane z = 0 of ps_head_plane is where a part's upper face should be. Every scene is a grid of
control heights of a cubic B-spline (see shading.py), which is its exact surface.
"""
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
import inspect
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.fake import shading
from ps_head_driver.fake.disc import machined_disc

SIZE = (0.064, 0.054)        # m; the nominal field of view is 50 x 40 mm
PITCH = 5e-5                 # m; a pixel of the nominal camera sees 39 um
_MARGIN = 1e-6


@dataclass(frozen=True)
class Scene:
    """A surface under the head.

    :param name: for messages.
    :param origin: x and y of the first grid point, m.
    :param pitch: distance of grid points, m.
    :param height: (ny, nx) float64 control heights, m; rows go along +y.
    :param albedo: (ny, nx) float32 diffuse reflectance at the grid points.
    :param specular: reflectance of the gloss at normal incidence; 0 is matt.
    :param roughness: GGX roughness of the gloss.
    """

    name: str
    origin: tuple[float, float]
    pitch: float
    height: NDArray
    albedo: NDArray
    specular: float = 0.0
    roughness: float = 0.3

    @cached_property
    def height_range(self) -> tuple[float, float]:
        """Heights below and above the whole surface, m."""
        # a B-spline stays within its control heights
        return float(self.height.min()) - _MARGIN, float(self.height.max()) + _MARGIN

    def surface(self, x: NDArray, y: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        """Height and slopes at points of ps_head_plane.

        :param x: any shape, m.
        :param y: same shape, m.
        :returns: z (m), dz/dx, dz/dy, same shape, float64.
        """
        x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
        z, p, q = shading.evaluate(
            self.height, *self.origin, self.pitch, x.ravel(), y.ravel()).reshape(3, *x.shape)
        return z, p, q

    def require_covers(self, rays: tuple[NDArray, NDArray], standoff: float) -> None:
        """Make sure that the camera does not look past the scene.

        :param rays: x and y of all pixels' directions, scaled to z = -1.
        :raises PsError: SEQUENCER_BAD_REQUEST.
        """
        reach = standoff - self.height_range[0]
        ny, nx = self.height.shape
        for rays_along, first, count in ((rays[0], self.origin[0], nx),
                                         (rays[1], self.origin[1], ny)):
            # the outermost two cells lack control points for an exact spline
            low, high = first + self.pitch, first + (count - 2) * self.pitch
            if rays_along.min() * reach < low or rays_along.max() * reach > high:
                raise PsError(ErrorCode.SEQUENCER_BAD_REQUEST,
                              f'scene {self.name} is {(nx - 1) * self.pitch * 1e3:.0f} x '
                              f'{(ny - 1) * self.pitch * 1e3:.0f} mm, smaller than the field of '
                              'view; give it a larger size')


def _plate(x: NDArray, y: NDArray, albedo: float = 0.8, specular: float = 0.0,
           roughness: float = 0.3) -> dict[str, Any]:
    """Flat plate in the plane z = 0, matt unless specular is given."""
    return {'height': np.zeros_like(x), 'albedo': albedo, 'specular': specular,
            'roughness': roughness}


def _tilted_plate(x: NDArray, y: NDArray, tilt_x: float = math.radians(5.0),
                  tilt_y: float = math.radians(-3.0), albedo: float = 0.8) -> dict[str, Any]:
    """Flat matt plate that rises by tilt_x (rad) along +x and tilt_y along +y."""
    return {'height': math.tan(tilt_x) * x + math.tan(tilt_y) * y, 'albedo': albedo}


def _dome(x: NDArray, y: NDArray, radius: float = 0.015, height: float = 0.003,
          albedo: float = 0.8) -> dict[str, Any]:
    """Spherical cap (m) on a plate in the plane z = 0."""
    sphere = (radius ** 2 + height ** 2) / (2 * height)
    z = np.sqrt(np.maximum(sphere ** 2 - x ** 2 - y ** 2, 0)) - (sphere - height)
    return {'height': np.maximum(z, 0), 'albedo': albedo}


_MAKERS: dict[str, Callable[..., dict[str, Any]]] = {
    'plate': _plate, 'tilted_plate': _tilted_plate, 'dome': _dome, 'disc': machined_disc}

SCENES = tuple(_MAKERS)


def make_scene(name: str, size: tuple[float, float] = SIZE, pitch: float = PITCH,
               **parameters: Any) -> Scene:
    """Build a scene by name.

    :param name: one of SCENES.
    :param size: along x and y, centred on the optical axis, m.
    :param pitch: of the grid, m.
    :param parameters: of the scene; see the functions of this module.
    :raises PsError: SEQUENCER_BAD_REQUEST for an unknown name or parameter; names those there are.
    """
    if name not in _MAKERS:
        raise PsError(ErrorCode.SEQUENCER_BAD_REQUEST,
                      f'there is no scene {name!r}; there are {", ".join(SCENES)}')
    maker = _MAKERS[name]
    known = list(inspect.signature(maker).parameters)[2:]
    for parameter in parameters:
        if parameter not in known:
            raise PsError(ErrorCode.SEQUENCER_BAD_REQUEST,
                          f'scene {name} has no parameter {parameter!r}; it has '
                          + ', '.join(known))
    half_x, half_y = (math.ceil(side / 2 / pitch) for side in size)
    x, y = np.meshgrid(np.arange(-half_x, half_x + 1) * pitch,
                       np.arange(-half_y, half_y + 1) * pitch)
    made = maker(x, y, **parameters)
    made['height'] = np.ascontiguousarray(made['height'], np.float64)
    made['albedo'] = np.ascontiguousarray(np.broadcast_to(made['albedo'], x.shape), np.float32)
    return Scene(name=name, origin=(-half_x * pitch, -half_y * pitch), pitch=pitch, **made)
