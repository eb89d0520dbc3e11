"""Stack folders: one stack as files, in the layout of the photometric-stereo benchmarks.

Three kinds are read: a folder with lights.yaml (near panels of a head), one with
light_directions.txt (distant lights, the DiLiGenT layout), and four plain pictures whose names end
in 000, 090, 180, 270 (light from below, right, above, left). The README describes the files.

filenames.txt states the order of the frames, also beside lights.yaml; frames that only lights.yaml
names follow. The ambient picture is no frame and is not counted. No file may lead out of its
folder, not even by a link.
"""
from collections.abc import Sequence
from dataclasses import replace
import json
import math
import os
from pathlib import Path
import re

import numpy as np
from numpy.typing import NDArray
import scipy.io

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.head_model import CameraGeometry
from ps_head_driver.lights_file import FrameSection, LightsFile, first_repeated, read_lights
from ps_head_driver.stack import Geometry, Light, Mode, Panel, Plane, Stack, Truth
from ps_head_driver.stack_folder_writer import write_stack
from ps_head_driver.stack_pictures import (
    SUFFIXES,
    check_alike,
    flat_file,
    inside,
    optional,
    read_flats,
    read_image,
)

__all__ = ['DEFAULT_SLANT', 'LightsFile', 'read_lights', 'read_stack', 'select_lights',
           'write_stack']

DEFAULT_SLANT = math.radians(45)
AMBIENT = 'ambient.png'
# picture name ending: panel it belongs to, and azimuth of its light
_FOUR = {'090': (Panel.E, 0.0), '180': (Panel.N, 90.0), '270': (Panel.W, 180.0),
         '000': (Panel.S, 270.0)}
_BAD = ErrorCode.RECONSTRUCTION_BAD_STACK

Vector = tuple[float, float, float]


def read_stack(path: str | Path, slant: float = DEFAULT_SLANT, flat: str | Path | None = None,
               lights: str = 'all') -> tuple[Stack, Truth | None]:
    """Read a stack folder, a benchmark folder or four plain pictures.

    :param slant: angle of the light to the optical axis for four plain pictures, rad.
    :param flat: folder with the flat-field pictures, instead of the folder's own. A frame that is
        no equation (ALL, NONE, BOTH) needs none: its gain map is one everywhere.
    :param lights: which frames, see :func:`select_lights`.
    :returns: the stack, and the ground truth where the folder has it.
    :raises PsError: RECONSTRUCTION_BAD_STACK naming file and field.
    """
    folder = Path(path)
    try:
        if not folder.is_dir():
            raise PsError(_BAD, f'{folder}: no such folder')
        if optional(folder, 'lights.yaml'):
            stack, names = _read_near(folder)
        elif optional(folder, 'filenames.txt'):
            stack, names = _read_distant(folder)
        else:
            return select_lights(_read_four(folder, slant, flat), lights, folder), None
        stack = _with_mask_and_flat(stack, names, folder, flat)
        return select_lights(stack, lights, folder), _read_truth(folder, stack.shape)
    except OSError as error:
        raise PsError(_BAD, f'{error.filename or folder}: {error.strerror or error}') from error


def _with_mask_and_flat(stack: Stack, names: list[str], folder: Path,
                        flat: str | Path | None) -> Stack:
    file = optional(folder, 'mask.png')
    if file:
        picture = read_image(file)
        mask = np.any(picture > 0, axis=2) if picture.ndim == 3 else picture > 0
        if mask.shape != stack.shape:
            raise PsError(_BAD, f'{file}: is {mask.shape[::-1]} pixels, the pictures are '
                                f'{stack.shape[::-1]}')
        stack = replace(stack, mask=mask)
    flats = Path(flat) if flat else optional(folder, 'flat')
    if flats:
        gains = read_flats([flat_file(flats, name) if light.is_equation else None
                            for name, light in zip(names, stack.lights, strict=True)])
        stack = replace(stack, gain_maps=gains, flat_id=stack.flat_id or 'folder')
    return stack


