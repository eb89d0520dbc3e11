"""From pictures of the half ring to a calibration: the steps. verdict.py judges the outcome."""
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
import importlib.metadata
from itertools import pairwise
import math
import time

import numpy as np
from numpy.typing import NDArray

from ps_calibration.dark_field import NOT_REACHED, DarkField, calibrate_dark_field
from ps_calibration.ring_fit import (
    RingFit,
    blocked_slits,
    corrected,
    fit_ring,
    free_height,
    predicted_shares,
)
from ps_calibration.ring_pictures import (
    common_camera,
    light_only,
    locate,
    nominal_tilt,
    require_labels,
    require_linear,
)
from ps_calibration.ring_target import RingTarget
from ps_calibration.shares import Shares, measure_shares
from ps_calibration.target_pose import camera_to_plane
from ps_calibration.verdict import judge
from ps_head_driver.calibration_file import (
    DarkFieldPanel,
    DarkFieldRecord,
    HeadCalibration,
    PanelCorrection,
    new_calibration_id,
)
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.head_model import DIRECTIONS, CameraGeometry, HeadModel
from ps_head_driver.kinematics import BrightFieldKinematics, PanelPose
from ps_head_driver.stack import Stack


@dataclass(frozen=True)
class Calibration:
    """What came out, and how far to trust it.

    :param verdict: OK, POOR or FAILED.
    :param reason: of a verdict that is not OK, and what to do.
    :param fit: None if it failed before the fit.
    :param z_scale: known height of the wall over the one fitted.
    :param z_scale_deviation: standard deviation of it that noise makes.
    :param shares: what was fitted, per motor position.
    :param dark: of the dark-field panels, judged apart: verdict and reason are not about them.
    """

    verdict: str
    reason: str
    camera: CameraGeometry
    fit: RingFit | None = None
    z_scale: float = 1.0
    z_scale_deviation: float = 0.0
    timings_s: dict[str, float] = field(default_factory=dict)
    shares: list[Shares] = field(default_factory=list)
    dark: DarkField = NOT_REACHED

    @property
    def full_reason(self) -> str:
        """Of both fields: what is not as it should be."""
        dark = self.dark.reason if self.dark.verdict in ('POOR', 'FAILED') else ''
        return '; '.join(filter(None, (self.reason, dark)))

    def panels(self, head: HeadModel) -> list[list[PanelPose]]:
        """Fitted poses of E, N, W, S per motor position, intensities with a mean of 1."""
        if self.fit is None:
            return []
        ring = BrightFieldKinematics(corrected(head, self.fit.panels)).ring
        return [ring.poses(tilt) for tilt in self.fit.tilts]

    def camera_to_plane(self) -> NDArray | None:
        """Homography from undistorted pixels to the plane, see target_pose."""
        return None if self.fit is None else camera_to_plane(self.fit.pose.plane, self.camera)


def calibrate(stacks: Sequence[Stack], target: RingTarget, head: HeadModel) -> Calibration:
    """Calibrate the panels of a head.

    :param stacks: one per motor position, frames E, N, W, S, ALL, NONE in any order, 8 to 16 bit;
        motor_counts in every light (without, its axis tells the tilt), exposure_scale used. The
        first one with frames of mode DARK_FIELD and panel E, N, W or S calibrates these, too.
    :param head: as designed.
    :returns: a FAILED verdict if the pictures do not allow a calibration.
    :raises PsError: CALIBRATION_BAD_REQUEST if frames or the camera are missing.
    """
    camera = common_camera(stacks, head)
    clock = {'start': time.perf_counter()}
    try:
        captures = [light_only(stack) for stack in stacks]
        dots_px, pose = locate(captures, target, camera)
        for stack, capture in zip(stacks, captures, strict=True):
            require_linear(capture, stack.stack_id)
        clock['detect'] = time.perf_counter()
        kinematics = BrightFieldKinematics(head)
        shares = [measure_shares(capture[:4], nominal_tilt(stack, kinematics), pose, target,
                                 camera)
                  for capture, stack in zip(captures, stacks, strict=True)]
        for position in shares:
            require_labels(position, predicted_shares(head, target, camera, position, pose))
        fit = fit_ring(head, target, camera, shares, dots_px, pose)
        clock['fit'] = time.perf_counter()
        free = free_height(fit, head, target, camera, shares, dots_px)
        clock['z_scale'] = time.perf_counter()
    except PsError as error:
        if error.code not in (ErrorCode.CALIBRATION_TARGET_NOT_FOUND,
                              ErrorCode.CALIBRATION_CAPTURE_FAILED):
            raise
        return Calibration('FAILED', error.message, camera)
    z_scale = target.height / max(free.height, 1e-2 * target.height)
    blocked = blocked_slits(fit, head, target, camera, shares)
    verdict, reason = judge(fit, free, target, blocked)
    dark = NOT_REACHED
    if verdict != 'FAILED':
        dark = calibrate_dark_field(stacks, captures, fit, dots_px, head, target, camera)
        clock['dark_field'] = time.perf_counter()
    names = list(clock)
    timings = {name: clock[name] - clock[before]
               for before, name in pairwise(names)}
    deviation = z_scale * free.height_deviation / max(free.height, 1e-2 * target.height)
    return Calibration(verdict, reason, camera, fit, z_scale, deviation, timings, shares, dark)


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
        corrections[f'BF_{name}'] = _correction(
            result.fit.panels[i], math.log(mean),
            float(np.mean([edge[i] for edge in result.fit.edge_px])))
    for name, dark in zip(DIRECTIONS, result.dark.panels, strict=False):
        if dark.calibrated:
            corrections[f'DF_{name}'] = _correction(dark.correction, 0.0, dark.edge_px)
    created = datetime.now(UTC)
    plane = result.fit.pose.plane
    return HeadCalibration.model_validate({
        'calibration_id': new_calibration_id(head_serial, created), 'created': created,
        'head_serial': head_serial, 'camera': result.camera, 'plane_normal': plane.normal,
        'plane_offset': plane.offset, 'panels': corrections, 'z_scale': result.z_scale,
        'dark_field': _record(result.dark),
        'verdict': result.verdict, 'verdict_reason': result.full_reason,
        'target_name': target.name, 'software_version': _version()})


def _correction(p: NDArray, usual: float, edge_px: float) -> PanelCorrection:
    """From the numbers of a fit; ``usual`` is the logarithm of the intensity that is called 1."""
    return PanelCorrection(
        shift=(float(p[0]), float(p[1]), float(p[2])), tilt_offset=float(p[3]), twist=float(p[4]),
        intensity=math.exp(p[5] - usual), shadow_residual_px=edge_px)


def _record(dark: DarkField) -> DarkFieldRecord:
    panels = {name: DarkFieldPanel(source=panel.source, deviation=tuple(  # type: ignore
        float(deviation) if seen else None
        for deviation, seen in zip(panel.deviation, panel.seen, strict=True)))
        for name, panel in zip(DIRECTIONS, dark.panels, strict=False)}
    return DarkFieldRecord.model_validate({
        'verdict': dark.verdict, 'reason': dark.reason, 'panels': panels,
        'tilt': dark.tilt if math.isfinite(dark.tilt) else None})


def _version() -> str:
    try:
        return importlib.metadata.version('ps_calibration')
    except importlib.metadata.PackageNotFoundError:
        return ''
