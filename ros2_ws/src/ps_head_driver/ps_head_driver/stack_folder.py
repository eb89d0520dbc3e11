"""Stack folders: one stack as files, in the layout of the photometric-stereo benchmarks.

Three kinds are read: a folder with lights.yaml (near panels of a head), one with
light_directions.txt (distant lights, the DiLiGenT layout), and four plain pictures whose names end
in 000, 090, 180, 270 (light from below, right, above, left). The README describes the files.
"""
from collections.abc import Sequence
from dataclasses import replace
import json
import math
import os
from pathlib import Path
import re
import shutil
import tempfile
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator
import scipy.io
import yaml

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.head_model import CameraGeometry, parse_yaml, read_yaml
from ps_head_driver.stack import Geometry, Light, Mode, Panel, Plane, Stack, Truth

SUFFIXES = ('.png', '.jpg', '.jpeg', '.tif', '.tiff', '.bmp')
DEFAULT_SLANT = math.radians(45)
# a flat field is smooth: more rows than this only cost memory
FLAT_ROWS = 512
# picture name ending: panel it belongs to, and azimuth of its light
_FOUR = {'090': (Panel.E, 0.0), '180': (Panel.N, 90.0), '270': (Panel.W, 180.0),
         '000': (Panel.S, 270.0)}
_BAD = ErrorCode.RECONSTRUCTION_BAD_STACK

Vector = tuple[float, float, float]


# ---------------------------------------------------------------------------- lights.yaml

class _Section(BaseModel):
    model_config = ConfigDict(extra='forbid', frozen=True, allow_inf_nan=False)


class _Camera(_Section):
    fx: Annotated[float, Field(gt=0)]
    fy: Annotated[float, Field(gt=0)]
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    camera_standoff: Annotated[float, Field(gt=0)]


class _Plane(_Section):
    normal: Vector = (0.0, 0.0, 1.0)
    offset: float = 0.0


class _Frame(_Section):
    file: str
    panel: Literal['E', 'N', 'W', 'S', 'ALL', 'NONE']
    mode: Literal['BRIGHT_FIELD', 'DARK_FIELD', 'BOTH'] = 'BRIGHT_FIELD'
    name: str = ''
    position: Vector | None = None
    axis: Vector | None = None
    right: Vector = (1.0, 0.0, 0.0)
    size: tuple[Annotated[float, Field(ge=0)], Annotated[float, Field(ge=0)]] = (0.0, 0.0)
    lobe_exponent: Annotated[float, Field(ge=0)] = 1.0
    intensity: Annotated[float, Field(gt=0)] | tuple[float, float, float] = 1.0
    exposure_scale: Annotated[float, Field(gt=0)] = 1.0
    distant: bool = False
    tilt: float = 0.0
    motor_counts: int = 0

    @model_validator(mode='after')
    def _has_geometry(self) -> '_Frame':
        single = self.panel not in ('ALL', 'NONE') and self.mode != 'BOTH'
        if single and self.axis is None:
            raise ValueError('axis: a single-panel frame needs it')
        if single and not self.distant and self.position is None:
            raise ValueError('position: a near light needs it')
        for name in ('axis', 'right'):
            vector = getattr(self, name)
            if vector is not None and abs(math.hypot(*vector) - 1) > 1e-2:
                raise ValueError(f'{name}: not a unit vector')
        return self


class LightsFile(_Section):
    """Content of lights.yaml; ps_head_plane, metres and radians."""

    camera: _Camera | None = None
    motor_counts: int | None = None
    approach: Literal['up', 'down'] | None = None
    plane: _Plane = _Plane()
    geometry: Literal['NOMINAL', 'CALIBRATED', 'ASSUMED'] = 'NOMINAL'
    stack_id: str = ''
    session_id: str = ''
    part_id: str = ''
    calibration_id: str = ''
    flat_id: str = ''
    convergence_radius: float | None = None
    light_height: float | None = None
    frames: Annotated[list[_Frame], Field(min_length=1)]


