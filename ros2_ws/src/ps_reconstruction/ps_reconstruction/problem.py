"""The photometric problem: what every solver (least squares, robust) gets and gives back.

For pixel x and frame t the solvers explain the normalised intensity

    v_t(x) = reciprocal_flat_t(x) * sum_c w_c * min((raw_tc(x) - ambient_c(x)) * scale_tc, clip)

by v_t = g . s_t(x) with the scaled normal g = albedo * normal (paper, Eq. 5). The light vectors
s_t and the flat field are smooth, so both live on a coarse grid of nodes, one every ``step``
pixels, and are interpolated linearly between them.
"""
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

GREY_WEIGHTS = (0.2989, 0.587, 0.114)    # of R, G, B (ITU-R BT.601; as DiLiGenT evaluations use)

MAX_PATCH = 15                           # pixels, of the neighbourhoods of the robust solver

# Bits of the reason mask
SHADOW, HIGHLIGHT, SATURATED, FEW_LIGHTS, MASKED = 1, 2, 4, 8, 16


@dataclass(frozen=True)
class Problem:
    """T frames of H x W pixels under T lights; arrays in, nothing else needed.

    :param frames: T contiguous arrays (H, W) or (H, W, 3) of one dtype: uint8, uint16, float32.
    :param lights: (gh, gw, T, 3) float64, light vectors of the normalised intensities at the
        grid nodes, in ps_head_plane axes. Node (i, j) lies at pixel row i * step, column j * step;
        the grid has the size of `grid_size`. Equal nodes make a distant light.
    :param step: node distance in pixels.
    :param scale: (T, C) float64, factor from raw counts to normalised intensity (full scale,
        exposure; per channel the light's colour). C is 1 or 3.
    :param clip: upper limit of a scaled channel; infinity for none.
    :param reciprocal_flat: (gh, gw, T) float64 at the nodes, or None for no flat field.
    :param ambient: like one frame, or None.
    :param mask: (H, W) bool, True to solve, or None for all.
    :param saturation: raw count from which on a value is taken as saturated.
    :param view: (gh, gw, 3) float64, unit vectors from the surface to the camera at the nodes.
    """

    frames: list[NDArray]
    lights: NDArray[np.float64]
    step: int
    scale: NDArray[np.float64]
    clip: float = float('inf')
    reciprocal_flat: NDArray[np.float64] | None = None
    ambient: NDArray | None = None
    mask: NDArray[np.bool_] | None = None
    saturation: float = float('inf')
    view: NDArray[np.float64] | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        height, width = self.frames[0].shape[:2]
        return height, width

    @property
    def count(self) -> int:
        """Number of lights T."""
        return len(self.frames)

    @property
    def colour(self) -> bool:
        """Whether the frames are RGB."""
        return self.frames[0].ndim == 3


@dataclass
class Solution:
    """What a solver found; arrays may be preallocated by the caller and are then reused.

    :param normal: (H, W, 3) float32, unit, n_plane; NaN where there is none.
    :param albedo: (H, W) or (H, W, 3) float32, relative; NaN where there is no normal.
    :param confidence: (H, W) uint8, 0 invalid, 255 all lights agree; None if not asked for.
    :param reason: (H, W) uint8, bits SHADOW ... MASKED; None if not asked for.
    :param residual_rms: of the photometric equations, relative to the mean intensity; NaN if not
        asked for or if T = 3 leaves no redundancy.
    """

    normal: NDArray[np.float32]
    albedo: NDArray[np.float32]
    confidence: NDArray[np.uint8] | None = None
    reason: NDArray[np.uint8] | None = None
    residual_rms: float = float('nan')


def grid_size(shape: tuple[int, int], step: int) -> tuple[int, int]:
    """Number of nodes (gh, gw) of a grid with at least one node past the last pixel."""
    return (shape[0] - 1) // step + 2, (shape[1] - 1) // step + 2


def constant_lights(vectors: NDArray, shape: tuple[int, int]) -> tuple[NDArray[np.float64], int]:
    """Grid and step for lights that are the same at every pixel.

    :param vectors: (T, 3).
    :returns: lights (2, 2, T, 3) and the step.
    """
    grid = np.broadcast_to(np.asarray(vectors, np.float64), (2, 2, *np.shape(vectors))).copy()
    return grid, max(2, *shape)


def expand(grid: NDArray, step: int, shape: tuple[int, int], lattice: int = 1
           ) -> NDArray[np.float64]:
    """Bilinear interpolation of nodes to every pixel, (gh, gw, ...) to (H, W, ...).

    For tests, oracles and coarse images: a full-size expansion takes much memory.

    :param lattice: only every so many rows and columns.
    """
    def weights(n: int, nodes: int) -> tuple[NDArray, NDArray]:
        position = np.arange(0, n, lattice) / step
        low = np.minimum(position.astype(int), nodes - 2)
        return low, position - low

    (row, fy), (column, fx) = (weights(n, g) for n, g in zip(shape, grid.shape[:2], strict=True))
    tail = (1,) * (grid.ndim - 2)
    fy, fx = fy.reshape(-1, 1, *tail), fx.reshape(1, -1, *tail)
    rows = grid[row] * (1 - fy) + grid[row + 1] * fy
    expanded: NDArray[np.float64] = rows[:, column] * (1 - fx) + rows[:, column + 1] * fx
    return expanded


def intensities(problem: Problem) -> NDArray[np.float64]:
    """Normalised intensities v of every pixel, (H, W, T), in plain form for tests and oracles."""
    stack = np.stack([frame.reshape(*problem.shape, -1) for frame in problem.frames], axis=2)
    values = stack.astype(np.float64)                                            # (H, W, T, C)
    if problem.ambient is not None:
        values -= problem.ambient.reshape(*problem.shape, 1, -1)
    values = np.minimum(values * problem.scale, problem.clip)
    grey = values @ np.array(GREY_WEIGHTS) if problem.colour else values[..., 0]
    if problem.reciprocal_flat is not None:
        grey = grey * expand(problem.reciprocal_flat, problem.step, problem.shape)
    return grey
