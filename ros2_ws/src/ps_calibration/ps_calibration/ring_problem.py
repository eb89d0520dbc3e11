"""What the pictures of a half ring should show, for all parameters of a fit, and how far they do.

Normal equations for ring_fit.py.
"""
from collections.abc import Sequence
from itertools import product
import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ps_calibration.gauss_newton import NormalEquations
from ps_calibration.ring_target import RingTarget
from ps_calibration.robust import soft
from ps_calibration.shadow_model import light_and_rates, plate_irradiance
from ps_calibration.shares import Shares
from ps_calibration.target_pose import SIZE, TargetPose, dot_errors
from ps_calibration.wall_glow import wall_glow
from ps_head_driver.camera_model import pixel_rays, plane_points, ray_points
from ps_head_driver.head_model import DIRECTIONS, CameraGeometry, HeadModel
from ps_head_driver.kinematics import PanelPose, PanelRing

Field = Literal['bright_field', 'dark_field']
# parameters of one panel: shift (radial, tangential, z), tilt_offset, twist, log of intensity
PER_PANEL = 6
# what is known of them beforehand: three times the tolerances of manufacture
PANEL_PRIOR = np.array([0.009, 0.009, 0.009, 0.105, 0.105, 0.15])
_TILT_PRIOR = 0.03                       # rad, error of the motor between two positions
STEP = 1e-6              # m or rad, of finite differences
_SOFTNESS_PRIOR = 1.0    # a lens that blurs as much as the blocks do
_GLOW_PRIOR = 1.0        # a wall that is black, or twice as bright as the file says
_DIM = 0.03              # of what the file says
_DOT_NOISE_PX = 0.003
# Gauss's rule over a block's edge; with two nodes it would turn all axes by 0.1 degrees
_RULE = (-math.sqrt(0.15), 5 / 18), (0.0, 8 / 18), (math.sqrt(0.15), 5 / 18)
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
    pictures, glow and height of the wall. Softness is the variance of what blurs the pictures
    (pixels, lens) relative to that of averaging over the blocks; left out, it would turn all four
    panels.
    Glow is the light that the wall throws onto the plate relative to what its reflectance in the
    target file says.
    """

    def __init__(self, head: HeadModel, target: RingTarget, camera: CameraGeometry,
                 shares: Sequence[Shares], dots_px: NDArray) -> None:
        self.head, self.target, self.camera = head, target, camera
        self.shares, self.dots_px = shares, dots_px
        self.first_tilt = 4 * PER_PANEL + SIZE
        self.softness = self.first_tilt + len(shares) - 1
        self.glow = self.softness + 1
        self.size = self.glow + 2
        self.rays = [pixel_rays(camera, share.pixels) for share in shares]
        self.expected = np.zeros(self.size)
        self.expected[self.softness] = self.expected[self.glow] = 1.0
        self.prior = np.full(self.size, np.inf)
        self.prior[:4 * PER_PANEL] = np.tile(PANEL_PRIOR, 4)
        self.prior[self.first_tilt:self.softness] = _TILT_PRIOR
        self.prior[self.softness], self.prior[self.glow] = _SOFTNESS_PRIOR, _GLOW_PRIOR
        #: what averaging over a block adds to the shares, per position (4, N) once it is known
        self.blurs: list[NDArray] = [np.zeros(share.values.shape) for share in shares]
        #: the same of the light that the wall throws onto the plate
        self.glows: list[NDArray] = [np.zeros(share.values.shape) for share in shares]

    def start(self, panels: NDArray, pose: TargetPose, tilts: Sequence[float],
              softness: float = 1.0, glow: float = 1.0) -> NDArray:
        """All parameters, the wall as high as the target file says.

        :param tilts: per position, rad; the first is taken to be nominal.
        """
        errors = [tilt - share.tilt for tilt, share in zip(tilts, self.shares, strict=True)]
        return np.concatenate([panels.ravel(), pose.numbers, errors[1:],
                               [softness, glow, self.target.height]])

    def pose(self, x: NDArray) -> TargetPose:
        """Pose of the target."""
        return TargetPose(x[4 * PER_PANEL:self.first_tilt])

    def tilt(self, x: NDArray, position: int) -> float:
        """Common tilt of the panels at a motor position, rad."""
        extra = x[self.first_tilt + position - 1] if position else 0.0
        return float(self.shares[position].tilt + extra)

    def points(self, x: NDArray, position: int) -> NDArray:
        """Where the blocks are on the plate, (N, 2), target frame."""
        pose = self.pose(x)
        return pose.to_target(ray_points(self.camera, self.rays[position], pose.plane))[:, :2]

    def panels(self, x: NDArray, position: int) -> list[PanelPose]:
        """The four panels in the target frame."""
        pose = self.pose(x)
        panels = x[:4 * PER_PANEL].reshape(4, PER_PANEL)
        ring = PanelRing(corrected(self.head, panels).bright_field)
        return [pose.panel_to_target(panel) for panel in ring.poses(self.tilt(x, position))]

    def predicted(self, x: NDArray) -> list[NDArray]:
        """Shares per position, (4, N)."""
        lights = [self._light(self.points(x, k), self.panels(x, k), x[-1])
                  for k in range(len(self.shares))]
        return [light / light.sum(axis=0) + x[self.softness] * blur + x[self.glow] * glow
                for light, blur, glow in zip(lights, self.blurs, self.glows, strict=True)]

    def differences(self, x: NDArray) -> list[NDArray]:
        """Measured minus predicted shares per position, (4, N)."""
        return [share.values - predicted
                for share, predicted in zip(self.shares, self.predicted(x), strict=True)]

    def learn_blur(self, x: NDArray) -> None:
        """From now on, predict what averaging over the blocks does near these parameters."""
        self.blurs = [self._blur(x, k) for k in range(len(self.shares))]

    def learn_glow(self, x: NDArray) -> None:
        """From now on, predict what light by way of the wall does near these parameters.

        A wall that is found darker than any paint throws none: what looks like a glow is then an
        error of something else, and fitted it would turn the panels.
        """
        if x[self.glow] < _DIM:
            self.expected[self.glow] = 0.0
        else:
            self.glows = [self._glow(x, k) for k in range(len(self.shares))]

    def _light(self, points: NDArray, panels: Sequence[PanelPose], height: float) -> NDArray:
        return np.stack([panel.intensity * plate_irradiance(
            points, panel, height, self.target.footprint) for panel in panels])

    def _blur(self, x: NDArray, position: int) -> NDArray:
        """What averaging over a block adds to the share in its middle, (4, N)."""
        share, panels, height = self.shares[position], self.panels(x, position), x[-1]
        light = self._light(self.points(x, position), panels, height)
        mean = np.zeros_like(light)
        # a share changes fast near the wall alone
        near, pixels = slice(share.near), share.pixels[:share.near]
        for (u, part_u), (v, part_v) in product(_RULE, repeat=2):
            place = pixels + share.block_px * np.array([u, v])
            points = self.pose(x).to_target(plane_points(self.camera, place, self.pose(x).plane))
            mean[:, near] += part_u * part_v * self._light(points[:, :2], panels, height)
        change = mean[:, near] / mean[:, near].sum(axis=0) - (
            light[:, near] / light[:, near].sum(axis=0))
        return np.pad(change, ((0, 0), (0, light.shape[1] - share.near)))

    def _glow(self, x: NDArray, position: int) -> NDArray:
        """What the wall's light adds to the shares, (4, N)."""
        points, panels = self.points(x, position), self.panels(x, position)
        light = self._light(points, panels, x[-1])
        whole = light + wall_glow(points, panels, self.target)
        return np.asarray(whole / whole.sum(axis=0) - light / light.sum(axis=0))

    def predicted_and_rates(self, x: NDArray, position: int) -> tuple[NDArray, NDArray]:
        """Shares (4, N) and their derivatives by all parameters, (size, 4, N).

        All that moves a panel are shifts and turns of a rigid body: the light's derivatives by
        these, by the point on the plate and by the wall's height suffice.
        """
        points, panels = self.points(x, position), self.panels(x, position)
        pose = [*range(4 * PER_PANEL, self.first_tilt)]
        common = [*pose, self.first_tilt + position - 1] if position else pose
        steps = np.zeros((PER_PANEL - 1 + len(common), self.size))
        for k in range(PER_PANEL - 1):
            steps[k, k:4 * PER_PANEL:PER_PANEL] = STEP      # of all four panels, each its own
        steps[PER_PANEL - 1:, common] = STEP * np.eye(len(common))
        motions = rigid_motions(
            panels, [self.panels(x + step, position) for step in steps]) / STEP
        shifts = [(self.points(x + step, position) - points).T / STEP
                  for step in STEP * np.eye(self.size)[pose]]
        light = np.empty((4, len(points)))
        rates = np.zeros((self.size, *light.shape))
        for i, panel in enumerate(panels):
            own, by = light_and_rates(points, panel, x[-1], self.target.footprint)
            light[i], by = panel.intensity * own, panel.intensity * by.T
            last = (i + 1) * PER_PANEL - 1
            rates[[*range(i * PER_PANEL, last), *common], i] = motions[:, i] @ by[:6]
            rates[last, i] = light[i]
            for k, shift in zip(pose, shifts, strict=True):
                rates[k, i] += by[6] * shift[0] + by[7] * shift[1]
            rates[-1, i] = by[8]
        total = light.sum(axis=0)
        shares = light / total
        rates -= shares * rates.sum(axis=1, keepdims=True)
        rates /= total
        rates[self.softness], rates[self.glow] = self.blurs[position], self.glows[position]
        return (shares + x[self.softness] * self.blurs[position]
                + x[self.glow] * self.glows[position], rates)

    def equations(self, x: NDArray) -> NormalEquations:
        """Of all residuals, relative to the noise expected; specks in the pictures count less."""
        numbers = self.pose(x).numbers
        dots = dot_errors(numbers, self.dots_px, self.target, self.camera)
        by_pose = np.zeros((self.size, dots.size))
        by_pose[4 * PER_PANEL:self.first_tilt] = [
            (dot_errors(numbers + step, self.dots_px, self.target, self.camera) - dots) / STEP
            for step in STEP * np.eye(SIZE)]
        sums = NormalEquations.of(dots / _DOT_NOISE_PX, by_pose / _DOT_NOISE_PX)
        sums += NormalEquations.of((x - self.expected) / self.prior, np.diag(1 / self.prior))
        for position, share in enumerate(self.shares):
            predicted, rates = self.predicted_and_rates(x, position)
            left, slope = soft((predicted - share.values) / (share.noise * SOFT))
            rates *= slope / share.noise
            sums += NormalEquations.of(SOFT * left, rates)
        return sums


def rigid_motions(before: Sequence[PanelPose], after: Sequence[Sequence[PanelPose]]) -> NDArray:
    """Small shifts and turns of P panels in K ways, (K, P, 6).

    :param after: K times the P poses.
    """
    def vectors(names: Sequence[str], rows: Sequence[Sequence[PanelPose]]) -> NDArray:
        return np.array([[[getattr(pose, name) for name in names] for pose in row]
                         for row in rows])

    first, second = (vectors(('axis', 'right'), rows) for rows in ([before], after))
    first, second = (np.concatenate([pair, np.cross(*np.moveaxis(pair, 2, 0))[:, :, None]], axis=2)
                     for pair in (first, second))
    return np.concatenate([
        vectors(('center',), after)[:, :, 0] - vectors(('center',), [before])[:, :, 0],
        0.5 * np.cross(first, second - first).sum(axis=2)], axis=-1)
