"""From pictures of the half ring to a calibration: the steps, and when not to believe them."""
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
import importlib.metadata
from itertools import pairwise
import math
import time

import numpy as np
from numpy.typing import NDArray

from ps_calibration.detection import find_dots
from ps_calibration.ring_fit import (
    RingFit,
    Shares,
    blocked_slits,
    corrected,
    fit_ring,
    measure_shares,
    predicted_shares,
)
from ps_calibration.ring_target import RingTarget
from ps_calibration.target_pose import TargetPose, camera_to_plane, fit_pose
from ps_head_driver.calibration_file import HeadCalibration, PanelCorrection, new_calibration_id
from ps_head_driver.camera_model import scaled_camera
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.head_model import DIRECTIONS, CameraGeometry, HeadModel
from ps_head_driver.kinematics import BrightFieldKinematics, PanelPose
from ps_head_driver.stack import Mode, Panel, Stack

_SATURATED = 0.002       # part of the pixels at the end of the range
_DARK = 0.05             # mean of a picture, relative to the end of its range
_DEAD = 0.3              # of the mean of the four panels
_MOVED_PX = 0.3          # of a dot, between two pictures
_FAILED_RMS, _POOR_RMS = 0.02, 0.006     # of the shares of light
_UNLIKELY = 1.7          # corrections, relative to the tolerances they were given
_Z_SCALE = 0.03          # of the wall's height, before the target is doubted
_NO_WALL = 0.4           # of the wall's height, below which there is none
_BLOCKED = 0.5           # of a slit
_LIMIT = np.array([0.006, 0.006, 0.006, 0.07, 0.07, 0.25])


@dataclass(frozen=True)
class Calibration:
    """What came out, and how far to trust it.

    :param verdict: OK, POOR or FAILED.
    :param reason: of a verdict that is not OK, and what to do.
    :param fit: None if it failed before the fit.
    :param z_scale: known height of the wall over the one fitted.
    """

    verdict: str
    reason: str
    camera: CameraGeometry
    fit: RingFit | None = None
    z_scale: float = 1.0
    timings_s: dict[str, float] = field(default_factory=dict)

    def panels(self, head: HeadModel) -> list[list[PanelPose]]:
        """Fitted poses of E, N, W, S per motor position, intensities with a mean of 1."""
        if self.fit is None:
            return []
        ring = BrightFieldKinematics(corrected(head, self.fit.panels)).ring
        return [[ring.pose(name, tilt) for name in DIRECTIONS]  # type: ignore[arg-type]
                for tilt in self.fit.tilts]

    def camera_to_plane(self) -> NDArray | None:
        """Homography from undistorted pixels to the plane, see target_pose."""
        return None if self.fit is None else camera_to_plane(self.fit.pose.plane, self.camera)


def calibrate(stacks: Sequence[Stack], target: RingTarget, head: HeadModel) -> Calibration:
    """Calibrate the bright-field panels of a head.

    :param stacks: one per motor position, frames E, N, W, S, ALL, NONE in any order, 8 to 16 bit;
        motor_counts in every light (without, its axis tells the tilt), exposure_scale used.
    :param head: as designed.
    :returns: a FAILED verdict if the pictures do not allow a calibration.
    :raises PsError: CALIBRATION_BAD_REQUEST if frames or the camera are missing.
    """
    camera = _common_camera(stacks, head)
    clock = {'start': time.perf_counter()}
    try:
        captures = [_light_only(stack) for stack in stacks]
        dots_px, pose = _locate(captures, target, camera)
        clock['detect'] = time.perf_counter()
        kinematics = BrightFieldKinematics(head)
        shares = [measure_shares(capture[:4], _nominal_tilt(stack, kinematics), pose, target,
                                 camera)
                  for capture, stack in zip(captures, stacks, strict=True)]
        for position in shares:
            _require_labels(position, predicted_shares(head, target, camera, position, pose))
        fit = fit_ring(head, target, camera, shares, dots_px, pose)
        clock['fit'] = time.perf_counter()
        free = fit_ring(head, target, camera, shares, dots_px, pose, fit, free_height=True)
        clock['z_scale'] = time.perf_counter()
    except PsError as error:
        if error.code not in (ErrorCode.CALIBRATION_TARGET_NOT_FOUND,
                              ErrorCode.CALIBRATION_CAPTURE_FAILED):
            raise
        return Calibration('FAILED', error.message, camera)
    z_scale = target.height / max(free.height, 1e-2 * target.height)
    blocked = blocked_slits(fit, head, target, camera, shares)
    verdict, reason = _judge(fit, free, target, blocked)
    names = list(clock)
    timings = {name: clock[name] - clock[before]
               for before, name in pairwise(names)}
    return Calibration(verdict, reason, camera, fit, z_scale, timings)


