"""Fitting the panels of a head to the pictures of a half ring (paper, section 2.3).

What is compared is each picture's share in the sum of the four: the reflectance of the plate,
vignetting and dots cancel out, and the panel-blurred shadows and the fall-off over the plate
remain. All motor positions, all panels and the target's pose are fitted together, with a robust
loss, starting from the kinematics.
"""
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from ps_calibration.ring_target import RingTarget
from ps_calibration.shadow_model import plate_irradiance
from ps_calibration.target_pose import SIZE, TargetPose, dot_errors
from ps_head_driver.camera_model import plane_points
from ps_head_driver.head_model import DIRECTIONS, CameraGeometry, HeadModel
from ps_head_driver.kinematics import PanelPose, PanelRing

# parameters of one panel: shift (radial, tangential, z), tilt_offset, twist, log of intensity
PER_PANEL = 6
# what is known of them beforehand: three times the tolerances of manufacture
_PRIOR = np.array([0.009, 0.009, 0.009, 0.105, 0.105, 0.15])
_TILT_PRIOR = 0.03                       # rad, error of the motor between two positions
_STEPS = np.array([1e-4, 1e-4, 1e-4, 1e-3, 1e-3, 1e-3])        # of finite differences
_POSE_STEPS = np.array([1e-5, 1e-5, 1e-5, 1e-3, 5e-4, 5e-4])
_HEIGHT_STEP, _TILT_STEP = 2e-5, 1e-3
# the dots weigh more than their noise asks for: small errors of the light's model, the same in
# thousands of blocks, must not tilt the plane
_SHARE_NOISE, _DOT_NOISE_PX = 0.002, 0.001
_CLEAR = 0.0006          # m; the camera looks past the wall's edge, and a block has a width
_BLOCK = 1.6e-4          # m on the plate, edge of the blocks of pixels that are averaged
_REACH = 0.006           # m; no shadow is longer; beyond, a few blocks are enough
_SOFT = 3.0              # standard deviations from which on a residual counts less


