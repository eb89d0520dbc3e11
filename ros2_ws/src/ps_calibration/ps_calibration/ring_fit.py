"""Fitting the panels of a head to the pictures of a half ring (paper, section 2.3).

What is compared is each picture's share in the sum of the four: the reflectance of the plate,
vignetting and dots cancel out, and the panel-blurred shadows and the fall-off over the plate
remain. All motor positions, all panels and the target's pose are fitted together, with a robust
loss, starting from the kinematics.
"""
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
import math

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
# what is expected of the models of soft shadows near the wall and of the smooth rest. The dots
# weigh more than their noise asks for: errors of the soft shadows, alike in many blocks, must not
# tilt the plane
_MODEL_NEAR, _MODEL_FAR, _DOT_NOISE_PX = 1e-3, 5e-5, 0.001
_CLEAR = 0.0006          # m; the camera looks past the wall's edge, and a block has a width
_BLOCK = 1.6e-4          # m on the plate, edge of the smallest blocks of pixels
_REACH = 0.006           # m; no shadow is longer
_PART, _FAR = 7, 6       # one block in _PART is used up to there; beyond, _FAR x _FAR are averaged
_SOFT = 3.0              # standard deviations from which on a residual counts less


@dataclass(frozen=True)
class Shares:
    """What one motor position's pictures say about the light.

    :param tilt: nominal, rad.
    :param pixels: (N, 2) float64, column and row of the middles of the blocks.
    :param values: (4, N) float64, share of E, N, W, S in their sum.
    :param noise: (N,) float64, standard deviation expected of them.
    """

    tilt: float
    pixels: NDArray
    values: NDArray
    noise: NDArray


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
    distance = target.distance(x, y)
    keep = (distance > _CLEAR) & (np.hypot(x, y) > _CLEAR) & (
        abs(x) < half[0]) & (abs(y) < half[1]) & (total > 0.1 * np.median(total))
    for dot in target.fiducials.centres:
        keep &= np.hypot(x - dot[0], y - dot[1]) > target.fiducials.radius + _CLEAR / 2
    grid = np.concatenate([blocks, pixels.T]).reshape(6, rows, columns)
    parts = []
    i, j = (pixels // side).astype(int).T
    for size, here in ((1, (distance < _REACH) & ((i + 3 * j) % _PART == 0)),
                       (_FAR, distance >= _REACH)):
        whole = _merge((keep & here).reshape(1, rows, columns), size)[0] == 1
        parts.append(_merge(grid, size)[:, whole])
    merged = np.concatenate(parts, axis=1)
    values = merged[:4] / merged[:4].sum(axis=0)
    return Shares(tilt, merged[4:].T.copy(), values,
                  _noise([part[:4] / part[:4].sum(axis=0) for part in parts]))


def _merge(grid: NDArray, size: int) -> NDArray:
    """Means of size x size neighbours, (K, H, W) to (K, H // size, W // size)."""
    rows, columns = (n // size for n in grid.shape[1:])
    return np.asarray(grid[:, :rows * size, :columns * size].reshape(
        -1, rows, size, columns, size).mean(axis=(2, 4), dtype=np.float64))


def _noise(parts: Sequence[NDArray]) -> NDArray:
    """Standard deviation of each share: its pixels' noise and the model's own errors, (N,).

    The noise is seen in the differences of neighbours far from the wall.
    """
    far = parts[1]
    change = np.diff(far, 2, axis=1)[:, np.abs(np.diff(far, 2, axis=1)).max(axis=0) < 0.05]
    pixel = 1.4826 * float(np.median(abs(change))) / math.sqrt(6) if change.size else 0.0
    return np.concatenate([
        np.full(parts[0].shape[1], math.hypot(pixel * _FAR, _MODEL_NEAR)),
        np.full(far.shape[1], math.hypot(pixel, _MODEL_FAR))])


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
        parts = [((light / light.sum(axis=0) - share.values) / share.noise).ravel()
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
                parts.append((share / self.shares[position].noise).ravel())
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
                        x_scale=problem.scale, max_nfev=15, xtol=1e-8, ftol=1e-7)
    return _summary(problem, fit.x, fit.jac)


def _summary(problem: _Problem, x: NDArray, jacobian: NDArray) -> RingFit:
    lights = problem.lights(x)
    residuals = [share.values - light / light.sum(axis=0)
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
    strengths = np.linalg.svd(jacobian / np.maximum(lengths, 1e-300), compute_uv=False)
    return RingFit(panels, [problem.tilt(x, k) for k in range(len(lights))], problem.pose(x),
                   problem.height(x), residuals, edge_px, scatter,
                   deviation[:4 * PER_PANEL].reshape(4, PER_PANEL),
                   deviation[4 * PER_PANEL:problem.first_tilt],
                   covariance[:problem.first_tilt, :problem.first_tilt],
                   float(strengths[0] / strengths[-2]))


def predicted_shares(head: HeadModel, target: RingTarget, camera: CameraGeometry,
                     shares: Shares, pose: TargetPose) -> NDArray:
    """Shares of light of a head as it is, for the blocks of ``shares``, (4, N)."""
    problem = _Problem(head, target, camera, [shares], np.zeros((0, 2)), False)
    x = np.zeros(problem.size)
    x[4 * PER_PANEL:problem.first_tilt] = pose.numbers
    light = problem.lights(x)[0]
    return np.asarray(light / light.sum(axis=0))


def blocked_slits(fit: RingFit, head: HeadModel, target: RingTarget, camera: CameraGeometry,
                  shares: Sequence[Shares]) -> NDArray:
    """How far each slit is closed: 0 is open, 1 is blocked, (S,) float64.

    The residuals are compared with the change that filling the slit would make.
    """
    problem = _Problem(head, target, camera, shares, np.zeros((0, 2)), False)
    x = np.concatenate([fit.panels.ravel(), fit.pose.numbers,
                        [tilt - share.tilt for tilt, share in zip(fit.tilts, shares, strict=True)
                         ][1:]])
    open_shares = [light / light.sum(axis=0) for light in problem.lights(x)]
    azimuths, found = target.slits.azimuths, []
    for k in range(len(azimuths)):
        slits = target.slits.model_copy(update={'azimuths': azimuths[:k] + azimuths[k + 1:]})
        filled = _Problem(head, target.model_copy(update={'slits': slits}), camera, shares,
                          np.zeros((0, 2)), False)
        change = np.concatenate([(light / light.sum(axis=0) - before).ravel() for light, before in
                                 zip(filled.lights(x), open_shares, strict=True)])
        residual = np.concatenate([r.ravel() for r in fit.residuals])
        found.append(residual @ change / (change @ change))
    return np.array(found)