def head_calibration(result: Calibration, head: HeadModel, target: RingTarget,
                     head_serial: str = '') -> HeadCalibration:
    """What is written to a file.

    :raises PsError: CALIBRATION_POOR_FIT with the reason if the calibration failed.
    """
    if result.fit is None or result.verdict == 'FAILED':
        raise PsError(ErrorCode.CALIBRATION_POOR_FIT, result.reason)
    panels = result.panels(head)[0]
    mean = np.mean([panel.intensity for panel in panels])
    corrections = {}
    for i, name in enumerate(DIRECTIONS):
        p = result.fit.panels[i]
        corrections[f'BF_{name}'] = PanelCorrection(
            shift=(float(p[0]), float(p[1]), float(p[2])), tilt_offset=float(p[3]),
            twist=float(p[4]), intensity=float(np.exp(p[5]) / mean),
            shadow_residual_px=float(np.mean([edge[i] for edge in result.fit.edge_px])))
    created = datetime.now(UTC)
    plane = result.fit.pose.plane
    return HeadCalibration.model_validate({
        'calibration_id': new_calibration_id(head_serial, created), 'created': created,
        'head_serial': head_serial, 'camera': result.camera, 'plane_normal': plane.normal,
        'plane_offset': plane.offset, 'panels': corrections, 'z_scale': result.z_scale,
        'verdict': result.verdict, 'verdict_reason': result.reason, 'target_name': target.name,
        'software_version': _version()})


def _version() -> str:
    try:
        return importlib.metadata.version('ps_calibration')
    except importlib.metadata.PackageNotFoundError:
        return ''


def _common_camera(stacks: Sequence[Stack], head: HeadModel) -> CameraGeometry:
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


def _nominal_tilt(stack: Stack, kinematics: BrightFieldKinematics) -> float:
    """From the motor counts; where the pictures state none, from the lights' own axes, rad."""
    light = next(light for light in stack.lights
                 if light.panel == Panel.E and light.mode == Mode.BRIGHT_FIELD)
    if light.motor_counts:
        return float(kinematics.tilt(light.motor_counts))
    return math.acos(min(max(-light.axis[2], -1.0), 1.0))


def _range_of(images: Sequence[NDArray]) -> float:
    """End of the grey values' range; cameras deliver 10, 12 or 14 bit in words of 16."""
    if not np.issubdtype(images[0].dtype, np.integer):
        return math.inf
    if images[0].dtype == np.uint8:
        return 255.0
    highest = max(int(image.max()) for image in images)
    return float(next(2**bits - 1 for bits in (10, 12, 14, 16) if highest < 2**bits))


def _frame(stack: Stack, panel: Panel) -> tuple[NDArray, float]:
    """One frame and its exposure."""
    for image, light in zip(stack.images, stack.lights, strict=True):
        if light.panel == panel and light.mode == Mode.BRIGHT_FIELD:
            return image, light.exposure_scale
    if panel == Panel.NONE and stack.ambient is not None:
        return stack.ambient, 1.0
    raise PsError(ErrorCode.CALIBRATION_BAD_REQUEST,
                  f'{stack.stack_id or "the pictures"}: frame {panel.name} is missing; a ring '
                  'calibration needs E, N, W, S, ALL and NONE')


