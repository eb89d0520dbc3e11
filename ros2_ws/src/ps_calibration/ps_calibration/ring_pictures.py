"""Pictures of the half ring before any fit: are they usable, and where is the target in them?"""
from collections.abc import Sequence
import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from ps_calibration.detection import find_dots
from ps_calibration.linearity import response_exponent
from ps_calibration.ring_target import RingTarget
from ps_calibration.shares import Shares
from ps_calibration.target_pose import TargetPose, fit_pose
from ps_head_driver.camera_model import scaled_camera
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.head_model import DIRECTIONS, CameraGeometry, HeadModel
from ps_head_driver.kinematics import BrightFieldKinematics
from ps_head_driver.stack import Light, Mode, Panel, Stack

_SATURATED = 0.002       # part of the pixels at the end of the range
_BLOCKS = 16             # a side, that tell how bright the plate is around a saturated pixel
_GLINT = 0.8             # of a saturated pixel's value: a plate darker than this is not too bright
_DARK = 0.05             # mean of a picture, relative to the end of its range
_DEAD = 0.3              # of the mean of the four panels
_NOT_LINEAR = 0.01       # off the camera's exponent of 1; turns panels by less than 0.1 degrees
MOVED_PX = 0.3           # of a dot, between two pictures
_TILE_PX = 64            # in which a dark picture's noise and mean are alike
_NO_ROUNDING = 0.7       # grey values; with more noise, rounding leaves means alone


def common_camera(stacks: Sequence[Stack], head: HeadModel) -> CameraGeometry:
    """Intrinsics of the pictures; where they state none, those of the head."""
    if not stacks:
        raise PsError(ErrorCode.CALIBRATION_BAD_REQUEST, 'no pictures given')
    cameras = [stack.camera or scaled_camera(head.camera, *reversed(stack.shape))
               for stack in stacks]
    for k, camera in enumerate(cameras):
        if camera != cameras[0]:
            raise PsError(ErrorCode.CALIBRATION_BAD_REQUEST,
                          f'position {k + 1}: another camera or picture size than position 1; '
                          'calibrate with one camera (lights.yaml: camera)')
    return cameras[0]


def nominal_tilt(stack: Stack, kinematics: BrightFieldKinematics) -> float:
    """From the motor counts; where the pictures state none, from the lights' own axes, rad."""
    light = next(light for light in stack.lights
                 if light.panel == Panel.E and light.mode == Mode.BRIGHT_FIELD)
    if light.motor_counts:
        return float(kinematics.tilt(light.motor_counts))
    return _axis_tilt(light)


def stated_tilt(light: Light) -> float:
    """Tilt of a panel as its picture states it, or else from the light's own axis, rad."""
    return light.tilt or _axis_tilt(light)


def _axis_tilt(light: Light) -> float:
    return math.acos(min(max(-light.axis[2], -1.0), 1.0))


def _range_of(images: Sequence[NDArray]) -> float:
    """End of the grey values' range; cameras deliver 10, 12 or 14 bit in words of 16."""
    if not np.issubdtype(images[0].dtype, np.integer):
        return math.inf
    if images[0].dtype == np.uint8:
        return 255.0
    highest = max(int(image.max()) for image in images)
    return float(next(2**bits - 1 for bits in (10, 12, 14, 16) if highest < 2**bits))


def _frame(stack: Stack, panel: Panel, mode: Mode) -> tuple[NDArray, float]:
    """One frame and its exposure."""
    for image, light in zip(stack.images, stack.lights, strict=True):
        if light.panel == panel and light.mode == mode:
            return image, light.exposure_scale
    if panel == Panel.NONE and stack.ambient is not None:
        return stack.ambient, 1.0
    raise PsError(ErrorCode.CALIBRATION_BAD_REQUEST,
                  f'{stack.stack_id or "the pictures"}: frame {panel.name} is missing; a ring '
                  'calibration needs E, N, W, S, ALL and NONE')


def unrounded(picture: NDArray) -> NDArray:
    """A dark picture without what rounding to whole grey values does to its mean.

    With less noise than half a grey value, means are drawn towards whole values, by up to a
    quarter of one. Subtracted from all four panels, 0.04 of 255 grey values too few look like a
    turn of the panels of 0.05 degrees. In tiles, a normal distribution is put through the parts
    of the pixels below and above the most common value.

    :param picture: (H, W, ...) of whole grey values; others are returned as they are.
    :returns: float32.
    """
    out: NDArray = picture.astype(np.float32)
    if not np.issubdtype(picture.dtype, np.integer):
        return out
    for row in range(0, picture.shape[0], _TILE_PX):
        for column in range(0, picture.shape[1], _TILE_PX):
            here = (slice(row, row + _TILE_PX), slice(column, column + _TILE_PX))
            tile = out[here]
            middle = float(np.median(tile))
            low, high = np.mean(tile < middle - 0.25), np.mean(tile <= middle + 0.25)
            alike = abs(tile - middle) < 2.5
            if not (0 < low < high < 1) or not alike.any():
                continue
            first, last = ndtri(low), ndtri(high)
            if last - first > 1 / _NO_ROUNDING:
                mean = middle + 0.5 - last / (last - first)
                tile[alike] += mean - tile[alike].mean()
    return out


def room_light(stack: Stack) -> NDArray:
    """The frame without panels at unit exposure, float32.

    :raises PsError: CALIBRATION_BAD_REQUEST if there is none.
    """
    dark, scale = _frame(stack, Panel.NONE, Mode.BRIGHT_FIELD)
    return unrounded(dark) / scale


