"""Finding the printed dots of a target in a picture, to a hundredth of a pixel."""
from itertools import permutations
import math

import cv2
import numpy as np
from numpy.typing import NDArray

from ps_calibration.ring_target import RingTarget
from ps_head_driver.camera_model import plane_points
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.head_model import CameraGeometry
from ps_head_driver.stack import Plane

# a dot is darker than this part of its surroundings
_DARK = 0.30
# areas and distances of the dots may be off by this much before the plane is known
_AREA, _SCALE = (0.5, 1.6), 0.08
_ASTRAY = 0.0012         # m, of a dot from where the other ones predict it
_MOST = 40               # dark spots looked at


def find_dots(picture: NDArray, target: RingTarget, camera: CameraGeometry) -> NDArray:
    """Centres of the target's dots.

    :param picture: (H, W) float, room light subtracted; best with all panels on.
    :param camera: intrinsics for pictures of this size.
    :returns: (F, 2) float64, column and row in the distorted picture, in the target's order.
    :raises PsError: CALIBRATION_TARGET_NOT_FOUND with what was seen instead.
    """
    picture = picture.astype(np.float32)
    pixel = camera.camera_standoff / camera.fx
    radius = target.fiducials.radius / pixel
    spots = _dark_spots(picture, radius)
    dots = np.array(target.fiducials.centres)
    if len(spots) < len(dots):
        raise PsError(ErrorCode.CALIBRATION_TARGET_NOT_FOUND,
                      f'target {target.name} not found: {len(spots)} of its {len(dots)} dots are '
                      'visible; put it under the head, in focus, with its base filling the '
                      'picture')
    points = plane_points(camera, spots, Plane())[:, :2]
    chosen = _match(points, dots)
    if chosen is None:
        if _match(points * [1, -1], dots) is not None:
            raise PsError(ErrorCode.CALIBRATION_TARGET_NOT_FOUND,
                          f'target {target.name} is seen mirrored: the pictures are flipped, or '
                          'it is another target')
        raise PsError(ErrorCode.CALIBRATION_TARGET_NOT_FOUND,
                      f'target {target.name} not found: {len(spots)} dark dots are visible, but '
                      'not in its pattern; is it the right target, entirely in the picture?')
    return np.array([_refine(picture, spots[i], radius) for i in chosen])


def _dark_spots(picture: NDArray, radius: float) -> NDArray:
    """Centres of round dark spots of about this radius (px), (N, 2), the roundest first."""
    side = 2 * round(2.5 * radius) + 1
    # closing fills everything dark that is narrower than the kernel
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    smooth = cv2.GaussianBlur(picture, (0, 0), max(radius / 10, 0.6))
    around = cv2.morphologyEx(smooth, cv2.MORPH_CLOSE, kernel)
    dark = ((smooth < _DARK * around) & (around > 0.05 * around.max())).astype(np.uint8)
    count, _, stats, centres = cv2.connectedComponentsWithStats(dark)
    found = []
    for k in range(1, count):
        width, height, area = stats[k, 2:5]
        filled = area / (math.pi / 4 * width * height)
        if (_AREA[0] < area / (math.pi * radius**2) < _AREA[1] and 0.8 < filled < 1.2
                and 0.7 < width / height < 1.4):
            found.append((abs(filled - 1) + abs(math.log(width / height)), *centres[k]))
    return np.array(sorted(found)[:_MOST]).reshape(-1, 3)[:, 1:]


def _match(points: NDArray, dots: NDArray) -> list[int] | None:
    """Which point is which dot, by similarity transforms without mirroring."""
    found, target = points @ [1, 1j], dots @ [1, 1j]
    first, second = 0, int(np.argmax(abs(target - target[0])))
    best: tuple[float, list[int]] | None = None
    for a, b in permutations(range(len(found)), 2):
        factor = (found[b] - found[a]) / (target[second] - target[first])
        if abs(abs(factor) - 1) > _SCALE:
            continue
        predicted = found[a] + factor * (target - target[first])
        gaps = abs(predicted[:, None] - found)
        nearest = gaps.argmin(axis=1)
        worst = gaps.min(axis=1).max()
        if (worst < _ASTRAY and len(set(nearest)) == len(dots)
                and (best is None or worst < best[0])):
            best = (worst, [int(i) for i in nearest])
    return best and best[1]


def _refine(picture: NDArray, centre: NDArray, radius: float) -> NDArray:
    """Centroid of the missing light against a plane fitted to the surroundings, (2,) px."""
    reach = math.ceil(1.8 * radius) + 2
    centre = centre.copy()
    for _ in range(3):
        column, row = (int(c) for c in centre.round())
        rows = slice(max(row - reach, 0), row + reach + 1)
        columns = slice(max(column - reach, 0), column + reach + 1)
        patch = picture[rows, columns].astype(np.float64)
        v, u = np.mgrid[:patch.shape[0], :patch.shape[1]]
        u, v = u + columns.start - centre[0], v + rows.start - centre[1]
        distance = np.hypot(u, v)
        ring = (distance > 1.35 * radius) & (distance < 1.8 * radius)
        terms = np.stack([np.ones_like(u), u, v], axis=-1)
        plane = terms @ np.linalg.lstsq(terms[ring], patch[ring], rcond=None)[0]
        # smooth window: a pixel must not jump in or out as the centre moves
        window = np.clip((1.35 * radius - distance) + 0.5, 0, 1)
        missing = window * (1 - patch / plane)
        centre += [np.sum(missing * u) / missing.sum(), np.sum(missing * v) / missing.sum()]
    return centre