def _read_near(folder: Path) -> tuple[Stack, list[str]]:
    lights = read_lights(folder)
    pictures = [read_image(inside(folder, frame.file, f'lights.yaml: frames.{i}.file'))
                for i, frame in enumerate(lights.frames)]
    ambient = next((picture for picture, frame in zip(pictures, lights.frames, strict=True)
                    if frame.is_ambient), None)
    order = [i for i in _order(folder, lights.frames) if not lights.frames[i].is_ambient]
    if not order:
        raise PsError(_BAD, f'{folder / "lights.yaml"}: frames: no lit frame')
    frames = [lights.frames[i] for i in order]
    images = [pictures[i] for i in order]
    names = [frame.file for frame in frames]
    if ambient is None and AMBIENT not in map(os.path.normpath, names):
        ambient = _read_ambient(folder)
    check_alike(folder, images, names, ambient)
    height, width = images[0].shape[:2]
    camera = CameraGeometry(width_px=width, height_px=height, **lights.camera.model_dump()) if (
        lights.camera) else None
    stack = Stack(
        images=images, lights=[_light(frame, lights.motor_counts) for frame in frames],
        camera=camera, ambient=ambient,
        plane=Plane(_unit(lights.plane.normal), lights.plane.offset),
        geometry=Geometry[lights.geometry], stack_id=lights.stack_id,
        session_id=lights.session_id, part_id=lights.part_id,
        calibration_id=lights.calibration_id, flat_id=lights.flat_id,
        convergence_radius=_or_nan(lights.convergence_radius),
        light_height=_or_nan(lights.light_height))
    return stack, names


def _order(folder: Path, frames: Sequence[FrameSection]) -> list[int]:
    """Indices of all frames of lights.yaml: those of filenames.txt, in its order, come first."""
    left = {os.path.normpath(frame.file): i for i, frame in enumerate(frames)}
    first = []
    for name in _read_filenames(folder) if optional(folder, 'filenames.txt') else []:
        path = os.path.normpath(name)
        if path in left:
            first.append(left.pop(path))
        elif path != AMBIENT:
            raise PsError(_BAD, f'{folder / "filenames.txt"}: {name!r} is not in lights.yaml')
    return first + list(left.values())


def _light(frame: FrameSection, motor_counts: int | None) -> Light:
    counts = motor_counts if frame.motor_counts is None else frame.motor_counts
    return Light(
        name=frame.name or Path(frame.file).stem, panel=Panel[frame.panel], mode=Mode[frame.mode],
        position=frame.position or (0.0, 0.0, 0.0), axis=_unit(frame.axis or (0.0, 0.0, -1.0)),
        right=_unit(frame.right), size=frame.size, lobe_exponent=frame.lobe_exponent,
        intensity=frame.intensity, exposure_scale=frame.exposure_scale, distant=frame.distant,
        tilt=frame.tilt, motor_counts=counts or 0)


def _read_distant(folder: Path) -> tuple[Stack, list[str]]:
    names = _read_filenames(folder)
    if AMBIENT in map(os.path.normpath, names):
        raise PsError(_BAD, f'{folder / "filenames.txt"}: {AMBIENT} has no light direction; list '
                            'the lit pictures only')
    file = optional(folder, 'light_directions.txt')
    if not file:
        raise PsError(_BAD, f'{folder}: neither lights.yaml nor light_directions.txt, so the '
                            'lights are not known')
    directions = _read_table(file, len(names), (3,))
    lengths = np.linalg.norm(directions, axis=1)
    if np.any(np.abs(lengths - 1) > 1e-2):
        line = int(np.argmax(np.abs(lengths - 1) > 1e-2)) + 1
        raise PsError(_BAD, f'{file}: line {line} is not a unit vector')
    directions /= lengths[:, None]
    file = optional(folder, 'light_intensities.txt')
    intensities = _read_table(file, len(names), (1, 3)) if file else np.ones((len(names), 1))
    if np.any(intensities <= 0):
        raise PsError(_BAD, f'{file}: intensities must be positive')
    images = [read_image(inside(folder, name, 'filenames.txt')) for name in names]
    ambient = _read_ambient(folder)
    check_alike(folder, images, names, ambient)
    lights = [
        Light(name=Path(name).stem, distant=True, axis=_vector(-direction),
              intensity=float(own[0]) if len(own) == 1 else _vector(own))
        for name, direction, own in zip(names, directions, intensities, strict=True)]
    stack = Stack(images=images, lights=lights, ambient=ambient, geometry=Geometry.CALIBRATED)
    return stack, names


