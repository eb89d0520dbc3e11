"""Light vectors of near panels: the s of I = albedo * s . n (paper, Eq. 5), for every surface
point.

For a Lambertian polygon the irradiance is exactly linear in the normal while the whole panel is
above the local horizon (Lambert's formula); a narrower lobe is summed over a grid of sub-emitters.
"""
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ps_head_driver.camera_model import pixel_grid, plane_points
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.head_model import CameraGeometry
from ps_head_driver.stack import Light, Plane

# sub-emitters along width and height of a panel whose lobe is not Lambertian
SUB_EMITTERS = (12, 6)
# on 1280 pixels: 0.004 degrees and 7e-5 for the nominal dark field, a tenth for the bright field
DEFAULT_STEP_PX = 16.0


def light_vectors(light: Light, points: ArrayLike) -> NDArray:
    """Vector irradiance of one light: direction towards it, length the irradiance it gives.

    :param light: near or distant; its intensity is included (the mean, if given per channel).
    :param points: (..., 3), ps_head_plane, m.
    :returns: (..., 3) float64; zero for points behind the panel. A distant light has unit
        irradiance times intensity; a near one that of a panel of radiance 1, times intensity.
    """
    points = np.asarray(points, np.float64)
    intensity = float(np.mean(light.intensity))
    if light.distant:
        towards = -intensity * np.asarray(light.axis, np.float64)
        return np.broadcast_to(towards, points.shape).copy()
    if light.size[0] <= 0 or light.size[1] <= 0:
        return intensity * _point_source(light, points, np.asarray(light.position, np.float64))
    if light.lobe_exponent == 1.0:
        return intensity * _lambert_polygon(light, points)
    return intensity * sum(  # type: ignore[return-value]
        _point_source(light, points, emitter) for emitter in _sub_emitters(light)
    ) / (SUB_EMITTERS[0] * SUB_EMITTERS[1]) * (light.size[0] * light.size[1])


def _frame(light: Light) -> tuple[NDArray, NDArray, NDArray]:
    axis, right = np.asarray(light.axis, np.float64), np.asarray(light.right, np.float64)
    return axis, right, np.cross(axis, right)


def _sub_emitters(light: Light) -> NDArray:
    _, right, up = _frame(light)
    across = (np.arange(SUB_EMITTERS[0]) + 0.5) / SUB_EMITTERS[0] - 0.5
    along = (np.arange(SUB_EMITTERS[1]) + 0.5) / SUB_EMITTERS[1] - 0.5
    a, b = np.meshgrid(across * light.size[0], along * light.size[1])
    return (np.asarray(light.position) + a[..., None] * right + b[..., None] * up).reshape(-1, 3)


def _point_source(light: Light, points: NDArray, emitter: NDArray) -> NDArray:
    """Unit-area source of radiance cos^(mu - 1): intensity cos^mu, over the squared distance."""
    to_light = emitter - points
    square = np.sum(to_light**2, axis=-1, keepdims=True)
    distance = np.sqrt(square)
    cosine = np.maximum(-(to_light @ np.asarray(light.axis, np.float64))[..., None] / distance, 0)
    return cosine**light.lobe_exponent * to_light / (distance * square)


def _lambert_polygon(light: Light, points: NDArray) -> NDArray:
    """Lambert's formula: s = 1/2 sum of theta_k unit(r_k x r_k+1) over the panel's edges."""
    axis, right, up = _frame(light)
    center = np.asarray(light.position, np.float64)
    half_width, half_height = light.size[0] / 2, light.size[1] / 2
    corners = [center + a * half_width * right + b * half_height * up
               for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))]
    # component by component: NumPy's cross and sum along an axis of three cost several times more
    columns = [np.array(points[..., i]) for i in range(3)]
    rays = [[corner[i] - columns[i] for i in range(3)] for corner in corners]
    total = np.zeros((3, *points.shape[:-1]))
    for (ax, ay, az), (bx, by, bz) in zip(rays, [*rays[1:], rays[0]], strict=True):
        cross = (ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx)
        length = np.sqrt(cross[0]**2 + cross[1]**2 + cross[2]**2)
        angle = np.arctan2(length, ax * bx + ay * by + az * bz)
        scale = np.divide(0.5 * angle, length, out=np.zeros_like(length), where=length > 0)
        for i in range(3):
            total[i] += scale * cross[i]
    to_center = [center[i] - columns[i] for i in range(3)]
    in_front = sum(axis[i] * to_center[i] for i in range(3)) < 0
    towards = sum(total[i] * to_center[i] for i in range(3))
    return np.moveaxis(np.where(in_front, np.sign(towards), 0.0) * total, 0, -1)