def _light_only(stack: Stack) -> list[NDArray]:
    """E, N, W, S at equal exposure, without the light of the room.

    :raises PsError: CALIBRATION_CAPTURE_FAILED for pictures that cannot be used.
    """
    code, name = ErrorCode.CALIBRATION_CAPTURE_FAILED, stack.stack_id or 'pictures'
    dark, dark_scale = _frame(stack, Panel.NONE)
    full = _range_of(stack.images)
    frames = []
    for panel in (Panel.E, Panel.N, Panel.W, Panel.S, Panel.ALL):
        image, scale = _frame(stack, panel)
        if np.mean(image >= full) > _SATURATED:
            raise PsError(code, f'{name}: frame {panel.name} is saturated; lower its exposure')
        # the room shines for as long as the shutter is open
        grey = image.astype(np.float32) / scale - dark.astype(np.float32) / dark_scale
        frames.append(grey.mean(axis=-1) if grey.ndim == 3 else grey)
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
                            'single ones; check exposure_scale and the panels')
    return [*singles, together]


def _locate(captures: Sequence[Sequence[NDArray]], target: RingTarget,
            camera: CameraGeometry) -> tuple[NDArray, TargetPose]:
    """Dots in the mean of all pictures, and the pose; refuses pictures that moved."""
    found = np.array([[find_dots(picture, target, camera) for picture in capture]
                      for capture in captures])
    moved = np.linalg.norm(found - np.median(found, axis=(0, 1)), axis=-1).max(axis=-1)
    position, frame = np.unravel_index(moved.argmax(), moved.shape)
    if moved.max() > _MOVED_PX:
        raise PsError(ErrorCode.CALIBRATION_CAPTURE_FAILED,
                      f'position {position + 1}: the target moved by {moved.max():.1f} px in '
                      f'frame {[*DIRECTIONS, "ALL"][frame]}; keep head and target still')
    total = np.sum([np.sum(capture[:4], axis=0) for capture in captures], axis=0)
    dots_px = find_dots(total, target, camera)
    return dots_px, fit_pose(dots_px, target, camera)


def _require_labels(measured: Shares, predicted: NDArray) -> None:
    """Refuse pictures whose panel is another one than they say."""
    likeness = np.corrcoef(measured.values, predicted)[:4, 4:]
    for i, best in enumerate(likeness.argmax(axis=1)):
        if best != i:
            raise PsError(ErrorCode.CALIBRATION_CAPTURE_FAILED,
                          f'the picture of panel {DIRECTIONS[i]} shows the light of panel '
                          f'{DIRECTIONS[best]}; check the cables of the panels and how the '
                          'camera is turned')


def _rms(fit: RingFit) -> float:
    return max(float(np.sqrt(np.mean(r**2))) for r in fit.residuals)


def _judge(fit: RingFit, free: RingFit, target: RingTarget, blocked: NDArray) -> tuple[str, str]:
    """The most specific reason that the fits give.

    :param free: the fit with a free height of the wall.
    :param blocked: of each slit, see blocked_slits.
    """
    rms, height = _rms(fit), free.height / target.height
    if height < _NO_WALL:
        return 'FAILED', ('no shadows of the wall are seen; is the half ring missing from its '
                          'plate, or a lower one?')
    if blocked.max() > _BLOCKED and rms < _FAILED_RMS:
        azimuth = math.degrees(target.slits.azimuths[int(blocked.argmax())])
        return 'FAILED', (f'the slit at {azimuth:.0f} degrees lets no light through; clean it, or '
                          'check the target file')
    if abs(height - 1) > _Z_SCALE and _rms(free) < max(0.8 * rms, _POOR_RMS):
        return ('FAILED' if rms > _FAILED_RMS else 'POOR'), (
            f'the wall seems to be {"higher" if height > 1 else "lower"} than the target file '
            f'says (fitted {1e3 * free.height:.2f} mm); is it the right target and file?')
    if rms > _FAILED_RMS:
        return 'FAILED', (f'the shadows do not fit this target (residual {rms:.3f}); is it '
                          'another ring than the target file says, or damaged?')
    beyond = abs(fit.panels) > _LIMIT * _UNLIKELY
    if beyond.any():
        name = DIRECTIONS[int(np.argmax(beyond.any(axis=1)))]
        return 'FAILED', (f'panel {name} would be far out of its place; is it another ring than '
                          'the target file says? if not, check the mounting of the panel')
    if rms > _POOR_RMS:
        return 'POOR', (f'the shadows fit badly (residual {rms:.3f}); clean the target and keep '
                        'other light away')
    return 'OK', ''
