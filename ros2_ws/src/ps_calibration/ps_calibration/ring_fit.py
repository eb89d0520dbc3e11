"""Fitting the panels of a head to the pictures of a half ring (paper, section 2.3).

What is compared is each picture's share in the sum of the four: the reflectance of the plate,
vignetting and dots cancel out, and the panel-blurred shadows and the fall-off over the plate
remain. All motor positions, all panels and the target's pose are fitted together, with a robust
loss, starting from the kinematics.
"""
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
import math

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult, least_squares

from ps_calibration.ring_target import RingTarget
from ps_calibration.robust import soft
from ps_calibration.shadow_model import light_and_rates, plate_irradiance
from ps_calibration.shares import Shares
from ps_calibration.target_pose import SIZE, TargetPose, dot_errors
from ps_head_driver.camera_model import plane_points
from ps_head_driver.head_model import DIRECTIONS, CameraGeometry, HeadModel
from ps_head_driver.kinematics import PanelPose, PanelRing

# parameters of one panel: shift (radial, tangential, z), tilt_offset, twist, log of intensity
PER_PANEL = 6
# what is known of them beforehand: three times the tolerances of manufacture
_PRIOR = np.array([0.009, 0.009, 0.009, 0.105, 0.105, 0.15])
_TILT_PRIOR = 0.03                       # rad, error of the motor between two positions
# typical sizes of the parameters
_STEPS = np.array([1e-4, 1e-4, 1e-4, 1e-3, 1e-3, 1e-3])
_POSE_STEPS = np.array([1e-5, 1e-5, 1e-5, 1e-3, 5e-4, 5e-4])
_HEIGHT_STEP, _TILT_STEP = 2e-5, 1e-3
_POINT_STEP = 1e-5                       # m
_DOT_NOISE_PX = 0.003
_THIN = 6                # one block in so many gets the fit close
_SOFT = 3.0              # standard deviations from which on a residual counts less


