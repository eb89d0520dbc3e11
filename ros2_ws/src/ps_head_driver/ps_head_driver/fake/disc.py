"""The machined disc: turned face with rim and centre bore, stamped number, scratches, ink stain.

The numbers are those of an ordinary lathe part: feed marks of a few micrometres, a number stamped
0.1 mm deep, scratches of 5 to 20 micrometres that a bright-field picture hardly shows.
"""
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ps_head_driver.fake.features import scratch, smoothstep

_RADIUS = 0.0185
_RIM = (0.0160, 0.0176)          # raised ring, inner and outer radius
_RIM_HEIGHT = 2.5e-4
_THICKNESS = 1.5e-3
_FEED = 4e-4                     # turning marks: tool advance per revolution


def machined_disc(x: NDArray, y: NDArray, text: str = '0427', seed: int = 7,
                  stamp_depth: float = 1.2e-4, albedo: float = 0.7) -> dict[str, Any]:
    """Turned disc with its face in the plane z = 0, on a table 1.5 mm below.

    :param text: the stamped number.
    :param seed: of scratches and of the irregularities of turning.
    :param stamp_depth: m.
    """
    random = np.random.default_rng(seed)
    r = np.hypot(x, y)
    z = _turning_marks(r, random)
    z += _RIM_HEIGHT * (smoothstep(_RIM[0] - 2e-4, _RIM[0] + 2e-4, r)
                        - smoothstep(_RIM[1] - 2e-4, _RIM[1] + 2e-4, r))
    # centre bore: countersunk at 30 degrees, flat bottom
    z -= np.clip((3.2e-3 - r) * math.tan(math.radians(30)), 0.0, 8e-4)
    def within(cx: float, cy: float, reach: float) -> tuple[slice, slice]:
        """Rows and columns of the grid around a point: most features are small."""
        columns = np.flatnonzero(np.abs(x[0] - cx) <= reach)
        rows = np.flatnonzero(np.abs(y[:, 0] - cy) <= reach)
        if not (columns.size and rows.size):
            return slice(0), slice(0)
        return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)

    for label, depth, cy, letter in ((text, stamp_depth, 0.0092, 3.6e-3),
                                     ('PS HEAD', 0.7 * stamp_depth, -0.0095, 2.0e-3)):
        part = within(0.0, cy, 0.0135)
        z[part] -= _stamp(x[part], y[part] - cy, label, depth, letter)
    for _ in range(9):
        cx, cy = random.uniform(-0.011, 0.011, 2)
        part = within(cx, cy, 0.006)
        along, length = random.uniform(0, math.pi), random.uniform(3e-3, 9e-3)
        bend, width = random.uniform(-8, 8), random.uniform(7e-5, 1.3e-4)
        z[part] += scratch(x[part] - cx, y[part] - cy, along, length, width,
                           random.uniform(6e-6, 2e-5), bend)
    for cx, cy, radius, depth in ((-0.0095, -0.0030, 7e-4, 6e-5), (0.0105, 0.0048, 4e-4, 4e-5)):
        part = within(cx, cy, 4 * radius)
        z[part] += _ding(np.hypot(x[part] - cx, y[part] - cy) / radius, depth)
    # chamfer and wall down to the table
    chamfer = np.clip(r - (_RADIUS - 5e-4), 0.0, None)
    z = np.maximum(np.where(r < _RADIUS, z - chamfer, -1.0), -_THICKNESS)
    on_disc = r < _RADIUS
    reflectance = np.where(on_disc, albedo * _stain(x, y), 0.22)
    return {'height': z, 'albedo': reflectance}


def _turning_marks(r: NDArray, random: np.random.Generator) -> NDArray:
    """Scallops of a round-nosed tool, a little different at every revolution; m."""
    turn = r / _FEED
    revolution = np.floor(turn).astype(int)
    depth = random.uniform(1.5e-6, 4.0e-6, revolution.max() + 2)
    # a spread-out change of depth keeps the surface smooth between revolutions
    fraction = turn - revolution
    envelope = depth[revolution] * (1 - fraction) + depth[revolution + 1] * fraction
    return envelope * np.cos(2 * np.pi * turn)


def _stamp(x: NDArray, y: NDArray, text: str, depth: float, height: float) -> NDArray:
    """Depth of stamped characters: rounded grooves, with the metal pushed up beside them; m."""
    import cv2
    pixel = height / 120
    (width_px, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 120 / 22, 1)
    canvas = np.zeros((260, width_px + 140), np.uint8)
    cv2.putText(canvas, text, (70, 190), cv2.FONT_HERSHEY_SIMPLEX, 120 / 22, 255, 1, cv2.LINE_8)
    distance = cv2.distanceTransform(255 - canvas, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * pixel
    groove = 0.07 * height
    profile = depth * (1 - smoothstep(0.0, groove, distance))
    profile -= 0.12 * depth * np.exp(-((distance - 1.35 * groove) / (0.35 * groove)) ** 2)
    profile = cv2.GaussianBlur(profile, (0, 0), 2.0).astype(np.float32)
    column = x / pixel + (canvas.shape[1] - 1) / 2
    row = 130 - y / pixel
    return cv2.remap(profile, column.astype(np.float32), row.astype(np.float32),
                     cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)


def _ding(d: NDArray, depth: float) -> NDArray:
    """A round dent with a raised rim, d radii from its centre; m."""
    return depth * (0.25 * np.exp(-((d - 1.3) / 0.3) ** 2) - np.exp(-d ** 4))


def _stain(x: NDArray, y: NDArray) -> NDArray:
    """Relative reflectance: a stroke of ink, to be seen in the pictures but not in the shape."""
    u, v = 0.94 * x + 0.34 * y, -0.34 * x + 0.94 * y
    wave = v + 0.0045 - 6e-4 * np.sin(u / 1.1e-3)
    stroke = (1 - smoothstep(7e-4, 9e-4, np.abs(wave))) * (
        1 - smoothstep(8.5e-3, 9e-3, np.abs(u - 0.003)))
    return 1 - 0.55 * stroke