def _read_ambient(folder: Path) -> NDArray | None:
    file = optional(folder, AMBIENT)
    return read_image(file) if file else None


def _read_four(folder: Path, slant: float, flat: str | Path | None) -> Stack:
    if not 0 < slant < math.pi / 2:
        raise PsError(_BAD, f'slant: {math.degrees(slant):g} degrees is not between 0 and 90')
    parts = _four_files(folder, of_flat=False)
    if parts is None:
        raise PsError(_BAD, f'{folder}: no stack: it has no lights.yaml, no filenames.txt and no '
                            'four pictures whose names end in 000, 090, 180, 270')
    images, lights = [], []
    for ending, (panel, azimuth) in _FOUR.items():
        angle = math.radians(azimuth)
        images.append(read_image(parts[ending]))
        lights.append(Light(
            name=parts[ending].stem, panel=panel, distant=True,
            axis=(-math.sin(slant) * math.cos(angle), -math.sin(slant) * math.sin(angle),
                  -math.cos(slant))))
    check_alike(folder, images, [light.name for light in lights], None)
    flats = _four_files(Path(flat) if flat else folder, of_flat=True)
    if flat and flats is None:
        raise PsError(_BAD, f'{flat}: no four pictures flat_*000, 090, 180, 270')
    gains = read_flats([flats[ending] for ending in _FOUR]) if flats else []
    return Stack(images=images, lights=lights, gain_maps=gains, geometry=Geometry.ASSUMED,
                 flat_id='folder' if gains else '')


def _four_files(folder: Path, of_flat: bool) -> dict[str, Path] | None:
    """The four pictures of a part or of the flat board, by the ending of their names."""
    found: dict[str, list[Path]] = {ending: [] for ending in _FOUR}
    if not folder.is_dir():
        raise PsError(_BAD, f'{folder}: no such folder')
    for file in sorted(folder.iterdir()):
        match = re.search(r'(?:^|[^0-9])(000|090|180|270)$', file.stem)
        if match and file.suffix.lower() in SUFFIXES and (
                file.stem.lower().startswith('flat') == of_flat):
            found[match[1]].append(file)
    if not any(found.values()):
        return None
    for ending, files in found.items():
        if len(files) != 1:
            what = ', '.join(file.name for file in files) or 'none'
            raise PsError(_BAD, f'{folder}: needs one picture whose name ends in {ending}, found '
                                f'{what}')
    return {ending: inside(folder, files[0].name) for ending, files in found.items()}


def _read_truth(folder: Path, shape: tuple[int, int]) -> Truth | None:
    normal = height = None
    file = optional(folder, 'Normal_gt.mat')
    # scipy and numpy answer a foreign file with errors of any type
    if file:
        try:
            normal = np.asarray(scipy.io.loadmat(file)['Normal_gt'], np.float32)
        except Exception as error:
            raise PsError(_BAD, f'{file}: key Normal_gt cannot be read: {_line(error)}') from error
        if normal.shape != (*shape, 3):
            raise PsError(_BAD, f'{file}: Normal_gt is {normal.shape}, not {(*shape, 3)}')
        length = np.linalg.norm(normal, axis=2, keepdims=True)
        normal = np.where(length > 0.5, normal / np.maximum(length, 1e-6), np.float32(np.nan))
    file = optional(folder, 'height_gt.npz')
    if file:
        try:
            with np.load(file, allow_pickle=False) as data:
                height = np.asarray(data['height'], np.float32)
        except Exception as error:
            raise PsError(_BAD, f'{file}: key height cannot be read: {_line(error)}') from error
        if height.shape != shape:
            raise PsError(_BAD, f'{file}: height is {height.shape}, not {shape}')
    if normal is None and height is None:
        return None
    return Truth(np.full((*shape, 3), np.nan, np.float32) if normal is None else normal, height)


