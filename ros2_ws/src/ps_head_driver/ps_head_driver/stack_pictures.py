"""Pictures of stack folders: read and written losslessly, never from outside of their folder."""
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.paths import leads_out

SUFFIXES = ('.png', '.jpg', '.jpeg', '.tif', '.tiff', '.bmp')
# a flat field is smooth: more rows than this only cost memory
FLAT_ROWS = 512
_BAD = ErrorCode.RECONSTRUCTION_BAD_STACK
_TO_RGB = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGB}


def inside(folder: Path, name: str | Path, field: str = '') -> Path:
    """File of a folder; one that leads out of it, also by a link, is refused.

    :param field: where the name was read, for the message.
    :raises PsError: RECONSTRUCTION_BAD_STACK.
    """
    if Path(name).is_absolute() or leads_out(folder, name):
        where = f'{folder}: {field}' if field else str(folder)
        raise PsError(_BAD, f'{where}: {str(name)!r} leaves the folder')
    return folder / name


def optional(folder: Path, name: str | Path) -> Path | None:
    """File of a folder, None without it. A dangling link counts as there: it is a mistake.

    :raises PsError: RECONSTRUCTION_BAD_STACK if it leads out of the folder.
    """
    path = folder / name
    return inside(folder, name) if path.exists() or path.is_symlink() else None


def read_image(path: Path) -> NDArray:
    """Picture of 8 or 16 bit or float, (H, W) or (H, W, 3) RGB, linear values as they are.

    :raises PsError: RECONSTRUCTION_BAD_STACK naming the file.
    """
    if not path.is_file():
        raise PsError(_BAD, f'{path}: no such picture')
    data = np.fromfile(path, np.uint8)
    try:
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    except cv2.error:       # of a size that OpenCV refuses
        image = None
    if image is None:
        raise PsError(_BAD, f'{path}: cannot be read as a picture')
    if image.dtype not in (np.uint8, np.uint16, np.float32):
        raise PsError(_BAD, f'{path}: pixels of type {image.dtype}; use 8 or 16 bit')
    if image.ndim == 3:
        if image.shape[2] not in _TO_RGB:
            raise PsError(_BAD, f'{path}: {image.shape[2]} channels; use 1 or 3')
        image = cv2.cvtColor(image, _TO_RGB[image.shape[2]])
    if image.dtype == np.float32 and not np.isfinite(image).all():
        raise PsError(_BAD, f'{path}: pixels that are infinite or not a number')
    return image


def write_image(stem: Path, image: NDArray) -> str:
    """Write losslessly: PNG, or TIFF for float pictures; returns the file name.

    :raises PsError: RECONSTRUCTION_BAD_STACK for a picture that could not be read again.
    """
    file = stem.with_name(stem.name + ('.tif' if image.dtype == np.float32 else '.png'))
    if image.dtype not in (np.uint8, np.uint16, np.float32) or not np.isfinite(image).all():
        raise PsError(_BAD, f'{file}: cannot write pixels of type {image.dtype}, or infinite or '
                            'not a number')
    if not image.size or image.shape[2:] not in ((), (3,)):
        raise PsError(_BAD, f'{file}: cannot write a picture of shape {image.shape}')
    ok, data = cv2.imencode(file.suffix, image[..., ::-1] if image.ndim == 3 else image)
    if not ok:
        raise PsError(_BAD, f'{file}: cannot encode {image.shape} {image.dtype}')
    file.write_bytes(data.tobytes())
    return file.name


def check_alike(folder: Path, images: Sequence[NDArray], names: Sequence[str],
                ambient: NDArray | None) -> None:
    """Refuse pictures of different size or type.

    :raises PsError: RECONSTRUCTION_BAD_STACK naming the first that differs.
    """
    first = images[0]
    others = list(zip(names, images, strict=True))
    for name, image in others + ([('ambient', ambient)] if ambient is not None else []):
        if image.shape != first.shape or image.dtype != first.dtype:
            raise PsError(_BAD, f'{folder}: {name} is {image.shape} {image.dtype}, {names[0]} is '
                                f'{first.shape} {first.dtype}')


def flat_file(folder: Path, name: str) -> Path:
    """Flat-field picture of the same name, of any suffix.

    :raises PsError: RECONSTRUCTION_BAD_STACK if there is none, or it leads out of the folder.
    """
    own = Path(name)
    for candidate in (own, *(own.with_suffix(suffix) for suffix in SUFFIXES)):
        path = optional(folder, candidate)
        if path is not None:
            return path
    raise PsError(_BAD, f'{folder}: no flat-field picture {own.with_suffix("")}.*')


def read_flats(files: Sequence[Path | None]) -> list[NDArray]:
    """Flat-field pictures as gain maps, relative to their common maximum.

    :param files: one per frame; None for a frame that needs none: its map is one everywhere.
    :returns: (h, w) float32 each, 1e-3 to 1, at most FLAT_ROWS high.
    :raises PsError: RECONSTRUCTION_BAD_STACK naming a black or broken picture.
    """
    flats = [None if file is None else _read_flat(file) for file in files]
    peak = max((flat.max() for flat in flats if flat is not None), default=1)
    return [np.ones((1, 1), np.float32) if flat is None
            else np.maximum(flat / peak, np.float32(1e-3)) for flat in flats]


def _read_flat(file: Path) -> NDArray:
    image = np.asarray(read_image(file), np.float32)
    if image.shape[0] > FLAT_ROWS:
        width = max(1, round(image.shape[1] * FLAT_ROWS / image.shape[0]))
        image = np.asarray(
            cv2.resize(image, (width, FLAT_ROWS), interpolation=cv2.INTER_AREA), np.float32)
    image = image.mean(axis=2) if image.ndim == 3 else image
    if not image.max() > 0:
        raise PsError(_BAD, f'{file}: the flat-field picture is black')
    return image
