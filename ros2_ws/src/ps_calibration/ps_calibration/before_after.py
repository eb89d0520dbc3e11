"""What a calibration changes: one part, reconstructed as designed and as calibrated."""
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ps_calibration.ring_pictures import stated_tilt
from ps_head_driver.calibration_file import HeadCalibration, apply
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.head_model import HeadModel
from ps_head_driver.kinematics import BrightFieldKinematics, DarkFieldKinematics, as_light
from ps_head_driver.stack import Geometry, Mode, Panel, Plane, Stack, Truth, angular_error_deg
from ps_reconstruction.integration import remove_plane
from ps_reconstruction.pipeline import Options, reconstruct

_RELIEF = 5e-4           # m, of true relief that tells a height scale
_WINDOW_PX = 9           # noise is averaged over this many pixels each way


@dataclass(frozen=True)
class Outcome:
    """One reconstruction, and how far it is from the truth where that is known.

    :param height: (H, W) float32, m.
    :param bow: RMS of the height's error apart from a tilt, m; of the height itself, as if the
        part were flat, if the truth is not known.
    :param lean_deg: angle of the mean normal to the true one; to the measurement plane's if the
        truth is not known. Gloss bends a plate like a bowl, wrong lights make it lean.
    :param bias_deg: mean angle of the normals to the true ones, noise averaged out.
        NaN if that is unknown.
    :param worst_deg: the same, 99th percentile.
    :param height_scale: reconstructed over true height of the relief; NaN if it has none.
    """

    height: NDArray
    bow: float
    lean_deg: float
    bias_deg: float
    worst_deg: float
    height_scale: float


@dataclass(frozen=True)
class Comparison:
    """One part before and after the calibration, by least squares and by STV.

    Least squares shows the lights' errors pure; gloss bends its result, which STV stands better.

    :param pitch: distance of pixels on the plane, m.
    :param before, after: outcomes by the name of the method, 'ls' and 'stv'.
    :param truth: height in m, if known.
    """

    name: str
    pitch: float
    before: dict[str, Outcome]
    after: dict[str, Outcome]
    truth: NDArray | None


def relit(stack: Stack, head: HeadModel, calibration: HeadCalibration | None) -> Stack:
    """Frames of single panels, with the lights that a head so calibrated would report.

    :param stack: with motor counts, or axes that tell the panels' tilt.
    :param head: as designed.
    :param calibration: None for none.
    :raises PsError: CALIBRATION_BAD_REQUEST if no frame is lit by a single panel.
    """
    frames = stack.equations()
    if not frames.lights or any(light.distant for light in frames.lights):
        raise PsError(ErrorCode.CALIBRATION_BAD_REQUEST,
                      f'{stack.stack_id or "pictures"}: frames of single near panels are needed '
                      '(lights.yaml)')
    known = apply(head, calibration)
    bright, dark = BrightFieldKinematics(known), DarkFieldKinematics(known)
    lights = []
    for light in frames.lights:
        is_bright = light.mode == Mode.BRIGHT_FIELD
        angle = (float(bright.tilt(light.motor_counts)) if is_bright and light.motor_counts
                 else stated_tilt(light))
        panel = (bright if is_bright else dark).ring.pose(light.panel.name, angle)  # type: ignore
        now = as_light(panel)
        lights.append(replace(light, position=now.position, axis=now.axis, right=now.right,
                              size=now.size, lobe_exponent=now.lobe_exponent,
                              intensity=now.intensity))
    room = [image for image, light in zip(stack.images, stack.lights, strict=True)
            if light.panel == Panel.NONE]
    plane = Plane(calibration.plane_normal, calibration.plane_offset) if calibration else Plane()
    return replace(frames, lights=lights, plane=plane, gain_maps=[],
                   ambient=room[0] if room else stack.ambient,
                   geometry=Geometry.CALIBRATED if calibration else Geometry.NOMINAL)


def compare(name: str, stack: Stack, truth: Truth | None, head: HeadModel,
            calibration: HeadCalibration) -> Comparison:
    """Reconstruct a part with the lights as designed and as calibrated.

    :param stack: frames of single panels, with camera and motor counts.
    :param truth: of the part, if known.
    :param head: as designed.
    :raises PsError: CALIBRATION_BAD_REQUEST or RECONSTRUCTION_* naming what is wrong.
    """
    if stack.camera is None:
        raise PsError(ErrorCode.CALIBRATION_BAD_REQUEST,
                      f'{name}: the pictures have no camera (lights.yaml)')
    before, after = ({method: outcome(relit(stack, head, used), truth, method)
                      for method in ('ls', 'stv')} for used in (None, calibration))
    known = None
    if truth is not None and truth.height is not None:
        known = np.where(np.isfinite(after['ls'].height), truth.height, np.nan)
    return Comparison(name, stack.camera.camera_standoff / stack.camera.fx, before, after,
                      known)


def outcome(stack: Stack, truth: Truth | None, method: str = 'ls') -> Outcome:
    """Reconstruct a part by one method and compare it with the truth, if that is known.

    :param stack: as from relit.
    :param method: 'ls' or 'stv'.
    """
    made = reconstruct(stack, Options(method=method), {'normal', 'height'})
    assert made.height is not None
    known = truth.height if truth is not None and truth.height is not None else 0.0
    off = remove_plane(np.asarray(made.height - known, np.float32))
    mean, wanted = _mean(made.normal), np.asarray(stack.plane.normal)
    bias = worst = scale = float('nan')
    if truth is not None:
        error = angular_error_deg(_smooth(made.normal), _smooth(truth.normal))
        bias, worst = float(np.nanmean(error)), float(np.nanpercentile(error, 99))
        wanted = _mean(np.where(np.isfinite(made.normal), truth.normal, np.nan))
        if truth.height is not None:
            scale = _scale(made.height, truth.height)
    return Outcome(remove_plane(made.height), float(np.sqrt(np.nanmean(off**2))),
                   float(angular_error_deg(mean, wanted)), bias, worst, scale)


def _mean(normal: NDArray) -> NDArray:
    mean = np.nanmean(normal.reshape(-1, 3), axis=0, dtype=np.float64)
    return np.asarray(mean / np.linalg.norm(mean))


def _smooth(normal: NDArray) -> NDArray:
    blurred = cv2.blur(np.asarray(normal, np.float32), (_WINDOW_PX, _WINDOW_PX))
    return np.asarray(blurred / np.linalg.norm(blurred, axis=-1, keepdims=True))


def _scale(height: NDArray, truth: NDArray) -> float:
    """How much of the true relief is there: height fitted as its multiple on a bent ground."""
    known = np.isfinite(height) & np.isfinite(truth)
    if np.ptp(truth[known]) < _RELIEF:
        return float('nan')
    rows, columns = (axis / max(height.shape) - 0.5 for axis in np.nonzero(known))
    terms = np.stack([truth[known], np.ones(rows.size), rows, columns, rows**2, rows * columns,
                      columns**2], axis=1)
    return float(np.linalg.lstsq(terms, height[known], rcond=None)[0][0])
