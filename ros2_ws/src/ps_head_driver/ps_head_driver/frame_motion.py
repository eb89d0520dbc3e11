"""Motion between the frames of a stack, measured from the pictures themselves.

Each frame has another light, so grey values do not match: a groove is bright on one side under one
light and on the other side under the next. Where something is does not change, though: frames are
compared by the size of their relative gradient, which lights from opposite sides share, with phase
correlation over many tiles. Edges of shadows and highlights do move with the light, but in
proportion to its direction; a moved head or part moves everything its own way.
"""
from collections.abc import Sequence
from itertools import combinations
import math

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from ps_head_driver.stack import Light, Panel

_TILE_PX = 128
_SMALLEST_TILE_PX = 32
_MARGIN_PX = 16             # around a tile, for the filters
_TILES = 6                  # in each direction, at most
_FINE_PX = 1300             # largest height of the pictures that are compared
_COARSE_PX = 256            # height of small ones, in which large motion is looked for first
_LARGE_PX = 6.0             # motion in the small pictures from which on they decide
_CLEAR_PEAK = 9.0           # over the standard deviation of the correlation: less may be chance
_HALVES_AGREE_PX = 1.5      # the two halves of the picture, about the shift of one pair of frames
_PAIRS_AGREE_PX = 0.6       # one pair, with the positions that fit all pairs
_ROUNDS = 20
_BY_LIGHT = 0.6             # share of the scatter of positions from which on the lights explain it

# where a panel's light comes from in the picture, x right and y down
_DIRECTIONS = {Panel.E: (1.0, 0.0), Panel.N: (0.0, -1.0), Panel.W: (-1.0, 0.0),
               Panel.S: (0.0, 1.0)}


def measure(images: Sequence[NDArray], lights: Sequence[Light]) -> float:
    """Largest shift between any two of the frames.

    :param images: (H, W) or (H, W, 3), uint8 or uint16, all of one shape.
    :param lights: of each image; only mode and panel matter.
    :returns: px; NaN where the pictures show too little to tell.
    """
    fine = math.ceil(images[0].shape[0] / _FINE_PX)
    pictures = [_reduced(image, fine) for image in images]
    coarse = pictures[0].shape[0] / _COARSE_PX
    if coarse > 1:
        motion = _motion([_reduced(picture, coarse) for picture in pictures], lights)
        if motion > _LARGE_PX:
            return fine * coarse * motion
    return fine * _motion(pictures, lights)


def _motion(pictures: Sequence[NDArray], lights: Sequence[Light]) -> float:
    """Largest distance between the positions of the frames, px of these pictures."""
    pairs, shifts, weights = _shifts([_tiles(picture) for picture in pictures])
    positions = _positions(len(pictures), pairs, shifts, weights)
    if positions is None:
        return math.nan
    positions = _without_light(positions, lights)
    return max(math.dist(*two) for two in combinations(positions, 2))


