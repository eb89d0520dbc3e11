"""Fitting the panels of a head to the pictures of a half ring (paper, section 2.3).

What is compared is each picture's share in the sum of the four: the reflectance of the plate,
vignetting and dots cancel out, and the panel-blurred shadows and the fall-off over the plate
remain. All motor positions, all panels and the target's pose are fitted together, with a robust
loss, starting from the kinematics. ring_problem.py says what is expected of the pictures.
"""
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult, least_squares

from ps_calibration.ring_problem import PER_PANEL, RingProblem, corrected
from ps_calibration.ring_target import RingTarget
from ps_calibration.shares import Shares
from ps_calibration.target_pose import TargetPose
from ps_head_driver.head_model import CameraGeometry, HeadModel

__all__ = ['PER_PANEL', 'RingFit', 'blocked_slits', 'corrected', 'fit_ring', 'predicted_shares']

_THIN = 6                # one block in so many gets the fit close
_CLOSE = 0.05            # heights of the wall, relative, between which one step is enough


@dataclass(frozen=True)
class RingFit:
    """Result of a fit.

    :param panels: (4, PER_PANEL) corrections on top of the head's own tolerances; intensities
        multiply.
    :param tilts: per position, rad, nominal plus the fitted error of the motor.
    :param pose: of the target.
    :param height: of the wall, m: fitted or as given.
    :param height_deviation: its standard deviation, 0 if it was given.
    :param softness: of the pictures: variance of their blur over that of the blocks.
    :param residuals: per position (4, N) measured minus predicted share.
    :param edge_px: per position (4,) what the residuals amount to as a shift of the shadow edges.
    :param scatter: of the residuals relative to the noise expected, robust, at least 1.
    :param deviation: (4, PER_PANEL) standard deviations from the covariance.
    :param pose_deviation: (SIZE,) the same of the pose.
    :param covariance: (4 PER_PANEL + SIZE,) squared, of all of these, panels first.
    :param condition: of the fit, largest over smallest singular value, every parameter in units
        of its deviation if it were the only one; without the four panels' common intensity, which
        no picture tells.
    """

    panels: NDArray
    tilts: list[float]
    pose: TargetPose
    height: float
    height_deviation: float
    softness: float
    residuals: list[NDArray]
    edge_px: list[NDArray]
    scatter: float
    deviation: NDArray
    pose_deviation: NDArray
    covariance: NDArray
    condition: float


def fit_ring(head: HeadModel, target: RingTarget, camera: CameraGeometry,
             shares: Sequence[Shares], dots_px: NDArray, pose: TargetPose,
             start: RingFit | None = None, free_height: bool = False) -> RingFit:
    """Fit panels and target to the shares of all motor positions.

    :param head: as designed, or as calibrated before.
    :param camera: for pictures of this size.
    :param shares: one per motor position, as from measure_shares.
    :param dots_px: (F, 2) dots in the pictures.
    :param pose: of the target, to start from.
    :param start: an earlier fit to start from instead.
    :param free_height: fit the height of the wall, too: a check of the scale of z.
    """
    thin = [share.thinned(_THIN) for share in shares]
    problem = RingProblem(head, target, camera, thin, dots_px, free_height)
    if start is None:
        x = problem.start(np.zeros((4, PER_PANEL)), pose, [share.tilt for share in shares])
    else:
        x = problem.start(start.panels, start.pose, start.tilts, start.softness)
        problem.learn_blur(x)
    fit = _solve(problem, x)
    if free_height:
        found = _summary(problem, fit.x, fit.jac)
        near = start is not None and abs(found.height / target.height - 1) < _CLOSE
        return _whole_height(found, head, target, camera, shares, dots_px) if near else found
    # what remains tells how far to trust the shadows and the rest
    problem = RingProblem(head, target, camera, [
        share.reweighed(difference)
        for share, difference in zip(shares, problem.differences(fit.x), strict=True)], dots_px)
    problem.learn_blur(fit.x)
    fit = _solve(problem, fit.x)
    return _summary(problem, fit.x, fit.jac)


