"""What the pictures of a half ring should show, for all parameters of a fit, and how far they do.

Residuals and their derivatives for ring_fit.py.
"""
from collections.abc import Sequence
from itertools import product
import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ps_calibration.ring_target import RingTarget
from ps_calibration.robust import soft
from ps_calibration.shadow_model import light_and_rates, plate_irradiance
from ps_calibration.shares import Shares
from ps_calibration.target_pose import SIZE, TargetPose, dot_errors
from ps_head_driver.camera_model import plane_points
from ps_head_driver.head_model import DIRECTIONS, CameraGeometry, HeadModel
from ps_head_driver.kinematics import PanelPose, PanelRing

Field = Literal['bright_field', 'dark_field']
# parameters of one panel: shift (radial, tangential, z), tilt_offset, twist, log of intensity
PER_PANEL = 6
# what is known of them beforehand: three times the tolerances of manufacture
PANEL_PRIOR = np.array([0.009, 0.009, 0.009, 0.105, 0.105, 0.15])
_TILT_PRIOR = 0.03                       # rad, error of the motor between two positions
# typical sizes of the parameters
PANEL_STEPS = np.array([1e-4, 1e-4, 1e-4, 1e-3, 1e-3, 1e-3])
_POSE_STEPS = np.array([1e-5, 1e-5, 1e-5, 1e-3, 5e-4, 5e-4])
_HEIGHT_STEP, _TILT_STEP, _SOFTNESS_STEP = 2e-5, 1e-3, 0.1
_SOFTNESS_PRIOR = 1.0    # a lens that blurs as much as the blocks do
POINT_STEP = 1e-5                        # m
_DOT_NOISE_PX = 0.003
SOFT = 3.0               # standard deviations from which on a residual counts less


def corrected(head: HeadModel, panels: NDArray, field: Field = 'bright_field') -> HeadModel:
    """The head with corrections (4, PER_PANEL) added to the panels of one field."""
    ring, section = {}, getattr(head, field)
    for name, p in zip(DIRECTIONS, panels, strict=True):
        old = section.panels[name]
        ring[name] = old.model_copy(update={
            'shift': (old.shift[0] + p[0], old.shift[1] + p[1], old.shift[2] + p[2]),
            'tilt_offset': old.tilt_offset + p[3], 'twist': old.twist + p[4],
            'intensity': old.intensity * float(np.exp(p[5]))})
    return head.model_copy(update={field: section.model_copy(update={'panels': ring})})


