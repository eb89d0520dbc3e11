"""What can lie under the fake head: surfaces with known height and reflectance.

The plane z = 0 of ps_head_plane is where a part's upper face should be. Every scene is a grid of
control heights of a cubic B-spline (see spline_surface.py), which is its exact surface.
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
from ps_head_driver.fake import finishes, shapes
from ps_head_driver.fake.disc import machined_disc
from ps_head_driver.fake.spline_surface import evaluate

SIZE = (0.064, 0.054)        # m; the nominal field of view is 50 x 40 mm
PITCH = 5e-5                 # m; a pixel of the nominal camera sees 39 um
NARROWEST_GLOSS = 0.1        # GGX roughness; emitters are 0.02 rad of half-vector apart
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

    def __post_init__(self) -> None:
        if not np.isfinite(self.height).all():
            raise ValueError('its heights are not finite')
        if not 0 <= self.albedo.min() <= self.albedo.max() <= 1 or not 0 <= self.specular <= 1:
            raise ValueError('albedo and specular must be 0 to 1')
        if not NARROWEST_GLOSS <= self.roughness <= 1:
            raise ValueError(f'the gloss must have a roughness of {NARROWEST_GLOSS} to 1: in a '
                             'narrower one the single emitters would be seen')

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
        z, p, q = evaluate(
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


_MAKERS: dict[str, Callable[..., dict[str, Any]]] = {
    'plate': shapes.plate, 'glossy_plate': shapes.glossy_plate,
    'tilted_plate': shapes.tilted_plate, 'dome': shapes.dome, 'boss': shapes.boss,
    'disc': machined_disc, 'roughness': finishes.roughness, 'scratches': finishes.scratches,
    'weld': finishes.weld, 'orange_peel': finishes.orange_peel, 'copper': finishes.copper}

#: All that the fake camera can show; the last is the calibration target, see ring_renderer.py.
SCENES = (*_MAKERS, 'ring')


def make_scene(name: str, size: tuple[float, float] = SIZE, pitch: float = PITCH,
               **parameters: Any) -> Scene:
    """Build a scene by name.

    :param name: one of SCENES, except ring.
    :param size: along x and y, centred on the optical axis, m.
    :param pitch: of the grid, m.
    :param parameters: of the scene; see shapes.py, finishes.py and disc.py.
    :raises PsError: SEQUENCER_BAD_REQUEST for an unknown name or a parameter that is unknown or
        out of range; names those there are.
    """
    if name not in _MAKERS:
        raise PsError(ErrorCode.SEQUENCER_BAD_REQUEST,
                      f'there is no scene {name!r}; there are {", ".join(SCENES)}')
    maker = _MAKERS[name]
    arguments = checked_arguments(name, maker, parameters, given=2)
    half_x, half_y = (math.ceil(side / 2 / pitch) for side in size)
    x, y = np.meshgrid(np.arange(-half_x, half_x + 1) * pitch,
                       np.arange(-half_y, half_y + 1) * pitch)
    try:
        made = maker(x, y, **arguments)
        made['height'] = np.ascontiguousarray(made['height'], np.float64)
        made['albedo'] = np.ascontiguousarray(np.broadcast_to(made['albedo'], x.shape),
                                              np.float32)
        return Scene(name=name, origin=(-half_x * pitch, -half_y * pitch), pitch=pitch, **made)
    except (ValueError, ArithmeticError) as error:
        raise PsError(ErrorCode.SEQUENCER_BAD_REQUEST, f'scene {name}: {error}') from error


def parse_scene(text: str) -> tuple[str, dict[str, str]]:
    """Name and arguments of a scene written as ``boss:height=0.002,albedo=0.5``.

    :raises PsError: SEQUENCER_BAD_REQUEST.
    """
    name, _, rest = text.partition(':')
    arguments = {}
    for part in filter(None, (part.strip() for part in rest.split(','))):
        key, equals, value = (piece.strip() for piece in part.partition('='))
        if not (key and equals and value):
            raise PsError(ErrorCode.SEQUENCER_BAD_REQUEST,
                          f'scene {text!r}: {part!r} is not of the form name=value')
        arguments[key] = value
    return name.strip(), arguments


def checked_arguments(scene: str, maker: Callable[..., Any], parameters: dict[str, Any],
                      given: int) -> dict[str, Any]:
    """Arguments for a maker, converted to the types of its defaults.

    :param given: how many of the maker's parameters are not the user's.
    :raises PsError: SEQUENCER_BAD_REQUEST naming the argument and those there are.
    """
    known = dict(list(inspect.signature(maker).parameters.items())[given:])
    checked = {}
    for name, value in parameters.items():
        if name not in known:
            raise PsError(ErrorCode.SEQUENCER_BAD_REQUEST,
                          f'scene {scene} has no parameter {name!r}; it has ' + ', '.join(known))
        kind = type(known[name].default)
        try:
            checked[name] = kind(value)
            if kind is float and not math.isfinite(checked[name]):
                raise ValueError
        except (TypeError, ValueError):
            raise PsError(ErrorCode.SEQUENCER_BAD_REQUEST,
                          f'scene {scene}: {name}={value} is not a {kind.__name__}') from None
    return checked
