"""Pictures for people: normals, slopes, height in 3-D. All return RGB uint8 unless said."""
from functools import cache
from typing import Any

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

BACKGROUND = (255, 255, 255)


def normal_preview(normal: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Normals as colours, n_plane: red right, green up, blue towards the viewer; invalid black."""
    out = np.empty(normal.shape, np.uint8)
    _normal_rows(normal, out)
    return out


def slope_preview(slope: NDArray[np.float32], full_scale: float | None = None
                  ) -> NDArray[np.uint8]:
    """Slopes on a colour wheel: hue is the downhill direction, saturation the steepness.

    :param slope: (H, W, 2).
    :param full_scale: slope of full saturation; None takes the 98th percentile.
    """
    length = np.hypot(slope[..., 0], slope[..., 1])
    valid = np.isfinite(length)
    if full_scale is None:
        full_scale = float(np.percentile(length[valid][::7], 98)) if valid.any() else 1.0
    angle = np.degrees(np.arctan2(-slope[..., 1], -slope[..., 0])) % 360
    hsv = np.stack([angle, np.clip(length / max(full_scale, 1e-9), 0, 1),
                    np.ones_like(length)], axis=-1).astype(np.float32)
    hsv[~valid] = 0
    return np.asarray(np.rint(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB) * 255).astype(np.uint8))


def grey16(values: NDArray, low: float, high: float) -> NDArray[np.uint16]:
    """Linear grey from 1 (low) to 65535 (high) for a 16-bit PNG; invalid is 0."""
    span = max(high - low, 1e-30)
    scaled = 1 + np.clip((values - low) / span, 0, 1) * 65534
    return np.where(np.isfinite(values), np.rint(scaled), 0).astype(np.uint16)


def normal16(normal: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Normals as 16-bit RGB: (n + 1) / 2 * 65535, n_plane; invalid is black."""
    scaled = np.rint((normal + 1) * 32767.5)
    return np.where(np.isfinite(normal), scaled, 0).astype(np.uint16)


def height_view(
    height: NDArray[np.float32], pitch: float, size: tuple[int, int] = (1200, 800),
    azimuth_deg: float = -35.0, elevation_deg: float = 40.0, exaggeration: float | None = None,
    metric: bool = True, title: str = '',
) -> NDArray[np.uint8]:
    """Shaded 3-D view of a height map with a scale bar and a colour bar.

    :param height: (H, W) metres, NaN where unknown.
    :param pitch: pixel distance, m.
    :param size: width and height of the picture in pixels.
    :param exaggeration: of the heights; None chooses a round number that shows the relief.
    :param metric: False where the scale is unknown: no units are printed.
    """
    field, step = reduced(height, 700)
    valid = np.isfinite(field)
    if not valid.any():
        return np.full((size[1], size[0], 3), 255, np.uint8)
    low, high = (float(v) for v in np.percentile(field[valid], [0.5, 99.5]))
    field = np.clip(field, low - 0.2 * (high - low), high + 0.2 * (high - low))
    if exaggeration is None:
        exaggeration = _round_down(0.12 * max(field.shape) * step * pitch / max(high - low, 1e-12))
    oversampling = 2
    canvas = (size[0] * oversampling, int(size[1] * 0.86) * oversampling)
    picture, scale = _render(field, valid, step * pitch, exaggeration, low, high, canvas,
                             np.radians(azimuth_deg), np.radians(elevation_deg))
    picture = np.asarray(cv2.resize(
        picture, None, fx=1 / oversampling, fy=1 / oversampling,
                         interpolation=cv2.INTER_AREA), np.uint8)
    return _annotate(picture, size, scale / oversampling, low, high, exaggeration, metric, title)


def reduced(height: NDArray, most: int) -> tuple[NDArray[np.float64], int]:
    """Mean over blocks so that the longer side has at most ``most`` cells."""
    step = max(1, -(-max(height.shape) // most))
    rows, columns = (n // step * step for n in height.shape)
    blocks = height[:rows, :columns].reshape(rows // step, step, columns // step, step)
    known = np.isfinite(blocks)
    total = np.where(known, blocks, 0).sum(axis=(1, 3), dtype=np.float64)
    count = known.sum(axis=(1, 3))
    return np.where(count * 2 > step * step, total / np.maximum(count, 1), np.nan), step


def _round_down(value: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that does not exceed ``value``; at least 1."""
    if value <= 1:
        return 1.0
    power = 10 ** np.floor(np.log10(value))
    return float(max(m for m in (1, 2, 5) if m * power <= value * (1 + 1e-9)) * power)


@cache
def _colour_map() -> NDArray[np.float64]:
    from matplotlib import colormaps
    return np.asarray(colormaps['cividis'](np.linspace(0, 1, 256))[:, :3])


def _render(field: NDArray, valid: NDArray, cell: float, exaggeration: float, low: float,
            high: float, canvas: tuple[int, int], azimuth: float, elevation: float,
            ) -> tuple[NDArray[np.uint8], float]:
    """Parallel view of the relief as a solid block; returns the picture and pixels per metre."""
    rows, columns = field.shape
    y, x = np.indices(field.shape)
    # a solid: unknown cells and the rim drop to the base
    base = low - 0.05 * max(rows, columns) * cell / exaggeration
    z = np.where(valid, field, base) - 0.5 * (low + high)
    world = np.stack([(x - columns / 2) * cell, (rows / 2 - y) * cell, z * exaggeration], axis=-1)
    gradient_y, gradient_x = np.gradient(np.where(valid, field, low), cell)
    facing = np.stack([-gradient_x * exaggeration, gradient_y * exaggeration,
                       np.ones_like(z)], axis=-1)
    facing /= np.linalg.norm(facing, axis=-1, keepdims=True)
    light = np.array([-0.45, 0.5, 0.74])
    half = light / np.linalg.norm(light) + np.array([0, 0, 1.0])
    half /= np.linalg.norm(half)
    diffuse = np.clip(facing @ (light / np.linalg.norm(light)), 0, 1)
    gloss = np.clip(facing @ half, 0, 1) ** 40
    index = np.clip((field - low) / max(high - low, 1e-12) * 255, 0, 255)
    colour = _colour_map()[np.where(valid, index, 0).astype(int)]
    colour = np.clip(colour * (0.25 + 0.85 * diffuse[..., None]) + 0.12 * gloss[..., None], 0, 1)
    turn, tip = (np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
                 for a in (azimuth, elevation))
    flat = world[..., :2] @ turn.T
    screen_x = flat[..., 0]
    screen_y = flat[..., 1] * tip[1, 0] + world[..., 2] * tip[0, 0]
    depth = flat[..., 1] * tip[0, 0] - world[..., 2] * tip[1, 0]
    bottom = flat[..., 1] * tip[1, 0] + (base - 0.5 * (low + high)) * exaggeration * tip[0, 0]
    seen_x, seen_y, floor = screen_x[valid], screen_y[valid], bottom[valid]
    spans = [np.ptp(seen_x), max(seen_y.max(), floor.max()) - min(seen_y.min(), floor.min())]
    scale = 0.92 * min(canvas[0] / spans[0], canvas[1] / spans[1])
    px = (screen_x - 0.5 * (seen_x.max() + seen_x.min())) * scale + canvas[0] / 2
    middle = 0.5 * (max(seen_y.max(), floor.max()) + min(seen_y.min(), floor.min()))
    py = canvas[1] / 2 - (screen_y - middle) * scale
    py_base = canvas[1] / 2 - (bottom - middle) * scale
    picture = np.full((canvas[1], canvas[0], 3), 255, np.uint8)
    nearness = np.full((canvas[1], canvas[0]), np.inf)
    _draw(px, py, py_base, depth, valid, (colour * 255), picture, nearness)
    return picture, float(scale)


def _annotate(picture: NDArray, size: tuple[int, int], scale: float, low: float, high: float,
              exaggeration: float, metric: bool, title: str) -> NDArray[np.uint8]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure
    width, height = size
    figure = Figure(figsize=(width / 100, height / 100), dpi=100, facecolor='white')
    canvas = FigureCanvasAgg(figure)
    axes: Any = figure.add_axes((0, 0.14, 1, 0.86))
    axes.imshow(picture)
    axes.axis('off')
    if title:
        figure.text(0.02, 0.955, title, fontsize=14, weight='bold')
    unit, factor = ('mm', 1e3) if high - low > 2e-3 else ('µm', 1e6)
    if not metric:
        unit, factor = 'relative', 1 / max(high - low, 1e-30)
    bar = _round_down(0.2 * width / scale * 1e6) / 1e6
    line = figure.add_axes((0.04, 0.05, bar * scale / width, 0.012))
    line.set_facecolor('black')
    line.set_xticks([])
    line.set_yticks([])
    length = f'{bar * 1e3:g} mm' if metric else ''
    figure.text(0.04, 0.078, length, fontsize=12)
    figure.text(0.04, 0.015, f'heights x {exaggeration:g}' if metric else 'scale unknown',
                fontsize=10, color='0.35')
    colours = figure.add_axes((0.55, 0.075, 0.4, 0.022))
    figure.colorbar(
        ScalarMappable(Normalize(low * factor, high * factor), 'cividis'), cax=colours,
        orientation='horizontal')
    colours.set_title(f'height [{unit}]', fontsize=11, pad=4)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


@numba.njit(cache=True, error_model='numpy')
def _triangle(ax, ay, az, bx, by, bz, cx, cy, cz, r, g, b, picture, nearness):    # type: ignore[no-untyped-def]
    height, width = nearness.shape
    area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    if area == 0 or not np.isfinite(area):
        return
    left, right = max(int(min(ax, bx, cx)), 0), min(int(max(ax, bx, cx)) + 1, width - 1)
    top, bottom = max(int(min(ay, by, cy)), 0), min(int(max(ay, by, cy)) + 1, height - 1)
    for y in range(top, bottom + 1):
        for x in range(left, right + 1):
            u = ((x - ax) * (cy - ay) - (cx - ax) * (y - ay)) / area
            v = ((bx - ax) * (y - ay) - (x - ax) * (by - ay)) / area
            if u < -1e-6 or v < -1e-6 or u + v > 1 + 1e-6:
                continue
            depth = az + u * (bz - az) + v * (cz - az)
            if depth < nearness[y, x]:
                nearness[y, x] = depth
                picture[y, x, 0], picture[y, x, 1], picture[y, x, 2] = r, g, b


@numba.njit(cache=True, error_model='numpy')
def _draw(px, py, base, depth, valid, colour, picture, nearness):    # type: ignore[no-untyped-def]
    rows, columns = px.shape
    for y in range(rows - 1):
        for x in range(columns - 1):
            if not (valid[y, x] and valid[y, x + 1] and valid[y + 1, x] and valid[y + 1, x + 1]):
                continue
            r, g, b = colour[y, x, 0], colour[y, x, 1], colour[y, x, 2]
            _triangle(px[y, x], py[y, x], depth[y, x],
                      px[y, x + 1], py[y, x + 1], depth[y, x + 1],
                      px[y + 1, x], py[y + 1, x], depth[y + 1, x], r, g, b, picture, nearness)
            _triangle(px[y + 1, x + 1], py[y + 1, x + 1], depth[y + 1, x + 1],
                      px[y, x + 1], py[y, x + 1], depth[y, x + 1],
                      px[y + 1, x], py[y + 1, x], depth[y + 1, x], r, g, b, picture, nearness)
    # walls down to the base where the surface ends
    for y in range(rows):
        for x in range(columns):
            if not valid[y, x]:
                continue
            for dy, dx in ((0, 1), (1, 0)):
                v, u = y + dy, x + dx
                if v >= rows or u >= columns or not valid[v, u]:
                    continue
                # the link (y, x)-(v, u) is a rim if one of the cells beside it is missing
                one = (y > 0 and x < columns - 1 and valid[y - 1, x] and valid[y - 1, x + 1]
                       if dx else x > 0 and y < rows - 1 and valid[y, x - 1]
                       and valid[y + 1, x - 1])
                two = (y < rows - 1 and x < columns - 1 and valid[y + 1, x] and valid[y + 1, x + 1]
                       if dx else x < columns - 1 and y < rows - 1 and valid[y, x + 1]
                       and valid[y + 1, x + 1])
                if one and two:
                    continue
                grey = 140.0
                _triangle(px[y, x], py[y, x], depth[y, x], px[v, u], py[v, u], depth[v, u],
                          px[y, x], base[y, x], depth[y, x], grey, grey, grey, picture, nearness)
                _triangle(px[v, u], base[v, u], depth[v, u], px[v, u], py[v, u], depth[v, u],
                          px[y, x], base[y, x], depth[y, x], grey, grey, grey, picture, nearness)


@numba.njit(cache=True, nogil=True)
def _normal_rows(normal, out):    # type: ignore[no-untyped-def]
    rows, width = normal.shape[:2]
    for y in range(rows):
        for x in range(width):
            for a in range(3):
                value = (normal[y, x, a] + np.float32(1)) * np.float32(127.5) + np.float32(0.5)
                out[y, x, a] = 0 if np.isnan(value) else np.uint8(value)
