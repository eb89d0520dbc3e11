"""Plain loops over a chunk of pixels, in the buffers of outliers.py.

numba copies and fills slices element by element; written as loops they become vector instructions,
which makes the robust regression a third faster.
"""
import numba
import numpy as np

from ps_reconstruction.outliers import CHUNK, FAST


@numba.njit(nogil=True, cache=True)
def fill(target, value):    # type: ignore[no-untyped-def]
    """Set all elements."""
    for x in range(len(target)):
        target[x] = value


@numba.njit(nogil=True, cache=True)
def store(source, target):    # type: ignore[no-untyped-def]
    """Copy the first elements of a buffer to a part of a row."""
    for x in range(len(target)):
        target[x] = source[x]


@numba.njit(nogil=True, cache=True)
def count_true(values):    # type: ignore[no-untyped-def]
    """Number of True."""
    total = 0
    for x in range(len(values)):
        total += int(values[x])
    return total


@numba.njit(nogil=True, cache=True, fastmath=FAST, error_model='numpy')
def interpolate(grid, i, fy, begin, step, out):    # type: ignore[no-untyped-def]
    """One quantity of the nodes, (gh, gw), along CHUNK pixels of a row below node row i.

    Beyond the last node it is extrapolated: what lies past the picture's edge is read by nobody.
    """
    x = 0
    while x < CHUNK:
        j = min((begin + x) // step, grid.shape[1] - 2)
        end = min((j + 1) * step - begin, CHUNK) if j < grid.shape[1] - 2 else CHUNK
        left = grid[i, j] + fy * (grid[i + 1, j] - grid[i, j])
        right = grid[i, j + 1] + fy * (grid[i + 1, j + 1] - grid[i, j + 1])
        slope = (right - left) / np.float32(step)
        left -= slope * np.float32(j * step - begin)
        for k in range(x, end):
            out[k] = left + slope * np.float32(np.int32(k))      # 64 bits hinder vectors
        x = end
