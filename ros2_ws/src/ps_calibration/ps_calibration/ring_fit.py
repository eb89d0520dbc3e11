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

from ps_calibration.gauss_newton import NormalEquations, minimise
from ps_calibration.ring_problem import PER_PANEL, RingProblem, corrected
from ps_calibration.ring_target import RingTarget
from ps_calibration.shares import Shares
from ps_calibration.target_pose import SIZE, TargetPose
from ps_head_driver.head_model import CameraGeometry, HeadModel

__all__ = ['PER_PANEL', 'RingFit', 'blocked_slits', 'corrected', 'fit_ring', 'free_height',
           'predicted_shares']

_THIN = 6                # one block in so many gets the fit close
_CLOSE = 0.02            # of the wall's height: up to there one step finds a free one


@dataclass(frozen=True)
class RingFit:
    """Result of a fit.

    :param panels: (4, PER_PANEL) corrections on top of the head's own tolerances; intensities
        multiply.
    :param tilts: per position, rad, nominal plus the fitted error of the motor.
    :param pose: of the target.
    :param height: of the wall, m: as given, or fitted, see free_height.
    :param height_deviation: its standard deviation, 0 if it was given.
    :param softness: of the pictures: variance of their blur over that of the blocks.
    :param glow: light that the wall throws onto the plate, over what its reflectance in the
        target file says.
    :param residuals: per position (4, N) measured minus predicted share.
    :param edge_px: per position (4,) what the residuals amount to as a shift of the shadow edges.
    :param scatter: of the residuals relative to the noise expected, robust, at least 1.
    :param covariance: (4 PER_PANEL + SIZE,) squared, of panels and pose.
    :param condition: of the fit, largest over smallest singular value, every parameter in units
        of its deviation if it were the only one; without the four panels' common intensity, which
        no picture tells.
    :param equations: at the end of the fit, by all parameters of RingProblem.
    """

    panels: NDArray
    tilts: list[float]
    pose: TargetPose
    height: float
    height_deviation: float
    softness: float
    glow: float
    residuals: list[NDArray]
    edge_px: list[NDArray]
    scatter: float
    covariance: NDArray
    condition: float
    equations: NormalEquations

    @property
    def deviation(self) -> NDArray:
        """Standard deviations of the panels' corrections, (4, PER_PANEL)."""
        own = np.diag(self.covariance)[:4 * PER_PANEL]
        return np.sqrt(own).reshape(4, PER_PANEL)


    @property
    def tilt_deviation(self) -> NDArray:
        """Standard deviations of the tilts, rad; 0 of the first, which all others refer to."""
        first = 4 * PER_PANEL + SIZE
        own = np.diag(self.equations.first(-1).covariance())[first:first + len(self.tilts) - 1]
        return np.concatenate([[0.0], self.scatter * np.sqrt(own)])


def fit_ring(head: HeadModel, target: RingTarget, camera: CameraGeometry,
             shares: Sequence[Shares], dots_px: NDArray, pose: TargetPose) -> RingFit:
    """Fit panels and target to the shares of all motor positions.

    :param head: as designed, or as calibrated before.
    :param camera: for pictures of this size.
    :param shares: one per motor position, as from measure_shares.
    :param dots_px: (F, 2) dots in the pictures.
    :param pose: of the target, to start from.
    """
    thin = RingProblem(head, target, camera, _thinned(shares), dots_px)
    x = thin.start(np.zeros((4, PER_PANEL)), pose, [share.tilt for share in shares])
    thin.learn_glow(x)
    x, _ = minimise(thin.equations, x, thin.size - 1)
    # what remains tells how far to trust the shadows and the rest
    problem = RingProblem(head, target, camera, [
        share.reweighed(difference)
        for share, difference in zip(shares, thin.differences(x), strict=True)], dots_px)
    problem.learn_blur(x)
    problem.learn_glow(x)
    return _summary(problem, *minimise(problem.equations, x, problem.size - 1))


def free_height(fit: RingFit, head: HeadModel, target: RingTarget, camera: CameraGeometry,
                shares: Sequence[Shares], dots_px: NDArray) -> RingFit:
    """The same fit with a free height of the wall: a check of the scale of z.

    :param fit: of all the other arguments. If the height hardly changes, only the height and its
        deviation are new.
    """
    change = float(fit.equations.step()[-1])
    if abs(change) < _CLOSE * target.height:
        return replace(fit, height=fit.height + change, height_deviation=fit.scatter * float(
            np.sqrt(fit.equations.covariance()[-1, -1])))
    thin = RingProblem(head, target, camera, _thinned(shares), dots_px)
    x = thin.start(fit.panels, fit.pose, fit.tilts, fit.softness, fit.glow)
    thin.learn_blur(x)
    thin.learn_glow(x)
    x, equations = minimise(thin.equations, x)
    found = _summary(thin, x, equations)
    return replace(found, height_deviation=found.scatter * float(
        np.sqrt(equations.covariance()[-1, -1])))


def _thinned(shares: Sequence[Shares]) -> list[Shares]:
    return [share.thinned(_THIN) for share in shares]


def _summary(problem: RingProblem, x: NDArray, equations: NormalEquations) -> RingFit:
    """With the height of the wall as known."""
    residuals, edge_px = [], []
    metres_per_pixel = problem.camera.camera_standoff / problem.camera.fx
    for k, share in enumerate(problem.shares):
        predicted, rates = problem.predicted_and_rates(x, k)
        left = share.values - predicted
        steep = np.hypot(*rates[4 * PER_PANEL:4 * PER_PANEL + 2])
        edges = steep > 0.3 * steep.max(axis=1, keepdims=True)
        edge_px.append(np.sqrt(np.sum(left**2 * edges, axis=1) / np.sum(steep**2 * edges, axis=1))
                       / metres_per_pixel)
        residuals.append(left)
    normalised = np.concatenate([(left / share.noise).ravel()
                                 for left, share in zip(residuals, problem.shares, strict=True)])
    scatter = max(1.4826 * float(np.median(abs(normalised))), 1.0)
    known = equations.first(problem.size - 1)
    strengths = np.sqrt(np.linalg.eigvalsh(known.correlation())[::-1].clip(min=1e-30))
    return RingFit(x[:4 * PER_PANEL].reshape(4, PER_PANEL).copy(),
                   [problem.tilt(x, k) for k in range(len(residuals))], problem.pose(x),
                   float(x[-1]), 0.0, float(x[problem.softness]), max(float(x[problem.glow]), 0.0),
                   residuals, edge_px, scatter,
                   known.covariance()[:problem.first_tilt, :problem.first_tilt] * scatter**2,
                   float(strengths[0] / strengths[-2]), equations)


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
    shares = _thinned(shares)
    left = np.concatenate([r[:, ::_THIN].ravel() for r in fit.residuals])

    def predicted(target: RingTarget) -> list[NDArray]:
        problem = RingProblem(head, target, camera, shares, np.zeros((0, 2)))
        return problem.predicted(problem.start(fit.panels, fit.pose, fit.tilts))

    open_shares, azimuths, found = predicted(target), target.slits.azimuths, []
    for k in range(len(azimuths)):
        slits = target.slits.model_copy(update={'azimuths': azimuths[:k] + azimuths[k + 1:]})
        filled = predicted(target.model_copy(update={'slits': slits}))
        change = np.concatenate([(after - before).ravel()
                                 for after, before in zip(filled, open_shares, strict=True)])
        size = change @ change      # 0 if no pixel sees the slit's light
        found.append(left @ change / size if size > 0 else 0.0)
    return np.array(found)
