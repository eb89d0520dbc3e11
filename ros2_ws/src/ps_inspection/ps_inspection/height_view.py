"""Data and scripts of the height map that can be turned in a page (templates/height_view.*)."""
import base64
from importlib import resources
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ps_reconstruction.preview import reduced

CELLS = 220     # along the longer side of what the browser draws


def relief(height: NDArray[np.float32], shape: NDArray[np.uint8], pitch: float,
           metric: bool) -> dict[str, Any] | None:
    """Reduced height map for the page: 16-bit heights (0: unknown) and 8-bit shape, as text.

    :param height: (H, W), NaN where unknown.
    :param shape: (H, W) shape-enhanced image.
    :param pitch: pixel distance in the unit of the heights.
    :param metric: that unit is m; False: unknown.
    :returns: None if no height is known.
    """
    field, step = reduced(height, CELLS)
    valid = np.isfinite(field)
    if not valid.any():
        return None
    lowest, highest = float(field[valid].min()), float(field[valid].max())
    span = max(highest - lowest, 1e-12)
    heights = np.where(valid, 1 + np.rint((np.where(valid, field, 0) - lowest) / span * 65534), 0)
    small = cv2.resize(shape, field.shape[::-1], interpolation=cv2.INTER_AREA)
    low, high = (float(value) for value in np.percentile(field[valid], (1, 99)))
    return {
        'columns': field.shape[1], 'rows': field.shape[0], 'cell': float(pitch * step),
        'lowest': lowest, 'highest': highest, 'low': low, 'high': high, 'metric': bool(metric),
        'heights': base64.b64encode(heights.astype('<u2').tobytes()).decode(),
        'shape': base64.b64encode(small.tobytes()).decode()}


def colours() -> list[list[int]]:
    """Cividis, readable with every kind of colour vision, as 33 RGB stops."""
    from matplotlib import colormaps
    return (colormaps['cividis'](np.linspace(0, 1, 33))[:, :3] * 255).round().astype(int).tolist()


def script(*names: str) -> str:
    """Scripts of this package's templates, for a script element."""
    folder = resources.files('ps_inspection') / 'templates'
    return ''.join((folder / name).read_text(encoding='utf-8') for name in names)
