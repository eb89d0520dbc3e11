"""Finding the printed dots of a target in a picture, to a hundredth of a pixel."""
from itertools import permutations
import math

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from ps_calibration.ring_target import RingTarget
from ps_calibration.robust import soft
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
_SPECK = 0.1             # of the light; what differs more counts less
_LIT = 0.4               # of a picture's median light; dots with less of it are not looked at
_RADIUS = 4.0            # px; as large as this a dot is easily found


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
    # finding them needs few pixels, placing them all
    part = max(1, int(radius / _RADIUS))
    height, width = (n // part * part for n in picture.shape)
    small = cv2.resize(picture[:height, :width], (width // part, height // part),
                       interpolation=cv2.INTER_AREA)
    spots = part * _dark_spots(small, radius / part) + (part - 1) / 2
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


def displacement(picture: NDArray, dots_px: NDArray, target: RingTarget,
                 camera: CameraGeometry) -> float:
    """How far the target moved between two pictures, px; dots in deep shadow do not count.

    :param picture: (H, W) float, room light subtracted.
    :param dots_px: (F, 2) the dots in the other picture, as from find_dots.
    """
    radius = target.fiducials.radius * camera.fx / camera.camera_standoff
    around = cv2.blur(picture.astype(np.float32), (round(6 * radius),) * 2)
    lit = [dot for dot in dots_px
           if around[tuple(dot[::-1].round().astype(int))] > _LIT * np.median(around)]
    moved = [float(np.linalg.norm(_refine(picture, dot, radius) - dot)) for dot in lit]
    return float(np.median(moved)) if moved else 0.0


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
    """Centre of a dot, (2,) px: a disc with a soft edge on evenly changing light, fitted.

    Only its edge tells where a dot is; a centroid would add the noise of everything around it.
    """
    reach = math.ceil(1.7 * radius) + 1
    column, row = (int(c) for c in centre.round())
    rows = slice(max(row - reach, 0), row + reach + 1)
    columns = slice(max(column - reach, 0), column + reach + 1)
    patch = picture[rows, columns].astype(np.float64)
    v, u = np.mgrid[:patch.shape[0], :patch.shape[1]]
    u, v = u + columns.start - centre[0], v + rows.start - centre[1]
    inside = np.hypot(u, v) < 1.7 * radius
    u, v, patch = u[inside], v[inside], patch[inside]
    level = float(np.median(patch))

    def errors(x: NDArray) -> NDArray:
        """x: centre, radius and softness of the edge, contrast; level and slopes of the light."""
        beyond, soft_px = np.hypot(u - x[0], v - x[1]) - x[2], max(abs(x[3]), 0.02)
        # a logistic edge, averaged over a pixel
        dark = 1 - soft_px * (np.logaddexp(0, (beyond + 0.5) / soft_px)
                              - np.logaddexp(0, (beyond - 0.5) / soft_px))
        light = x[5] + (x[6] * u + x[7] * v) / radius
        return soft((light * (1 - x[4] * dark) - patch / level) / _SPECK)[0]

    fit = least_squares(errors, [0, 0, radius, 0.3, 0.9, 1, 0, 0], method='lm',
                        x_scale=[0.1, 0.1, 0.1, 0.3, 0.1, 0.1, 0.1, 0.1], max_nfev=300)
    return np.asarray(centre + fit.x[:2])