@dataclass(frozen=True)
class LightGrid:
    """Light vectors of all frames on a coarse grid of pixels, to be interpolated bilinearly.

    :param vectors: (gh, gw, T, 3) float64, ps_head_plane.
    :param rows: (gh,) float64, pixel rows of the nodes, evenly spaced from the first to the last.
    :param columns: (gw,) float64, likewise.
    """

    vectors: NDArray
    rows: NDArray
    columns: NDArray

    def at(self, rows: ArrayLike, columns: ArrayLike) -> NDArray:
        """Interpolated light vectors at pixels; rows and columns broadcast; (..., T, 3)."""
        def split(values: ArrayLike, nodes: NDArray) -> tuple[NDArray, NDArray]:
            position = (np.asarray(values, np.float64) - nodes[0]) / (nodes[1] - nodes[0])
            index = np.clip(position.astype(np.intp), 0, len(nodes) - 2)
            return index, (position - index)[..., None, None]
        i, a = split(rows, self.rows)
        j, b = split(columns, self.columns)
        v = self.vectors
        return ((1 - a) * ((1 - b) * v[i, j] + b * v[i, j + 1])
                + a * ((1 - b) * v[i + 1, j] + b * v[i + 1, j + 1]))

    def full(self, shape: tuple[int, int]) -> NDArray:
        """Light vectors of every pixel, (H, W, T, 3); large: for checks, not for kernels."""
        return self.at(np.arange(shape[0])[:, None], np.arange(shape[1])[None, :])


def light_grid(
    lights: Sequence[Light], camera: CameraGeometry | None, shape: tuple[int, int],
    plane: Plane = Plane(), height: NDArray | None = None,  # noqa: B008
    step_px: float = DEFAULT_STEP_PX,
) -> LightGrid:
    """Light vectors over the field of view.

    :param lights: one per frame.
    :param camera: None is allowed if all lights are distant.
    :param shape: (height, width) of the pictures.
    :param plane: on which the part lies.
    :param height: (H, W) float, m above the plane along z, sampled at the nodes; None: flat.
    :param step_px: largest spacing of the nodes.
    :raises PsError: RECONSTRUCTION_BAD_STACK for near lights without camera intrinsics.
    """
    rows, columns = pixel_grid(shape, step_px)
    if camera is None:
        if not all(light.distant for light in lights):
            raise PsError(ErrorCode.RECONSTRUCTION_BAD_STACK,
                          'camera_info: near lights need camera intrinsics (focal length is 0)')
        points = np.zeros((len(rows), len(columns), 3))
    else:
        pixels = np.stack(np.meshgrid(columns, rows), axis=-1)
        above = 0.0 if height is None else np.nan_to_num(
            height[np.ix_(rows.round().astype(int), columns.round().astype(int))])
        points = plane_points(camera, pixels, plane, above)
    vectors = np.stack([light_vectors(light, points) for light in lights], axis=2)
    return LightGrid(vectors, rows, columns)


def as_distant(light: Light, at: ArrayLike = (0.0, 0.0, 0.0)) -> Light:
    """The distant light that equals a near one at a single point: near field ignored."""
    vector = light_vectors(light, np.asarray(at, np.float64))
    length = float(np.linalg.norm(vector))
    if length == 0:
        raise PsError(ErrorCode.RECONSTRUCTION_BAD_STACK,
                      f'light {light.name or "?"}: the panel faces away from the plane')
    direction = -vector / length
    return replace(light, distant=True, intensity=length,
                   axis=(float(direction[0]), float(direction[1]), float(direction[2])))
