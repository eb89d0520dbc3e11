"""Figures of the calibration report, as SVG that reads on white and on black paper."""
from collections.abc import Callable
from functools import wraps
import io
import math
from typing import Any, TypeVar

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray

from ps_calibration.before_after import Comparison
from ps_calibration.ring_height import HeightMap, WallHeight
from ps_calibration.ring_target import RingTarget
from ps_calibration.shadow_maps import EdgeProfile, ShadowMaps
from ps_head_driver.head_model import CameraGeometry

_INK = '#7d8893'
_FIT, _DATA, _TRUE = '#e5762f', '#2f7fb8', '#3a9d6a'
_STYLE: dict[Any, Any] = {'text.color': _INK, 'axes.edgecolor': _INK, 'axes.labelcolor': _INK,
          'xtick.color': _INK, 'ytick.color': _INK, 'font.size': 9.0, 'svg.hashsalt': 'ps_head'}


Drawing = TypeVar('Drawing', bound=Callable[..., bytes])


def _styled(draw: Drawing) -> Drawing:
    """Colours and sizes of this module for everything that the function draws."""
    @wraps(draw)
    def within(*arguments: Any) -> bytes:
        with rc_context(_STYLE):
            return draw(*arguments)
    return within       # type: ignore[return-value]


@_styled
def shadow(panel: int, maps: ShadowMaps, profile: EdgeProfile) -> bytes:
    """One panel's shadow with the fitted edges, and the light along a line across it."""
    figure, (above, below) = _axes(2, (4.2, 5.0), height_ratios=(2.1, 1))
    extent = 1e3 * np.array([maps.x[0], maps.x[-1], maps.y[0], maps.y[-1]])
    above.set_facecolor('#8a7f70')      # where the wall stands
    above.imshow(maps.measured[panel], cmap='gray', vmin=0, vmax=1.05, origin='lower',
                 extent=tuple(extent), interpolation='nearest')
    for level, style in ((0.1, ':'), (0.5, '-'), (0.9, ':')):
        above.contour(1e3 * maps.x, 1e3 * maps.y, maps.fitted[panel], [level], colors=_FIT,
                      linestyles=style, linewidths=1.2 if level == 0.5 else 0.9)
    above.plot(*(1e3 * profile.ends.T), color=_DATA, lw=1.2)
    above.set(xlabel='x, mm', ylabel='y, mm', aspect='equal', xlim=extent[:2], ylim=extent[2:])
    below.plot(1e3 * profile.distance, profile.measured, color=_DATA, lw=1.6, label='measured')
    below.plot(1e3 * profile.distance, profile.fitted, color=_FIT, lw=1.1, label='fitted')
    below.set(xlabel='along the blue line, away from the light, mm', ylabel='panel seen',
              ylim=(-0.08, 1.15))
    below.legend(frameon=False, loc='lower right')
    return _svg(figure)


@_styled
def grazing_shadow(points: NDArray, measured: NDArray, x: NDArray, y: NDArray,
                   fitted: NDArray) -> bytes:
    """How much of a dark-field panel is seen from the plate, with the fitted edges.

    :param points: (N, 2) where it was measured, target frame, m.
    :param measured: (N,) 1 is all of it; NaN is left out.
    :param x, y: (w,), (h,) of the fit's grid, m.
    :param fitted: (h, w).
    """
    figure, (ax,) = _axes(1, (4.2, 3.8))
    ax.set_facecolor('#8a7f70')
    known = np.isfinite(measured)
    shown = 1e3 * points[known]
    ax.scatter(shown[:, 0], shown[:, 1], c=measured[known], s=24.0, cmap='gray', vmin=0, vmax=1.05,
               linewidths=0, marker='s', rasterized=True)
    for level, style in ((0.1, ':'), (0.5, '-'), (0.9, ':')):
        ax.contour(1e3 * x, 1e3 * y, fitted, [level], colors=_FIT, linestyles=style,
                   linewidths=1.2 if level == 0.5 else 0.9)
    ax.set(xlabel='x, mm', ylabel='y, mm', aspect='equal',
           xlim=1e3 * x[[0, -1]], ylim=1e3 * y[[0, -1]])
    return _svg(figure)