def _whole_height(found: RingFit, head: HeadModel, target: RingTarget, camera: CameraGeometry,
                  shares: Sequence[Shares], dots_px: NDArray) -> RingFit:
    """A fit with a free wall height, the height improved by one step with all the blocks."""
    problem = RingProblem(head, target, camera, shares, dots_px, free_height=True)
    x = problem.start(found.panels, found.pose, found.tilts, found.softness)
    x[-1] = found.height
    problem.learn_blur(x)
    jacobian = problem.jacobian(x)
    inverse = np.linalg.pinv(jacobian.T @ jacobian)
    step = -inverse @ jacobian.T @ problem.residuals(x)
    return replace(found, height=found.height + float(step[-1]),
                   height_deviation=found.scatter * float(np.sqrt(inverse[-1, -1])))


def _solve(problem: RingProblem, x: NDArray) -> OptimizeResult:
    return least_squares(problem.residuals, x, problem.jacobian, method='lm', max_nfev=20,
                         x_scale=10 * problem.scale, xtol=1e-8, ftol=1e-6)


def _summary(problem: RingProblem, x: NDArray, jacobian: NDArray) -> RingFit:
    residuals = problem.differences(x)
    normalised = np.concatenate([(r / share.noise).ravel()
                                 for r, share in zip(residuals, problem.shares, strict=True)])
    scatter = max(1.4826 * float(np.median(abs(normalised))), 1.0)
    # a wall that is not there leaves its height undetermined
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * scatter**2
    deviation = np.sqrt(np.diag(covariance))
    metres_per_pixel = problem.camera.camera_standoff / problem.camera.fx
    edge_px, first = [], 0
    for r, share in zip(residuals, problem.shares, strict=True):
        last = first + r.size
        moved_x, moved_y = (jacobian[first:last, 4 * PER_PANEL + k].reshape(r.shape) * share.noise
                            for k in range(2))
        steep = np.hypot(moved_x, moved_y)
        edges = steep > 0.3 * steep.max(axis=1, keepdims=True)
        edge_px.append(np.sqrt(np.sum(r**2 * edges, axis=1) / np.sum(steep**2 * edges, axis=1))
                       / metres_per_pixel)
        first = last
    panels = x[:4 * PER_PANEL].reshape(4, PER_PANEL).copy()
    lengths = np.linalg.norm(jacobian, axis=0)
    scaled = jacobian / np.maximum(lengths, 1e-300)
    strengths = np.sqrt(np.linalg.eigvalsh(scaled.T @ scaled)[::-1].clip(min=1e-30))
    return RingFit(panels, [problem.tilt(x, k) for k in range(len(residuals))], problem.pose(x),
                   problem.height(x), float(deviation[-1]) if problem.free_height else 0.0,
                   float(x[problem.softness]), residuals, edge_px, scatter,
                   deviation[:4 * PER_PANEL].reshape(4, PER_PANEL),
                   deviation[4 * PER_PANEL:problem.first_tilt],
                   covariance[:problem.first_tilt, :problem.first_tilt],
                   float(strengths[0] / strengths[-2]))


def predicted_shares(head: HeadModel, target: RingTarget, camera: CameraGeometry,
                     shares: Shares, pose: TargetPose) -> NDArray:
    """Shares of light of a head as it is, for the blocks of ``shares``, (4, N)."""
    problem = RingProblem(head, target, camera, [shares], np.zeros((0, 2)))
    return problem.predicted(problem.start(np.zeros((4, PER_PANEL)), pose, [shares.tilt]))[0]


def blocked_slits(fit: RingFit, head: HeadModel, target: RingTarget, camera: CameraGeometry,
                  shares: Sequence[Shares]) -> NDArray:
    """How far each slit is closed: 0 is open, 1 is blocked, (S,) float64.

    The residuals are compared with the change that filling the slit would make.
    """
    def predicted(target: RingTarget) -> list[NDArray]:
        problem = RingProblem(head, target, camera, shares, np.zeros((0, 2)))
        return problem.predicted(problem.start(fit.panels, fit.pose, fit.tilts))

    open_shares, residual = predicted(target), np.concatenate([r.ravel() for r in fit.residuals])
    azimuths, found = target.slits.azimuths, []
    for k in range(len(azimuths)):
        slits = target.slits.model_copy(update={'azimuths': azimuths[:k] + azimuths[k + 1:]})
        filled = predicted(target.model_copy(update={'slits': slits}))
        change = np.concatenate([(after - before).ravel()
                                 for after, before in zip(filled, open_shares, strict=True)])
        found.append(residual @ change / (change @ change))
    return np.array(found)
