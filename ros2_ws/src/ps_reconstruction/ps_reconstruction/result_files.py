"""Surface quantities as files: result.npz for computing, PNG for looking."""
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ps_reconstruction import preview
from ps_reconstruction.pipeline import Reconstruction

ARRAYS = ('normal', 'slope', 'albedo', 'height', 'curvature', 'shape', 'confidence', 'reason',
          'mask')


def write_result(result: Reconstruction, out: Path) -> list[Path]:
    """Write the quantities that a reconstruction has; see write_quantities."""
    return write_quantities(_arrays(result), out, result.pixel_pitch, result.metric)


def write_arrays(result: Reconstruction, out: Path) -> None:
    """Write result.npz only."""
    _write_npz(_arrays(result), out)


def _arrays(result: Reconstruction) -> dict[str, NDArray]:
    arrays = {name: getattr(result, name) for name in ARRAYS}
    return {name: values for name, values in arrays.items() if values is not None}


def _write_npz(quantities: Mapping[str, NDArray], out: Path) -> Path:
    out.mkdir(parents=True, exist_ok=True)
    # not compressed: that takes five times as long as the reconstruction for a tenth of the size
    np.savez(out / 'result.npz', **dict(quantities))  # type: ignore[arg-type]
    return out / 'result.npz'


def write_quantities(quantities: Mapping[str, NDArray], out: Path, pixel_pitch: float = 0.0,
                     metric: bool = True) -> list[Path]:
    """Write result.npz and one PNG or more for each quantity.

    16 bit: normal (n + 1) / 2, slope within +-1, albedo to its 99.9th percentile, height from its
    lowest to its highest value; 8 bit: shape, confidence and the pictures for people. Curvature
    and the mask are in the .npz only.

    :param quantities: as in pipeline.Reconstruction: any of ARRAYS.
    :param pixel_pitch: m; 0: no view of the height from the side.
    :param metric: heights are metres.
    :returns: the files.
    :raises OSError: naming the file.
    """
    files = [_write_npz(quantities, out)]
    for name, picture in _pictures(quantities, pixel_pitch, metric).items():
        bgr = picture[..., ::-1] if picture.ndim == 3 else picture
        files.append(out / f'{name}.png')
        # fast compression: the strong one takes longer than the reconstruction
        if not cv2.imwrite(str(files[-1]), np.ascontiguousarray(bgr),
                           [cv2.IMWRITE_PNG_COMPRESSION, 1]):
            raise OSError(f'{files[-1]} cannot be written')
    return files


def _pictures(quantities: Mapping[str, NDArray], pixel_pitch: float, metric: bool
              ) -> dict[str, NDArray]:
    pictures = {name: quantities[name] for name in ('shape', 'confidence') if name in quantities}
    if 'normal' in quantities:
        pictures['normal'] = preview.normal16(quantities['normal'])
    if 'slope' in quantities:
        slope = quantities['slope']
        axes = [preview.grey16(slope[..., axis], -1, 1) for axis in (0, 1)]
        pictures['slope'] = np.dstack([*axes, np.zeros(slope.shape[:2], np.uint16)])
        pictures['slope_view'] = preview.slope_preview(slope)
    if 'albedo' in quantities:
        albedo = quantities['albedo']
        white = float(np.nanpercentile(albedo, 99.9)) if np.isfinite(albedo).any() else 1.0
        pictures['albedo'] = preview.grey16(albedo, 0.0, white)
    if 'height' in quantities:
        height = quantities['height']
        low, high = ((float(np.nanmin(height)), float(np.nanmax(height)))
                     if np.isfinite(height).any() else (0.0, 1.0))
        pictures['height'] = preview.grey16(height, low, high)
        if pixel_pitch:
            pictures['height_view'] = preview.height_view(
                height, pixel_pitch, metric=metric,
                title='Height' if metric else 'Height, relative')
    return pictures