def _read_filenames(folder: Path) -> list[str]:
    file = inside(folder, 'filenames.txt')
    names = [line.strip() for line in _read_text(file).splitlines() if line.strip()]
    if not names:
        raise PsError(_BAD, f'{file}: empty')
    twice = first_repeated(names)
    if twice is not None:
        raise PsError(_BAD, f'{file}: {twice!r} is listed twice')
    return names


def _read_text(file: Path) -> str:
    try:
        return file.read_text(encoding='utf-8-sig')
    except UnicodeDecodeError as error:
        raise PsError(_BAD, f'{file}: not a text in UTF-8') from error


def _read_table(file: Path, rows: int, columns: tuple[int, ...]) -> NDArray:
    lines = [line for line in _read_text(file).splitlines() if line.split('#')[0].strip()]
    if not lines:
        raise PsError(_BAD, f'{file}: empty')
    try:
        table = np.loadtxt(lines, ndmin=2)
    except ValueError as error:
        raise PsError(_BAD, f'{file}: not a table of numbers: {_line(error)}') from error
    if table.shape[0] != rows or table.shape[1] not in columns:
        raise PsError(_BAD, f'{file}: {table.shape[0]} lines of {table.shape[1]} numbers, '
                            f'expected {rows} of {" or ".join(map(str, columns))}')
    if not np.isfinite(table).all():
        raise PsError(_BAD, f'{file}: not all numbers are finite')
    return table


def _line(error: Exception) -> str:
    """Message of an error on one line; its type where it has none."""
    return ' '.join(str(error).split()) or type(error).__name__


def _unit(vector: Sequence[float]) -> Vector:
    length = math.hypot(*vector)
    # an exact unit vector stays exact, so that writing and reading changes nothing
    return _vector(vector) if abs(length - 1) < 1e-12 else _vector([v / length for v in vector])


def _vector(values: Sequence[float] | NDArray) -> Vector:
    return float(values[0]), float(values[1]), float(values[2])


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value


def select_lights(stack: Stack, selection: str, path: str | Path) -> Stack:
    """Only some frames of a stack.

    :param selection: ``all``, 1-based indices ``1,5,9`` in the order of filenames.txt, or
        a name such as ``four`` that subsets.json, beside or above the folder, lists under the
        folder's name.
    :param path: of the folder that the stack came from.
    :raises PsError: RECONSTRUCTION_BAD_STACK if the selection does not fit.
    """
    selection = selection.strip()
    if selection == 'all':
        return stack
    if re.fullmatch(r'\d{1,9}(\s*,\s*\d{1,9})*', selection):
        indices = [int(number) for number in selection.split(',')]
    else:
        indices = _named_subset(selection, Path(path).resolve())
    wrong = [i for i in indices if not 1 <= i <= len(stack.images)]
    if wrong or len(set(indices)) < len(indices):
        raise PsError(_BAD, f'lights: {selection}: indices must be different and from 1 to '
                            f'{len(stack.images)}')
    return stack.subset([i - 1 for i in indices])


def _named_subset(name: str, folder: Path) -> list[int]:
    for file in (folder / 'subsets.json', folder.parent / 'subsets.json'):
        if file.is_file():
            try:
                subset = json.loads(file.read_text(encoding='utf-8'))[folder.name][name]
                return [int(i) for i in subset]
            except (KeyError, TypeError, ValueError, OverflowError) as error:
                raise PsError(_BAD, f'{file}: no list {name!r} for {folder.name}') from error
    raise PsError(_BAD, f'lights: {name!r}: there is no subsets.json beside or above {folder}')