def without_room(stack: Stack, panel: Panel, mode: Mode, room: NDArray,
                 ) -> tuple[NDArray, NDArray]:
    """One frame at unit exposure without the light of the room, and where it is saturated.

    :param room: as from room_light: it shines for as long as the shutter is open.
    :returns: (H, W) float32, and (H, W) bool.
    :raises PsError: CALIBRATION_BAD_REQUEST if there is no such frame.
    """
    image, scale = _frame(stack, panel, mode)
    grey = image.astype(np.float32) / scale - room
    burnt: NDArray = np.asarray(image >= _range_of(stack.images))
    if grey.ndim == 3:
        return grey.mean(axis=-1), np.asarray(burnt.any(axis=-1))
    return grey, burnt


def _remedy_for_saturation(picture: NDArray, burnt: NDArray) -> str:
    """Glints stand out of a plate that is well exposed; else the plate itself is too bright."""
    height, width = (np.array(picture.shape) // _BLOCKS).clip(1)
    whole = np.s_[:height * _BLOCKS, :width * _BLOCKS]
    picture, burnt = picture[whole], burnt[whole]
    blocks = picture.reshape(_BLOCKS, height, _BLOCKS, width)
    around = np.median(blocks, axis=(1, 3)).repeat(height, 0).repeat(width, 1)
    if np.mean(around[burnt] < _GLINT * np.median(picture[burnt])) > 0.5:
        return (' in scattered spots; clean the target and see that it is matt, or, if it is, '
                'lower the exposure')
    return '; lower its exposure'


def light_only(stack: Stack) -> list[NDArray]:
    """E, N, W, S at equal exposure, without the light of the room.

    :raises PsError: CALIBRATION_CAPTURE_FAILED for pictures that cannot be used.
    """
    code, name = ErrorCode.CALIBRATION_CAPTURE_FAILED, stack.stack_id or 'pictures'
    full, room = _range_of(stack.images), room_light(stack)
    frames = []
    for panel in (Panel.E, Panel.N, Panel.W, Panel.S, Panel.ALL):
        picture, burnt = without_room(stack, panel, Mode.BRIGHT_FIELD, room)
        if burnt.mean() > _SATURATED:
            raise PsError(code, f'{name}: frame {panel.name} is saturated'
                                f'{_remedy_for_saturation(picture, burnt)}')
        frames.append(picture)
    singles, together = frames[:4], frames[4]
    means = np.array([float(frame.mean()) for frame in singles])
    if math.isfinite(full) and means.max() < _DARK * full:
        raise PsError(code, f'{name}: the pictures are too dark; raise the exposure')
    for panel_name, mean in zip(DIRECTIONS, means, strict=True):
        if mean < _DEAD * means.mean():
            raise PsError(code, f'{name}: panel {panel_name} gives no light, or its picture was '
                                'taken without it; check its cable and LEDs')
    if abs(together.mean() / means.sum() - 1) > 0.05:
        raise PsError(code, f'{name}: the picture with all panels on is not the sum of the '
                            'single ones; check exposure_scale and the panels, and that the '
                            'camera has no gamma and no automatic gain')
    return [*singles, together]


def require_linear(capture: Sequence[NDArray], name: str) -> None:
    """Refuse pictures of a camera whose grey values are not proportional to light.

    :param capture: as from light_only, of a target that was found.
    """
    exponent, deviation = response_exponent(capture[:4], capture[4])
    if abs(exponent - 1) > _NOT_LINEAR + 4 * deviation:
        raise PsError(ErrorCode.CALIBRATION_CAPTURE_FAILED,
                      f'{name or "pictures"}: grey values are not proportional to light, but to '
                      f'its power {exponent:.2f}; switch off gamma, contrast and automatic gain '
                      'of the camera')


def locate(captures: Sequence[Sequence[NDArray]], target: RingTarget,
           camera: CameraGeometry) -> tuple[NDArray, TargetPose]:
    """Dots in the mean of all pictures, and the pose; refuses pictures that moved."""
    found = np.array([[find_dots(picture, target, camera) for picture in capture]
                      for capture in captures])
    moved = np.linalg.norm(found - np.median(found, axis=(0, 1)), axis=-1).max(axis=-1)
    position, frame = np.unravel_index(moved.argmax(), moved.shape)
    if moved.max() > MOVED_PX:
        raise PsError(ErrorCode.CALIBRATION_CAPTURE_FAILED,
                      f'position {position + 1}: the target moved by {moved.max():.1f} px in '
                      f'frame {[*DIRECTIONS, "ALL"][frame]}; keep head and target still')
    total = np.sum([np.sum(capture[:4], axis=0) for capture in captures], axis=0)
    dots_px = find_dots(total, target, camera)
    return dots_px, fit_pose(dots_px, target, camera)


def require_labels(measured: Shares, predicted: NDArray) -> None:
    """Refuse pictures whose panel is another one than they say."""
    likeness = np.corrcoef(measured.values, predicted)[:4, 4:]
    for i, best in enumerate(likeness.argmax(axis=1)):
        if best != i:
            raise PsError(ErrorCode.CALIBRATION_CAPTURE_FAILED,
                          f'the picture of panel {DIRECTIONS[i]} shows the light of panel '
                          f'{DIRECTIONS[best]}; check the cables of the panels and how the '
                          'camera is turned')