@_styled
def residuals(pixels: NDArray, residual: NDArray, camera: CameraGeometry,
              most: float = 5.0) -> bytes:
    """Measured minus fitted share of one panel at (N, 2) pixels, up to ``most`` thousandths."""
    figure, (ax,) = _axes(1, (3.0, 2.5))
    shown = ax.scatter(pixels[:, 0], pixels[:, 1], c=1e3 * residual, s=2.0, cmap='RdBu_r',
                       vmin=-most, vmax=most, linewidths=0, rasterized=True)
    ax.set_facecolor('#80808030')
    ax.set(xlim=(0, camera.width_px), ylim=(camera.height_px, 0), aspect='equal',
           xticks=[], yticks=[])
    bar = figure.colorbar(shown, ax=ax, location='bottom', shrink=0.8, extend='both')
    bar.set_label('measured - fitted, 1/1000 of the light')
    bar.outline.set_edgecolor(_INK)     # type: ignore[operator]
    return _svg(figure)


@_styled
def wall(heights: WallHeight, target: RingTarget) -> bytes:
    """Height of the wall along its arc against the known one."""
    figure, (ax,) = _axes(1, (5.6, 3.2))
    ax.axhline(1e3 * target.height, color=_TRUE, lw=1.4, label='target file')
    ax.errorbar(np.degrees(heights.azimuth), 1e3 * heights.height, 2e3 * heights.deviation,
                fmt='o', ms=4, color=_DATA, capsize=2, lw=1, label='from its shadows')
    for slit in target.slits.azimuths:
        ax.axvline(math.degrees(slit), color=_INK, lw=0.6, ls=':')
    reach = max(0.1, 1.2e3 * float(np.nanmax(abs(heights.height - target.height))))
    ax.set(xlabel='azimuth, degrees (dotted: slits)', ylabel='height, mm',
           ylim=(1e3 * target.height - reach, 1e3 * target.height + reach))
    ax.legend(frameon=False, ncols=2, loc='lower center')
    return _svg(figure)


@_styled
def ring_height(made: HeightMap) -> bytes:
    """Reconstructed height of the ring, normalised by the known height."""
    return _map(made.height, -0.1, 1.0, 'height / known height of the wall', 'cividis')


@_styled
def part_height(height: NDArray, low: float, high: float) -> bytes:
    """Height map of a part, limits in m."""
    return _map(1e6 * height, 1e6 * low, 1e6 * high, 'height, µm', 'cividis')


@_styled
def cross_section(part: Comparison) -> bytes:
    """Heights along the middle row, before, after and true."""
    figure, (ax,) = _axes(1, (5.6, 3.2))
    rows, columns = part.before['ls'].height.shape
    x = 1e3 * part.pitch * (np.arange(columns) - (columns - 1) / 2)
    lines: list[tuple[NDArray | None, str, str, float]] = [
        (part.truth, 'true', _TRUE, 3.0), (part.before['ls'].height, 'before', _INK, 1.2),
        (part.after['ls'].height, 'after', _FIT, 1.4),
        (part.after['stv'].height, 'after, STV', _DATA, 1.2)]
    for height, name, colour, width in lines:
        if height is not None:
            along = np.asarray(height[rows // 2], float)
            ax.plot(x, 1e6 * (along - np.nanmedian(along)), color=colour, lw=width, label=name)
    ax.set(xlabel='along the middle row, mm', ylabel='height, µm')
    ax.legend(frameon=False, ncols=4, loc='lower center', bbox_to_anchor=(0.5, 1.0))
    return _svg(figure)


def _map(values: NDArray, low: float, high: float, label: str, colours: str) -> bytes:
    figure, (ax,) = _axes(1, (4.6, 3.4))
    step = max(1, values.shape[1] // 700)
    shown = ax.imshow(values[::step, ::step], cmap=colours, vmin=low, vmax=high,
                      interpolation='nearest')
    ax.set_axis_off()
    bar = figure.colorbar(shown, ax=ax, shrink=0.8, extend='both')
    bar.set_label(label)
    bar.outline.set_edgecolor(_INK)     # type: ignore[operator]
    return _svg(figure)


def _axes(rows: int, size: tuple[float, float], **grid: Any) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=size, layout='constrained', facecolor='none')
    axes = list(figure.subplots(rows, 1, squeeze=False, gridspec_kw=grid)[:, 0])
    for ax in axes:
        ax.set_facecolor('none')
        ax.spines[['top', 'right']].set_visible(False)
    return figure, axes


def _svg(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format='svg', dpi=200, metadata={'Date': None})
    return buffer.getvalue()