@dataclass(frozen=True)
class RingFit:
    """Result of a fit.

    :param panels: (4, PER_PANEL) corrections on top of the head's own tolerances; intensities
        multiply.
    :param tilts: per position, rad, nominal plus the fitted error of the motor.
    :param pose: of the target.
    :param height: of the wall, m: fitted or as given.
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
    residuals: list[NDArray]
    edge_px: list[NDArray]
    scatter: float
    deviation: NDArray
    pose_deviation: NDArray
    covariance: NDArray
    condition: float


def corrected(head: HeadModel, panels: NDArray) -> HeadModel:
    """The head with corrections (4, PER_PANEL) added to its bright-field panels."""
    ring = {}
    for name, p in zip(DIRECTIONS, panels, strict=True):
        old = head.bright_field.panels[name]  # type: ignore[index]
        ring[name] = old.model_copy(update={
            'shift': (old.shift[0] + p[0], old.shift[1] + p[1], old.shift[2] + p[2]),
            'tilt_offset': old.tilt_offset + p[3], 'twist': old.twist + p[4],
            'intensity': old.intensity * float(np.exp(p[5]))})
    return head.model_copy(
        update={'bright_field': head.bright_field.model_copy(update={'panels': ring})})


class _Problem:
    """Residuals and their derivatives as functions of all parameters.

    Order: 4 x PER_PANEL, pose, error of the motor at the second position on, then the wall's
    height if it is free.
    """

    def __init__(self, head: HeadModel, target: RingTarget, camera: CameraGeometry,
                 shares: Sequence[Shares], dots_px: NDArray, free_height: bool = False) -> None:
        self.head, self.target, self.camera = head, target, camera
        self.shares, self.dots_px, self.free_height = shares, dots_px, free_height
        self.first_tilt = 4 * PER_PANEL + SIZE
        self.size = self.first_tilt + len(shares) - 1 + free_height
        self.prior = np.full(self.size, np.inf)
        self.prior[:4 * PER_PANEL] = np.tile(_PRIOR, 4)
        self.prior[self.first_tilt:self.first_tilt + len(shares) - 1] = _TILT_PRIOR
        self.scale = np.concatenate([np.tile(_STEPS, 4), _POSE_STEPS,
                                     np.full(len(shares) - 1, _TILT_STEP),
                                     np.full(int(free_height), _HEIGHT_STEP)])

    def pose(self, x: NDArray) -> TargetPose:
        return TargetPose(x[4 * PER_PANEL:self.first_tilt])

    def tilt(self, x: NDArray, position: int) -> float:
        extra = x[self.first_tilt + position - 1] if position else 0.0
        return float(self.shares[position].tilt + extra)

    def height(self, x: NDArray) -> float:
        return float(x[-1]) if self.free_height else self.target.height

    def points(self, x: NDArray, position: int) -> NDArray:
        """Where the blocks are on the plate, (N, 2), target frame."""
        pose = self.pose(x)
        there = plane_points(self.camera, self.shares[position].pixels, pose.plane)
        return pose.to_target(there)[:, :2]

    def panels(self, x: NDArray, position: int) -> list[PanelPose]:
        """The four panels in the target frame."""
        pose = self.pose(x)
        panels = x[:4 * PER_PANEL].reshape(4, PER_PANEL)
        ring = PanelRing(corrected(self.head, panels).bright_field)
        found = [ring.pose(name, self.tilt(x, position))  # type: ignore[arg-type]
                 for name in DIRECTIONS]
        return [replace(panel, center=pose.to_target(panel.center),
                        axis=panel.axis @ pose.rotation, right=panel.right @ pose.rotation)
                for panel in found]

    def lights(self, x: NDArray) -> list[NDArray]:
        """Irradiance per position, (4, N)."""
        return [self._light(self.points(x, k), self.panels(x, k), self.height(x))
                for k in range(len(self.shares))]

    def _light(self, points: NDArray, panels: Sequence[PanelPose], height: float) -> NDArray:
        return np.stack([panel.intensity * plate_irradiance(
            points, panel, height, self.target.footprint) for panel in panels])

    def blur(self, x: NDArray, position: int) -> NDArray:
        """What averaging over a block adds to the share in its middle, (4, N)."""
        share, panels, height = self.shares[position], self.panels(x, position), self.height(x)
        light = self._light(self.points(x, position), panels, height)
        mean = np.zeros_like(light)
        # a share changes fast near the wall alone
        near, pixels = slice(share.near), share.pixels[:share.near]
        for sides in product((-1, 1), repeat=2):
            corner = pixels + share.block_px / math.sqrt(12) * np.array(sides)
            points = self.pose(x).to_target(plane_points(self.camera, corner, self.pose(x).plane))
            mean[:, near] += self._light(points[:, :2], panels, height) / 4
        change = mean[:, near] / mean[:, near].sum(axis=0) - (
            light[:, near] / light[:, near].sum(axis=0))
        return np.pad(change, ((0, 0), (0, light.shape[1] - share.near)))

    def light_rates(self, x: NDArray, position: int) -> tuple[NDArray, NDArray]:
        """Irradiance (4, N) and its derivatives by all parameters, (size, 4, N).

        All that moves a panel are shifts and turns of a rigid body, so two kinds of derivatives
        suffice: by the panel's motion, and by the point's on the plate.
        """
        points, panels, height = self.points(x, position), self.panels(x, position), self.height(x)
        lit = [light_and_rates(points, panel, height, self.target.footprint) for panel in panels]
        gains = [panel.intensity for panel in panels]
        light = np.stack([gain * part[0] for gain, part in zip(gains, lit, strict=True)])
        by_motion = [gain * part[1] for gain, part in zip(gains, lit, strict=True)]
        by_point = [(self._light(points + shift, panels, height) - light) / _POINT_STEP
                    for shift in _POINT_STEP * np.eye(2)]
        rates = np.zeros((self.size, *light.shape))
        for k in range(self.size):
            moved, step = x.copy(), self.scale[k] * 0.1
            moved[k] += step
            if self.free_height and k == self.size - 1:
                rates[k] = (self._light(points, panels, height + step) - light) / step
            elif k < 4 * PER_PANEL and k % PER_PANEL == PER_PANEL - 1:
                rates[k, k // PER_PANEL] = light[k // PER_PANEL]
            elif k < self.first_tilt or k == self.first_tilt + position - 1:
                own = (range(4) if k >= 4 * PER_PANEL else [k // PER_PANEL])
                after = self.panels(moved, position)
                for i in own:
                    rates[k, i] = by_motion[i] @ _motion(panels[i], after[i]) / step
            if 4 * PER_PANEL <= k < self.first_tilt:
                shift = (self.points(moved, position) - points) / step
                rates[k] += by_point[0] * shift[:, 0] + by_point[1] * shift[:, 1]
        return light, rates

    def share_rates(self, x: NDArray, position: int) -> NDArray:
        """Derivatives of the predicted shares by all parameters, (size, 4, N)."""
        light, rates = self.light_rates(x, position)
        total = light.sum(axis=0)
        return np.asarray((rates - light / total * rates.sum(axis=1, keepdims=True)) / total)

    def residuals(self, x: NDArray) -> NDArray:
        """Normalised by the noise expected; specks in the pictures count less."""
        parts = [soft(-_residual(light, share) / (share.noise * _SOFT))[0]
                 for light, share in zip(self.lights(x), self.shares, strict=True)]
        dots = dot_errors(self.pose(x).numbers, self.dots_px, self.target, self.camera)
        return np.concatenate([*(_SOFT * part.ravel() for part in parts), dots / _DOT_NOISE_PX,
                               x / self.prior])

    def jacobian(self, x: NDArray) -> NDArray:
        """Derivatives of the residuals, (M, size)."""
        parts = []
        lights = self.lights(x)
        for k, (light, share) in enumerate(zip(lights, self.shares, strict=True)):
            slope = soft(_residual(light, share) / (share.noise * _SOFT))[1]
            parts.append((self.share_rates(x, k) * (slope / share.noise)).reshape(self.size, -1))
        dots = np.zeros((self.size, self.dots_px.size))
        numbers = self.pose(x).numbers
        here = dot_errors(numbers, self.dots_px, self.target, self.camera)
        for k, step in enumerate(0.1 * _POSE_STEPS):
            there = dot_errors(numbers + step * np.eye(SIZE)[k], self.dots_px, self.target,
                               self.camera)
            dots[4 * PER_PANEL + k] = (there - here) / (step * _DOT_NOISE_PX)
        return np.concatenate([*parts, dots, np.diag(1 / self.prior)], axis=1).T


def _motion(before: PanelPose, after: PanelPose) -> NDArray:
    """Small shift and turn from one pose to another, (6,)."""
    first, second = (np.stack([pose.axis, pose.right, np.cross(pose.axis, pose.right)])
                     for pose in (before, after))
    return np.concatenate([after.center - before.center,
                           0.5 * np.cross(first, second - first).sum(axis=0)])


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
    problem = _Problem(head, target, camera, [share.thinned(_THIN) for share in shares], dots_px,
                       free_height)
    x = np.zeros(problem.size)
    x[4 * PER_PANEL:problem.first_tilt] = pose.numbers
    if start is not None:
        x[:4 * PER_PANEL] = start.panels.ravel()
        x[4 * PER_PANEL:problem.first_tilt] = start.pose.numbers
        for k in range(1, len(shares)):
            x[problem.first_tilt + k - 1] = start.tilts[k] - shares[k].tilt
    if free_height:
        x[-1] = target.height
    fit = _solve(problem, x)
    if free_height:
        return _summary(problem, fit.x, fit.jac)
    # what remains tells how far to trust the shadows and the rest
    whole = [share.reweighed(_residual(light, part)) for share, part, light in zip(
        shares, problem.shares, problem.lights(fit.x), strict=True)]
    problem = _Problem(head, target, camera, whole, dots_px)
    problem = _Problem(head, target, camera, [
        replace(share, values=share.values - problem.blur(fit.x, k))
        for k, share in enumerate(whole)], dots_px)
    fit = _solve(problem, fit.x)
    return _summary(problem, fit.x, fit.jac)


def _solve(problem: _Problem, x: NDArray) -> OptimizeResult:
    return least_squares(problem.residuals, x, problem.jacobian, method='lm', max_nfev=20,
                         x_scale=10 * problem.scale, xtol=1e-8, ftol=1e-6)


def _residual(light: NDArray, share: Shares) -> NDArray:
    """Measured minus predicted, (4, N)."""
    return np.asarray(share.values - light / light.sum(axis=0))


def _summary(problem: _Problem, x: NDArray, jacobian: NDArray) -> RingFit:
    lights = problem.lights(x)
    residuals = [_residual(light, share)
                 for light, share in zip(lights, problem.shares, strict=True)]
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
    return RingFit(panels, [problem.tilt(x, k) for k in range(len(lights))], problem.pose(x),
                   problem.height(x), residuals, edge_px, scatter,
                   deviation[:4 * PER_PANEL].reshape(4, PER_PANEL),
                   deviation[4 * PER_PANEL:problem.first_tilt],
                   covariance[:problem.first_tilt, :problem.first_tilt],
                   float(strengths[0] / strengths[-2]))


def predicted_shares(head: HeadModel, target: RingTarget, camera: CameraGeometry,
                     shares: Shares, pose: TargetPose) -> NDArray:
    """Shares of light of a head as it is, for the blocks of ``shares``, (4, N)."""
    problem = _Problem(head, target, camera, [shares], np.zeros((0, 2)))
    x = np.zeros(problem.size)
    x[4 * PER_PANEL:problem.first_tilt] = pose.numbers
    light = problem.lights(x)[0]
    return np.asarray(light / light.sum(axis=0))


def blocked_slits(fit: RingFit, head: HeadModel, target: RingTarget, camera: CameraGeometry,
                  shares: Sequence[Shares]) -> NDArray:
    """How far each slit is closed: 0 is open, 1 is blocked, (S,) float64.

    The residuals are compared with the change that filling the slit would make.
    """
    problem = _Problem(head, target, camera, shares, np.zeros((0, 2)))
    x = np.concatenate([fit.panels.ravel(), fit.pose.numbers,
                        [tilt - share.tilt for tilt, share in zip(fit.tilts, shares, strict=True)
                         ][1:]])
    open_shares = [light / light.sum(axis=0) for light in problem.lights(x)]
    azimuths, found = target.slits.azimuths, []
    for k in range(len(azimuths)):
        slits = target.slits.model_copy(update={'azimuths': azimuths[:k] + azimuths[k + 1:]})
        filled = _Problem(head, target.model_copy(update={'slits': slits}), camera, shares,
                          np.zeros((0, 2)))
        change = np.concatenate([(light / light.sum(axis=0) - before).ravel() for light, before in
                                 zip(filled.lights(x), open_shares, strict=True)])
        residual = np.concatenate([r.ravel() for r in fit.residuals])
        found.append(residual @ change / (change @ change))
    return np.array(found)