def _reduced(image: NDArray, factor: float) -> NDArray:
    """Picture smaller by a factor, grey."""
    if factor > 1:
        image = cv2.resize(image, None, fx=1 / factor, fy=1 / factor,
                           interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image


def _tiles(image: NDArray) -> NDArray:
    """Features of tiles on a grid over the picture, (2, n, h, w): in two halves, which cover it
    like the white and the black squares of a chessboard. Empty for a picture that is too small.
    """
    sizes = [min(_TILE_PX, length // 2 - 2 * _MARGIN_PX) for length in image.shape]
    if min(sizes) < _SMALLEST_TILE_PX:
        return np.empty((2, 0, 0, 0), np.float32)
    full = [size + 2 * _MARGIN_PX for size in sizes]
    rows, columns = (np.linspace(0, length - size, min(_TILES, length // size)).astype(int)
                     for length, size in zip(image.shape, full, strict=True))
    halves: list[list[NDArray]] = [[], []]
    for i, y in enumerate(rows):
        for j, x in enumerate(columns):
            halves[(i + j) % 2].append(_feature(image[y:y + full[0], x:x + full[1]]))
    count = min(map(len, halves))
    return np.array([half[:count] for half in halves])


def _feature(tile: NDArray) -> NDArray:
    """Size of the gradient relative to the brightness around; without the margin."""
    smooth = cv2.GaussianBlur(tile.astype(np.float32), (0, 0), 1.0)
    relative = smooth / (cv2.blur(smooth, (2 * _MARGIN_PX - 1,) * 2) + 0.1 * smooth.mean() + 1e-6)
    gradient = np.hypot(cv2.Sobel(relative, cv2.CV_32F, 1, 0),
                        cv2.Sobel(relative, cv2.CV_32F, 0, 1))
    return gradient[_MARGIN_PX:-_MARGIN_PX, _MARGIN_PX:-_MARGIN_PX]


def _shifts(features: Sequence[NDArray]) -> tuple[list[tuple[int, int]], NDArray, NDArray]:
    """Pairs of frames whose shift is clear, the shifts (n, 2), px, and their weights (n,).

    :param features: of each frame (2, n, h, w): tiles that move together, in two halves.
    """
    tiles_in_half, height, width = features[0].shape[1:]
    if not tiles_in_half:
        return [], np.empty((0, 2)), np.empty(0)
    window = np.outer(np.hanning(height), np.hanning(width)).astype(np.float32)
    spectra = [fft.rfft2((tiles - tiles.mean(axis=(2, 3), keepdims=True)) * window)
               for tiles in features]
    # a smooth peak: pixel by pixel the correlation of whitened pictures is all spikes
    v, u = fft.fftfreq(height)[:, None], fft.rfftfreq(width)[None]
    smoothing = np.exp(-2 * np.pi**2 * (u * u + v * v)).astype(np.float32)
    pairs, shifts, clear = [], [], []
    for i, j in combinations(range(len(features)), 2):
        cross = spectra[i].conj() * spectra[j]
        # whitened by what all tiles have in common: those that show much count for more
        white = cross.sum(axis=1) / (np.abs(cross).sum(axis=1) + 1e-12)
        halves = fft.irfft2(white * smoothing, s=(height, width))
        shift, height_of_peak = _peak(halves[0] + halves[1])
        own = [_peak(half)[0] for half in halves]
        if height_of_peak >= _CLEAR_PEAK and math.dist(*own) < _HALVES_AGREE_PX:
            pairs.append((i, j))
            shifts.append(shift)
            clear.append(height_of_peak)
    return pairs, np.array(shifts), np.array(clear)


def _peak(correlation: NDArray) -> tuple[tuple[float, float], float]:
    """Place of the maximum (x, y), px, and its height over the standard deviation."""
    height, width = correlation.shape
    y, x = np.unravel_index(int(correlation.argmax()), correlation.shape)
    column = correlation[[y - 1, y, (y + 1) % height], x]
    row = correlation[y, [x - 1, x, (x + 1) % width]]
    place = (_wrapped(x + _vertex(*row), width), _wrapped(y + _vertex(*column), height))
    return place, float(correlation[y, x] / (correlation.std() + 1e-30))


def _vertex(before: float, middle: float, after: float) -> float:
    """Where the parabola through three neighbours has its maximum."""
    curvature = before - 2 * middle + after
    return float(0.5 * (before - after) / curvature) if curvature < 0 else 0.0


def _wrapped(value: float, length: int) -> float:
    return (value + length / 2) % length - length / 2


def _positions(count: int, pairs: Sequence[tuple[int, int]], shifts: NDArray,
               weights: NDArray) -> NDArray | None:
    """Positions of the frames, (count, 2), px, that fit the shifts of most pairs.

    Single pairs may be deceived by their lights; then they contradict the others. None unless half
    of all pairs are clear and agree, and every frame has two such pairs.
    """
    if not pairs:
        return None
    design = np.zeros((len(pairs), count))
    for row, (i, j) in enumerate(pairs):
        design[row, i], design[row, j] = -1.0, 1.0
    positions, off = np.zeros((count, 2)), np.zeros(len(pairs))
    for _ in range(_ROUNDS):      # least absolute deviations by reweighting
        root = np.sqrt(weights / np.maximum(off, 0.05))[:, None]
        positions = np.linalg.lstsq(root * design, root * shifts, rcond=None)[0]
        off = np.linalg.norm(shifts - design @ positions, axis=1)
    agree = off < _PAIRS_AGREE_PX
    of_each = np.abs(design[agree]).sum(axis=0)
    if of_each.min() < min(2, count - 1) or 2 * agree.sum() < count * (count - 1) / 2:
        return None
    return positions


def _without_light(positions: NDArray, lights: Sequence[Light]) -> NDArray:
    """Positions without what moves with the light, where that explains most of their scatter.

    Only a full ring of panels tells the two apart.
    """
    rest = positions - positions.mean(axis=0)
    scatter = float((rest**2).sum())
    for mode in {light.mode for light in lights}:
        mine = [i for i, light in enumerate(lights)
                if light.mode is mode and light.panel in _DIRECTIONS]
        if {lights[i].panel for i in mine} != set(_DIRECTIONS):
            continue
        toward = np.array([_DIRECTIONS[lights[i].panel] for i in mine])
        own = rest[mine]
        rest[mine] = own - (toward * own).sum() / (toward**2).sum() * toward
    explained = scatter - float((rest**2).sum())
    return rest if explained > _BY_LIGHT * scatter else positions
