"""Write a stack as a folder that :mod:`ps_head_driver.stack_folder` reads again unchanged."""
from collections.abc import Sequence
import math
import os
from pathlib import Path
import shutil
import tempfile
from typing import Any

import numpy as np
import scipy.io
import yaml

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.head_model import parse_yaml
from ps_head_driver.lights_file import LightsFile
from ps_head_driver.stack import Light, Stack, Truth
from ps_head_driver.stack_pictures import check_alike, write_image

_BAD = ErrorCode.RECONSTRUCTION_BAD_STACK


def write_stack(stack: Stack, path: str | Path, truth: Truth | None = None,
                approach: str | None = None) -> None:
    """Write a stack folder: all of it, or nothing.

    :param path: must not exist, or be an empty folder.
    :param approach: last direction of the motor, up or down, where it is known.
    :raises PsError: RECONSTRUCTION_BAD_STACK if it is not empty or cannot be written, or if the
        stack could not be read again.
    """
    folder = Path(path)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise PsError(_BAD, f'{folder}: is there already; give another name')
    _check(stack, folder)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(prefix=f'.{folder.name}.', dir=folder.parent))
        try:
            _write_files(stack, part, truth, approach)
            part.chmod(0o755)
            os.replace(part, folder)
        except BaseException:
            shutil.rmtree(part, ignore_errors=True)
            raise
    except PsError as error:    # names the folder asked for, not the one that is gone
        raise PsError(_BAD, error.message.replace(str(part), str(folder))) from error
    except OSError as error:
        raise PsError(_BAD, f'{folder}: {error.strerror or error}') from error


def _check(stack: Stack, folder: Path) -> None:
    count = len(stack.images)
    if not count:
        raise PsError(_BAD, f'{folder}: the stack has no pictures')
    if len(stack.lights) != count or len(stack.gain_maps) not in (0, count):
        raise PsError(_BAD, f'{folder}: {count} pictures, but {len(stack.lights)} lights and '
                            f'{len(stack.gain_maps)} gain maps')
    check_alike(folder, stack.images, [f'picture {i}' for i in range(count)], stack.ambient)
    if stack.mask is not None and stack.mask.shape != stack.shape:
        raise PsError(_BAD, f'{folder}: the mask is {stack.mask.shape}, the pictures are '
                            f'{stack.shape}')


def _write_files(stack: Stack, folder: Path, truth: Truth | None,
                 approach: str | None) -> None:
    names = [f'{i:03d}' for i in range(len(stack.images))]
    files = [write_image(folder / name, image)
             for name, image in zip(names, stack.images, strict=True)]
    frames = [{'file': file, **_light(light)}
              for file, light in zip(files, stack.lights, strict=True)]
    if stack.gain_maps:
        (folder / 'flat').mkdir()
        for name, gain in zip(names, stack.gain_maps, strict=True):
            write_image(folder / 'flat' / name, gain)
    if stack.ambient is not None:
        frames.append({'file': write_image(folder / 'ambient', stack.ambient), 'panel': 'NONE'})
    if stack.mask is not None:
        write_image(folder / 'mask', stack.mask.astype(np.uint8) * 255)
    content = {**_whole(stack), 'frames': frames}
    if approach:
        content['approach'] = approach
    # what is written can be read: a wrong light is found now, not when it is needed
    parse_yaml(LightsFile, content, str(folder / 'lights.yaml'), _BAD)
    (folder / 'lights.yaml').write_text(
        yaml.safe_dump(content, sort_keys=False, width=200), encoding='utf-8')
    (folder / 'filenames.txt').write_text(''.join(f'{file}\n' for file in files))
    if truth is not None:
        scipy.io.savemat(folder / 'Normal_gt.mat', {
            'Normal_gt': np.nan_to_num(np.asarray(truth.normal, np.float32))})
        if truth.height is not None:
            np.savez_compressed(folder / 'height_gt.npz', height=truth.height)


def _whole(stack: Stack) -> dict[str, Any]:
    """What lights.yaml states of the whole stack."""
    content: dict[str, Any] = {
        'plane': {'normal': _numbers(stack.plane.normal), 'offset': float(stack.plane.offset)},
        'geometry': stack.geometry.name,
        **{key: getattr(stack, key) for key in (
            'stack_id', 'session_id', 'part_id', 'calibration_id', 'flat_id')}}
    for key in ('convergence_radius', 'light_height'):
        if math.isfinite(getattr(stack, key)):
            content[key] = float(getattr(stack, key))
    if stack.camera is not None:
        camera = stack.camera.model_dump(exclude={'width_px', 'height_px'})
        content['camera'] = {**camera, 'distortion': list(camera['distortion'])}
    return content


def _light(light: Light) -> dict[str, Any]:
    """What lights.yaml states of one light; no geometry where several panels or none were on."""
    content: dict[str, Any] = {
        'panel': light.panel.name, 'mode': light.mode.name, 'name': light.name,
        'exposure_scale': float(light.exposure_scale), 'distant': light.distant,
        'tilt': float(light.tilt), 'motor_counts': int(light.motor_counts)}
    if any(light.axis):
        content |= {
            'position': _numbers(light.position), 'axis': _numbers(light.axis),
            'right': _numbers(light.right), 'size': _numbers(light.size),
            'lobe_exponent': float(light.lobe_exponent)}
    if np.any(light.intensity):
        content['intensity'] = (_numbers(light.intensity) if isinstance(light.intensity, tuple)
                                else float(light.intensity))
    return content


def _numbers(values: Sequence[float]) -> list[float]:
    # plain floats: YAML knows no numpy scalars
    return [float(value) for value in values]