def read_lights(folder: str | Path) -> LightsFile:
    """Read and check lights.yaml of a folder.

    :raises PsError: RECONSTRUCTION_BAD_STACK naming file and field.
    """
    path = Path(folder) / 'lights.yaml'
    lights: LightsFile = parse_yaml(LightsFile, read_yaml(path, _BAD), str(path), _BAD)
    return lights


# ---------------------------------------------------------------------------- reading

def read_stack(path: str | Path, slant: float = DEFAULT_SLANT, flat: str | Path | None = None,
               lights: str = 'all') -> tuple[Stack, Truth | None]:
    """Read a stack folder, a benchmark folder or four plain pictures.

    :param slant: angle of the light to the optical axis for four plain pictures, rad.
    :param flat: folder with the flat-field pictures, instead of the folder's own.
    :param lights: which frames, see :func:`select_lights`.
    :returns: the stack, and the ground truth where the folder has it.
    :raises PsError: RECONSTRUCTION_BAD_STACK naming file and field.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise PsError(_BAD, f'{folder}: no such folder')
    if (folder / 'lights.yaml').is_file():
        stack, stems = _read_near(folder)
    elif (folder / 'filenames.txt').is_file():
        stack, stems = _read_distant(folder)
    else:
        return select_lights(_read_four(folder, slant, flat), lights, folder), None
    if (folder / 'mask.png').is_file():
        picture = _read_image(folder / 'mask.png')
        mask = np.any(picture > 0, axis=2) if picture.ndim == 3 else picture > 0
        if mask.shape != stack.shape:
            raise PsError(_BAD, f'{folder / "mask.png"}: is {mask.shape[::-1]} pixels, the '
                                f'pictures are {stack.shape[::-1]}')
        stack = replace(stack, mask=mask)
    flats = Path(flat) if flat else folder / 'flat'
    if flats.is_dir() or flat:
        stack = replace(stack, gain_maps=_read_flats([_flat_file(flats, s) for s in stems]),
                        flat_id=stack.flat_id or 'folder')
    return select_lights(stack, lights, folder), _read_truth(folder, stack.shape)


def _read_near(folder: Path) -> tuple[Stack, list[str]]:
    lights = read_lights(folder)
    images: list[NDArray] = []
    states: list[Light] = []
    stems: list[str] = []
    ambient = None
    for i, frame in enumerate(lights.frames):
        image = _read_image(_inside(folder, frame.file, f'lights.yaml: frames.{i}.file'))
        # the one ambient frame is subtracted; other frames without light stay frames
        if frame.panel == 'NONE' and Path(frame.file).stem == 'ambient':
            ambient = image
            continue
        images.append(image)
        stems.append(Path(frame.file).stem)
        states.append(Light(
            name=frame.name or stems[-1], panel=Panel[frame.panel], mode=Mode[frame.mode],
            position=frame.position or (0.0, 0.0, 0.0), axis=_unit(frame.axis or (0, 0, -1.0)),
            right=_unit(frame.right), size=frame.size, lobe_exponent=frame.lobe_exponent,
            intensity=frame.intensity, exposure_scale=frame.exposure_scale, distant=frame.distant,
            tilt=frame.tilt, motor_counts=frame.motor_counts or lights.motor_counts or 0))
    if not images:
        raise PsError(_BAD, f'{folder / "lights.yaml"}: frames: no lit frame')
    if ambient is None and (folder / 'ambient.png').is_file():
        ambient = _read_image(folder / 'ambient.png')
    _check_alike(folder, images, stems, ambient)
    height, width = images[0].shape[:2]
    camera = CameraGeometry(width_px=width, height_px=height, **lights.camera.model_dump()) if (
        lights.camera) else None
    stack = Stack(
        images=images, lights=states, camera=camera, ambient=ambient,
        plane=Plane(_unit(lights.plane.normal), lights.plane.offset),
        geometry=Geometry[lights.geometry], stack_id=lights.stack_id,
        session_id=lights.session_id, part_id=lights.part_id,
        calibration_id=lights.calibration_id, flat_id=lights.flat_id,
        convergence_radius=_or_nan(lights.convergence_radius),
        light_height=_or_nan(lights.light_height))
    return stack, stems


def _read_distant(folder: Path) -> tuple[Stack, list[str]]:
    names = (folder / 'filenames.txt').read_text(encoding='utf-8').split('\n')
    names = [name.strip() for name in names if name.strip()]
    if not names:
        raise PsError(_BAD, f'{folder / "filenames.txt"}: empty')
    file = folder / 'light_directions.txt'
    if not file.is_file():
        raise PsError(_BAD, f'{folder}: neither lights.yaml nor light_directions.txt, so the '
                            'lights are not known')
    directions = _read_table(file, len(names), (3,))
    lengths = np.linalg.norm(directions, axis=1)
    if np.any(np.abs(lengths - 1) > 1e-2):
        line = int(np.argmax(np.abs(lengths - 1) > 1e-2)) + 1
        raise PsError(_BAD, f'{file}: line {line} is not a unit vector')
    directions /= lengths[:, None]
    file = folder / 'light_intensities.txt'
    intensities = (_read_table(file, len(names), (1, 3)) if file.is_file()
                   else np.ones((len(names), 1)))
    if np.any(intensities <= 0):
        raise PsError(_BAD, f'{file}: intensities must be positive')
    images = [_read_image(_inside(folder, name, 'filenames.txt')) for name in names]
    ambient = (_read_image(folder / 'ambient.png') if (folder / 'ambient.png').is_file()
               else None)
    _check_alike(folder, images, names, ambient)
    lights = [
        Light(name=Path(name).stem, distant=True, axis=_vector(-direction),
              intensity=float(own[0]) if len(own) == 1 else _vector(own))
        for name, direction, own in zip(names, directions, intensities, strict=True)]
    stack = Stack(images=images, lights=lights, ambient=ambient, geometry=Geometry.CALIBRATED)
    return stack, [light.name for light in lights]


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
        images.append(_read_image(parts[ending]))
        lights.append(Light(
            name=parts[ending].stem, panel=panel, distant=True,
            axis=(-math.sin(slant) * math.cos(angle), -math.sin(slant) * math.sin(angle),
                  -math.cos(slant))))
    _check_alike(folder, images, [light.name for light in lights], None)
    flats = _four_files(Path(flat) if flat else folder, of_flat=True)
    if flat and flats is None:
        raise PsError(_BAD, f'{flat}: no four pictures flat_*000, 090, 180, 270')
    gains = _read_flats([flats[ending] for ending in _FOUR]) if flats else []
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
    return {ending: files[0] for ending, files in found.items()}


def _read_flats(files: Sequence[Path]) -> list[NDArray]:
    """Flat-field pictures as gain maps, relative to their common maximum."""
    gains: list[NDArray] = []
    for file in files:
        image = np.asarray(_read_image(file), np.float32)
        image = image.mean(axis=2) if image.ndim == 3 else image
        if image.shape[0] > FLAT_ROWS:
            width = max(1, round(image.shape[1] * FLAT_ROWS / image.shape[0]))
            image = np.asarray(
                cv2.resize(image, (width, FLAT_ROWS), interpolation=cv2.INTER_AREA), np.float32)
        if not image.max() > 0:
            raise PsError(_BAD, f'{file}: the flat-field picture is black')
        gains.append(image)
    peak = max(gain.max() for gain in gains)
    return [np.maximum(gain / peak, np.float32(1e-3)) for gain in gains]


def _flat_file(folder: Path, stem: str) -> Path:
    for suffix in SUFFIXES:
        if (folder / f'{stem}{suffix}').is_file():
            return folder / f'{stem}{suffix}'
    raise PsError(_BAD, f'{folder}: no flat-field picture {stem}.*')


def _read_truth(folder: Path, shape: tuple[int, int]) -> Truth | None:
    normal = height = None
    file = folder / 'Normal_gt.mat'
    if file.is_file():
        try:
            normal = np.asarray(scipy.io.loadmat(file)['Normal_gt'], np.float32)
        except Exception as error:      # scipy answers a foreign file with errors of any type
            raise PsError(_BAD, f'{file}: key Normal_gt cannot be read: {error}') from error
        if normal.shape != (*shape, 3):
            raise PsError(_BAD, f'{file}: Normal_gt is {normal.shape}, not {(*shape, 3)}')
        length = np.linalg.norm(normal, axis=2, keepdims=True)
        normal = np.where(length > 0.5, normal / np.maximum(length, 1e-6), np.float32(np.nan))
    file = folder / 'height_gt.npz'
    if file.is_file():
        try:
            with np.load(file, allow_pickle=False) as data:
                height = np.asarray(data['height'], np.float32)
        except (KeyError, ValueError, OSError) as error:
            raise PsError(_BAD, f'{file}: key height cannot be read: {error}') from error
        if height.shape != shape:
            raise PsError(_BAD, f'{file}: height is {height.shape}, not {shape}')
    if normal is None and height is None:
        return None
    return Truth(np.full((*shape, 3), np.nan, np.float32) if normal is None else normal, height)


def _inside(folder: Path, name: str, field: str) -> Path:
    """File of a folder; a name that leads out of it is refused."""
    path = (folder / name).resolve()
    if Path(name).is_absolute() or not path.is_relative_to(folder.resolve()):
        raise PsError(_BAD, f'{folder}: {field}: {name!r} leaves the folder')
    return folder / name


def _read_image(path: Path) -> NDArray:
    """Picture of 8 or 16 bit or float, (H, W) or (H, W, 3) RGB, linear values as they are."""
    if not path.is_file():
        raise PsError(_BAD, f'{path}: no such picture')
    image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED) if (
        path.stat().st_size) else None
    if image is None:
        raise PsError(_BAD, f'{path}: cannot be read as a picture')
    if image.dtype not in (np.uint8, np.uint16, np.float32):
        raise PsError(_BAD, f'{path}: pixels of type {image.dtype}; use 8 or 16 bit')
    if image.ndim == 3:
        image = cv2.cvtColor(image, {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB,
                                     4: cv2.COLOR_BGRA2RGB}[image.shape[2]])
    return image


def _check_alike(folder: Path, images: list[NDArray], names: list[str],
                 ambient: NDArray | None) -> None:
    first = images[0]
    others = list(zip(names, images, strict=True))
    for name, image in others + ([('ambient', ambient)] if ambient is not None else []):
        if image.shape != first.shape or image.dtype != first.dtype:
            raise PsError(_BAD, f'{folder}: {name} is {image.shape} {image.dtype}, {names[0]} is '
                                f'{first.shape} {first.dtype}')


def _read_table(file: Path, rows: int, columns: tuple[int, ...]) -> NDArray:
    try:
        table = np.atleast_2d(np.loadtxt(file, ndmin=2))
    except ValueError as error:
        raise PsError(_BAD, f'{file}: not a table of numbers: {error}') from error
    if table.shape[0] != rows or table.shape[1] not in columns:
        raise PsError(_BAD, f'{file}: {table.shape[0]} lines of {table.shape[1]} numbers, '
                            f'expected {rows} of {" or ".join(map(str, columns))}')
    if not np.isfinite(table).all():
        raise PsError(_BAD, f'{file}: not all numbers are finite')
    return table


def _unit(vector: Sequence[float]) -> Vector:
    length = math.hypot(*vector)
    # an exact unit vector stays exact, so that writing and reading changes nothing
    return _vector(vector) if abs(length - 1) < 1e-12 else _vector([v / length for v in vector])


def _vector(values: Sequence[float] | NDArray) -> Vector:
    return float(values[0]), float(values[1]), float(values[2])


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value


# ---------------------------------------------------------------------------- lights to use

def select_lights(stack: Stack, selection: str, path: str | Path) -> Stack:
    """Only some frames of a stack.

    :param selection: ``all``, 1-based indices ``1,5,9``, or a name such as ``four`` that
        subsets.json, beside or above the folder, lists under the folder's name.
    :param path: of the folder that the stack came from.
    :raises PsError: RECONSTRUCTION_BAD_STACK if the selection does not fit.
    """
    if selection == 'all':
        return stack
    if re.fullmatch(r'\d+(,\d+)*', selection):
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
            except (KeyError, TypeError, ValueError) as error:
                raise PsError(_BAD, f'{file}: no list {name!r} for {folder.name}') from error
    raise PsError(_BAD, f'lights: {name!r}: there is no subsets.json beside or above {folder}')


# ---------------------------------------------------------------------------- writing

def write_stack(stack: Stack, path: str | Path, truth: Truth | None = None) -> None:
    """Write a stack folder: all of it, or nothing.

    :param path: must not exist, or be an empty folder.
    :raises PsError: RECONSTRUCTION_BAD_STACK if it is not empty or cannot be written.
    """
    folder = Path(path)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise PsError(_BAD, f'{folder}: is there already; give another name')
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(prefix=f'.{folder.name}.', dir=folder.parent))
        try:
            _write_files(stack, part, truth)
            part.chmod(0o755)
            os.replace(part, folder)
        except BaseException:
            shutil.rmtree(part, ignore_errors=True)
            raise
    except OSError as error:
        raise PsError(_BAD, f'{folder}: {error.strerror or error}') from error


def _write_files(stack: Stack, folder: Path, truth: Truth | None) -> None:
    names = [f'{i:03d}' for i in range(len(stack.images))]
    frames: list[dict[str, Any]] = []
    for i, (name, image, light) in enumerate(zip(names, stack.images, stack.lights, strict=True)):
        file = _write_image(folder / name, image)
        frames.append({
            'file': file, 'panel': _panel_name(light), 'mode': light.mode.name,
            'name': light.name, 'position': list(light.position), 'axis': list(light.axis),
            'right': list(light.right), 'size': list(light.size),
            'lobe_exponent': light.lobe_exponent,
            'intensity': list(light.intensity) if isinstance(light.intensity, tuple)
            else light.intensity,
            'exposure_scale': light.exposure_scale, 'distant': light.distant, 'tilt': light.tilt,
            'motor_counts': light.motor_counts})
        if stack.gain_maps:
            (folder / 'flat').mkdir(exist_ok=True)
            _write_image(folder / 'flat' / name, stack.gain_maps[i])
    if stack.ambient is not None:
        frames.append({'file': _write_image(folder / 'ambient', stack.ambient), 'panel': 'NONE'})
    if stack.mask is not None:
        _write_image(folder / 'mask', stack.mask.astype(np.uint8) * 255)
    content: dict[str, Any] = {
        'plane': {'normal': list(stack.plane.normal), 'offset': stack.plane.offset},
        'geometry': stack.geometry.name,
        **{key: getattr(stack, key) for key in (
            'stack_id', 'session_id', 'part_id', 'calibration_id', 'flat_id')}}
    for key in ('convergence_radius', 'light_height'):
        if math.isfinite(getattr(stack, key)):
            content[key] = getattr(stack, key)
    if stack.camera is not None:
        camera = stack.camera.model_dump(exclude={'width_px', 'height_px'})
        content['camera'] = {**camera, 'distortion': list(camera['distortion'])}
    content['frames'] = frames
    (folder / 'lights.yaml').write_text(
        yaml.safe_dump(content, sort_keys=False, width=200), encoding='utf-8')
    (folder / 'filenames.txt').write_text(
        ''.join(f'{frame["file"]}\n' for frame in frames if frame['panel'] != 'NONE'
                or not frame['file'].startswith('ambient')))
    if truth is not None:
        scipy.io.savemat(folder / 'Normal_gt.mat', {
            'Normal_gt': np.nan_to_num(np.asarray(truth.normal, np.float32))})
        if truth.height is not None:
            np.savez_compressed(folder / 'height_gt.npz', height=truth.height)


def _panel_name(light: Light) -> str:
    # a distant light of a benchmark belongs to no panel; E keeps it an equation when read again
    return 'E' if light.distant and light.panel is Panel.NONE else light.panel.name


def _write_image(stem: Path, image: NDArray) -> str:
    """Write losslessly: PNG, or TIFF for float pictures; returns the file name."""
    file = stem.with_name(stem.name + ('.tif' if image.dtype == np.float32 else '.png'))
    ok, data = cv2.imencode(file.suffix, image[..., ::-1] if image.ndim == 3 else image)
    if not ok:
        raise PsError(_BAD, f'{file}: cannot encode {image.shape} {image.dtype}')
    file.write_bytes(data.tobytes())
    return file.name