@dataclass(frozen=True)
class Shares:
    """What one motor position's pictures say about the light.

    :param tilt: nominal, rad.
    :param pixels: (N, 2) float64, column and row of the middles of the blocks.
    :param values: (4, N) float64, share of E, N, W, S in their sum.
    """

    tilt: float
    pixels: NDArray
    values: NDArray


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
    :param deviation: (4, PER_PANEL) standard deviations from the covariance.
    """

    panels: NDArray
    tilts: list[float]
    pose: TargetPose
    height: float
    residuals: list[NDArray]
    edge_px: list[NDArray]
    deviation: NDArray


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


def measure_shares(pictures: Sequence[NDArray], tilt: float, pose: TargetPose,
                   target: RingTarget, camera: CameraGeometry) -> Shares:
    """Average the pictures of one motor position over blocks where only the plate is seen.

    :param pictures: E, N, W, S, (H, W) float, room light subtracted, equal exposure.
    :param tilt: nominal, rad.
    """
    side = max(1, round(_BLOCK * camera.fx / camera.camera_standoff))
    rows, columns = (n // side for n in pictures[0].shape)
    blocks = np.stack([
        p[:rows * side, :columns * side].reshape(rows, side, columns, side).mean(axis=(1, 3))
        for p in pictures]).reshape(4, -1)
    middle = (side - 1) / 2
    v, u = np.mgrid[:rows, :columns] * side + middle
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2)
    points = pose.to_target(plane_points(camera, pixels, pose.plane))
    x, y = points[:, 0], points[:, 1]
    half = np.array(target.base.size) / 2 - _CLEAR
    total = blocks.sum(axis=0)
    keep = (target.distance(x, y) > _CLEAR) & (np.hypot(x, y) > _CLEAR) & (
        abs(x) < half[0]) & (abs(y) < half[1]) & (total > 0.1 * np.median(total))
    for dot in target.fiducials.centres:
        keep &= np.hypot(x - dot[0], y - dot[1]) > target.fiducials.radius + _CLEAR / 2
    i, j = (pixels // side).astype(int).T
    keep &= np.where(target.distance(x, y) < _REACH, (i + 3 * j) % 7 == 0,
                     (i % 6 == 0) & (j % 6 == 0))
    return Shares(tilt, pixels[keep], blocks[:, keep] / total[keep])


class _Problem:
    """Residuals and their derivatives as functions of all parameters.

    Order: 4 x PER_PANEL, pose, error of the motor at the second position on, then the wall's
    height if it is free.
    """

    def __init__(self, head: HeadModel, target: RingTarget, camera: CameraGeometry,
                 shares: Sequence[Shares], dots_px: NDArray, free_height: bool) -> None:
        self.head, self.target, self.camera = head, target, camera
        self.shares, self.dots_px, self.free_height = shares, dots_px, free_height
        self.first_tilt = 4 * PER_PANEL + SIZE
        self.size = self.first_tilt + len(shares) - 1 + free_height
        self.prior = np.full(self.size, np.inf)
        self.prior[:4 * PER_PANEL] = np.tile(_PRIOR, 4)
        self.prior[self.first_tilt:self.first_tilt + len(shares) - 1] = _TILT_PRIOR
        self._at: tuple[NDArray, list[NDArray]] | None = None

    def pose(self, x: NDArray) -> TargetPose:
        return TargetPose(x[4 * PER_PANEL:self.first_tilt])

    def tilt(self, x: NDArray, position: int) -> float:
        extra = x[self.first_tilt + position - 1] if position else 0.0
        return float(self.shares[position].tilt + extra)

    def height(self, x: NDArray) -> float:
        return float(x[-1]) if self.free_height else self.target.height

    def panel_light(self, x: NDArray, position: int, panel: int) -> NDArray:
        """Irradiance of all blocks of one position under one panel, (N,)."""
        pose = self.pose(x)
        panels = x[:4 * PER_PANEL].reshape(4, PER_PANEL)
        ring = PanelRing(corrected(self.head, panels).bright_field)
        where = ring.pose(DIRECTIONS[panel], self.tilt(x, position))  # type: ignore[arg-type]
        points = plane_points(self.camera, self.shares[position].pixels, pose.plane)
        there = PanelPose(pose.to_target(where.center), where.axis @ pose.rotation,
                          where.right @ pose.rotation, where.size, where.lobe_exponent, 1.0)
        return where.intensity * plate_irradiance(
            pose.to_target(points)[:, :2], there, self.height(x), self.target.footprint)

    def lights(self, x: NDArray) -> list[NDArray]:
        """Irradiance per position, (4, N)."""
        if self._at is None or not np.array_equal(self._at[0], x):
            self._at = (x.copy(), [np.stack([self.panel_light(x, k, i) for i in range(4)])
                                   for k in range(len(self.shares))])
        return self._at[1]

    def residuals(self, x: NDArray) -> NDArray:
        """Normalised by the noise expected."""
        parts = [((light / light.sum(axis=0) - share.values) / _SHARE_NOISE).ravel()
                 for light, share in zip(self.lights(x), self.shares, strict=True)]
        dots = dot_errors(self.pose(x).numbers, self.dots_px, self.target, self.camera)
        return np.concatenate([*parts, dots / _DOT_NOISE_PX, x / self.prior])

    def loss(self, squares: NDArray) -> NDArray:
        """Soft L1 for the pictures, in which specks happen; none for dots and prior.

        :param squares: of the residuals, (M,).
        :returns: (3, M): loss and its two derivatives, as scipy wants it.
        """
        root = np.sqrt(1 + squares / _SOFT**2)
        rho = np.stack([2 * _SOFT**2 * (root - 1), 1 / root, -0.5 / (_SOFT**2 * root**3)])
        trusted = self.dots_px.size + self.size
        rho[:, -trusted:] = squares[-trusted:], np.ones(trusted), np.zeros(trusted)
        return rho

    def jacobian(self, x: NDArray) -> NDArray:
        """Finite differences; each panel's own parameters change its light alone."""
        lights = self.lights(x)
        columns = []
        for k in range(self.size):
            step, panels = self._step(k)
            moved = x.copy()
            moved[k] += step
            parts = []
            for position, light in enumerate(lights):
                total = light.sum(axis=0)
                change = np.zeros_like(light)
                if not self.first_tilt <= k < self.first_tilt + len(self.shares) - 1 or (
                        k - self.first_tilt + 1 == position):
                    for panel in panels:
                        after = light[panel] * np.exp(step) if (
                            len(panels) == 1 and k % PER_PANEL == PER_PANEL - 1
                        ) else self.panel_light(moved, position, panel)
                        change[panel] = (after - light[panel]) / step
                share = (change - light / total * change.sum(axis=0)) / total
                parts.append(share.ravel() / _SHARE_NOISE)
            dots = np.zeros(self.dots_px.size)
            if 4 * PER_PANEL <= k < self.first_tilt:
                dots = (dot_errors(self.pose(moved).numbers, self.dots_px, self.target,
                                   self.camera)
                        - dot_errors(self.pose(x).numbers, self.dots_px, self.target,
                                     self.camera)) / (step * _DOT_NOISE_PX)
            columns.append(np.concatenate([*parts, dots, np.eye(self.size)[k] / self.prior]))
        return np.stack(columns, axis=1)

    def _step(self, k: int) -> tuple[float, Sequence[int]]:
        if k < 4 * PER_PANEL:
            return float(_STEPS[k % PER_PANEL]), [k // PER_PANEL]
        if k < self.first_tilt:
            return float(_POSE_STEPS[k - 4 * PER_PANEL]), range(4)
        return (_HEIGHT_STEP if self.free_height and k == self.size - 1 else _TILT_STEP), range(4)

    @cached_property
    def scale(self) -> NDArray:
        """Typical sizes of the parameters."""
        return np.array([10 * self._step(k)[0] for k in range(self.size)])


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
    problem = _Problem(head, target, camera, shares, dots_px, free_height)
    x = np.zeros(problem.size)
    x[4 * PER_PANEL:problem.first_tilt] = pose.numbers
    if start is not None:
        x[:4 * PER_PANEL] = start.panels.ravel()
        x[4 * PER_PANEL:problem.first_tilt] = start.pose.numbers
        for k in range(1, len(shares)):
            x[problem.first_tilt + k - 1] = start.tilts[k] - shares[k].tilt
    if free_height:
        x[-1] = target.height
    fit = least_squares(problem.residuals, x, problem.jacobian, loss=problem.loss,
                        x_scale=problem.scale, max_nfev=10, xtol=1e-6, ftol=1e-4)
    return _summary(problem, fit.x, fit.jac)


def _summary(problem: _Problem, x: NDArray, jacobian: NDArray) -> RingFit:
    lights = problem.lights(x)
    residuals = [share.values - light / light.sum(axis=0)
                 for light, share in zip(lights, problem.shares, strict=True)]
    scatter = 1.4826 * np.median(abs(np.concatenate([r.ravel() for r in residuals])))
    covariance = np.linalg.inv(jacobian.T @ jacobian) * (scatter / _SHARE_NOISE)**2
    deviation = np.sqrt(np.diag(covariance))[:4 * PER_PANEL].reshape(4, PER_PANEL)
    metres_per_pixel = problem.camera.camera_standoff / problem.camera.fx
    moved_x, moved_y = (jacobian[:, 4 * PER_PANEL + k] * _SHARE_NOISE for k in range(2))
    edge_px, first = [], 0
    for r in residuals:
        last = first + r.size
        steep = np.hypot(moved_x[first:last], moved_y[first:last]).reshape(r.shape)
        edges = steep > 0.3 * steep.max(axis=1, keepdims=True)
        edge_px.append(np.sqrt(np.sum(r**2 * edges, axis=1) / np.sum(steep**2 * edges, axis=1))
                       / metres_per_pixel)
        first = last
    panels = x[:4 * PER_PANEL].reshape(4, PER_PANEL).copy()
    return RingFit(panels, [problem.tilt(x, k) for k in range(len(lights))], problem.pose(x),
                   problem.height(x), residuals, edge_px, deviation)


def predicted_shares(head: HeadModel, target: RingTarget, camera: CameraGeometry,
                     shares: Shares, pose: TargetPose) -> NDArray:
    """Shares of light of a head as it is, for the blocks of ``shares``, (4, N)."""
    problem = _Problem(head, target, camera, [shares], np.zeros((0, 2)), False)
    x = np.zeros(problem.size)
    x[4 * PER_PANEL:problem.first_tilt] = pose.numbers
    light = problem.lights(x)[0]
    return np.asarray(light / light.sum(axis=0))