class RingProblem:
    """Residuals and their derivatives as functions of all parameters.

    Order: 4 x PER_PANEL, pose, error of the motor at the second position on, softness of the
    pictures, then the wall's height if it is free. Softness is the variance of what blurs the
    pictures (pixels, lens) relative to that of averaging over the blocks; left out, it would turn
    all four panels.
    """

    def __init__(self, head: HeadModel, target: RingTarget, camera: CameraGeometry,
                 shares: Sequence[Shares], dots_px: NDArray, free_height: bool = False) -> None:
        self.head, self.target, self.camera = head, target, camera
        self.shares, self.dots_px, self.free_height = shares, dots_px, free_height
        self.first_tilt = 4 * PER_PANEL + SIZE
        self.softness = self.first_tilt + len(shares) - 1
        self.size = self.softness + 1 + free_height
        self.expected = np.zeros(self.size)
        self.expected[self.softness] = 1.0
        self.prior = np.full(self.size, np.inf)
        self.prior[:4 * PER_PANEL] = np.tile(PANEL_PRIOR, 4)
        self.prior[self.first_tilt:self.softness] = _TILT_PRIOR
        self.prior[self.softness] = _SOFTNESS_PRIOR
        self.scale = np.concatenate([np.tile(PANEL_STEPS, 4), _POSE_STEPS,
                                     np.full(len(shares) - 1, _TILT_STEP), [_SOFTNESS_STEP],
                                     np.full(int(free_height), _HEIGHT_STEP)])
        #: what averaging over a block adds to the shares, per position (4, N) once it is known
        self.blurs: list[NDArray] = [np.zeros(share.values.shape) for share in shares]

    def start(self, panels: NDArray, pose: TargetPose, tilts: Sequence[float],
              softness: float = 1.0) -> NDArray:
        """All parameters, the wall as high as the target file says.

        :param tilts: per position, rad; the first is taken to be nominal.
        """
        errors = [tilt - share.tilt for tilt, share in zip(tilts, self.shares, strict=True)]
        return np.concatenate([panels.ravel(), pose.numbers, errors[1:], [softness],
                               [self.target.height] * self.free_height])

    def pose(self, x: NDArray) -> TargetPose:
        """Pose of the target."""
        return TargetPose(x[4 * PER_PANEL:self.first_tilt])

    def tilt(self, x: NDArray, position: int) -> float:
        """Common tilt of the panels at a motor position, rad."""
        extra = x[self.first_tilt + position - 1] if position else 0.0
        return float(self.shares[position].tilt + extra)

    def height(self, x: NDArray) -> float:
        """Height of the wall, m."""
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
        return [pose.panel_to_target(panel) for panel in ring.poses(self.tilt(x, position))]

    def lights(self, x: NDArray) -> list[NDArray]:
        """Irradiance per position, (4, N)."""
        return [self._light(self.points(x, k), self.panels(x, k), self.height(x))
                for k in range(len(self.shares))]

    def predicted(self, x: NDArray) -> list[NDArray]:
        """Shares per position, (4, N)."""
        return [light / light.sum(axis=0) + x[self.softness] * blur
                for light, blur in zip(self.lights(x), self.blurs, strict=True)]

    def differences(self, x: NDArray) -> list[NDArray]:
        """Measured minus predicted shares per position, (4, N)."""
        return [share.values - predicted
                for share, predicted in zip(self.shares, self.predicted(x), strict=True)]

    def learn_blur(self, x: NDArray) -> None:
        """From now on, predict what averaging over the blocks does near these parameters."""
        self.blurs = [self._blur(x, k) for k in range(len(self.shares))]

    def _light(self, points: NDArray, panels: Sequence[PanelPose], height: float) -> NDArray:
        return np.stack([panel.intensity * plate_irradiance(
            points, panel, height, self.target.footprint) for panel in panels])

    def _blur(self, x: NDArray, position: int) -> NDArray:
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
        by_point = [(self._light(points + shift, panels, height) - light) / POINT_STEP
                    for shift in POINT_STEP * np.eye(2)]
        rates = np.zeros((self.size, *light.shape))
        for k in range(self.size):
            moved, step = x.copy(), self.scale[k] * 0.1
            moved[k] += step
            if self.free_height and k == self.size - 1:
                rates[k] = (self._light(points, panels, height + step) - light) / step
            elif k < 4 * PER_PANEL and k % PER_PANEL == PER_PANEL - 1:
                rates[k, k // PER_PANEL] = light[k // PER_PANEL]
            elif k < self.first_tilt or (
                    position and k == self.first_tilt + position - 1):
                own = (range(4) if k >= 4 * PER_PANEL else [k // PER_PANEL])
                after = self.panels(moved, position)
                for i in own:
                    rates[k, i] = by_motion[i] @ rigid_motion(panels[i], after[i]) / step
            if 4 * PER_PANEL <= k < self.first_tilt:
                shift = (self.points(moved, position) - points) / step
                rates[k] += by_point[0] * shift[:, 0] + by_point[1] * shift[:, 1]
        return light, rates

    def share_rates(self, x: NDArray, position: int) -> NDArray:
        """Derivatives of the predicted shares by all parameters, (size, 4, N)."""
        light, rates = self.light_rates(x, position)
        total = light.sum(axis=0)
        rates = (rates - light / total * rates.sum(axis=1, keepdims=True)) / total
        rates[self.softness] = self.blurs[position]
        return rates

    def residuals(self, x: NDArray) -> NDArray:
        """Normalised by the noise expected; specks in the pictures count less."""
        parts = [soft(-difference / (share.noise * SOFT))[0]
                 for difference, share in zip(self.differences(x), self.shares, strict=True)]
        dots = dot_errors(self.pose(x).numbers, self.dots_px, self.target, self.camera)
        return np.concatenate([*(SOFT * part.ravel() for part in parts), dots / _DOT_NOISE_PX,
                               (x - self.expected) / self.prior])

    def jacobian(self, x: NDArray) -> NDArray:
        """Derivatives of the residuals, (M, size)."""
        parts = []
        for k, (difference, share) in enumerate(
                zip(self.differences(x), self.shares, strict=True)):
            slope = soft(difference / (share.noise * SOFT))[1]
            parts.append((self.share_rates(x, k) * (slope / share.noise)).reshape(self.size, -1))
        dots = np.zeros((self.size, self.dots_px.size))
        numbers = self.pose(x).numbers
        here = dot_errors(numbers, self.dots_px, self.target, self.camera)
        for k, step in enumerate(0.1 * _POSE_STEPS):
            there = dot_errors(numbers + step * np.eye(SIZE)[k], self.dots_px, self.target,
                               self.camera)
            dots[4 * PER_PANEL + k] = (there - here) / (step * _DOT_NOISE_PX)
        return np.concatenate([*parts, dots, np.diag(1 / self.prior)], axis=1).T


def rigid_motion(before: PanelPose, after: PanelPose) -> NDArray:
    """Small shift and turn from one pose to another, (6,)."""
    first, second = (np.stack([pose.axis, pose.right, np.cross(pose.axis, pose.right)])
                     for pose in (before, after))
    return np.concatenate([after.center - before.center,
                           0.5 * np.cross(first, second - first).sum(axis=0)])


