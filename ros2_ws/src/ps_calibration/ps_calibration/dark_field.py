"""Where the dark-field panels are, and how bright, from pictures of the half ring under them.

Their light grazes the plate: it falls off quickly, and the ring's shadows are long and soft. Both
are fitted, for each panel on its own, starting from the head file; see plate_light.py for what is
measured. A panel that cannot be calibrated keeps its nominal geometry and says why.
"""
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
import math

import numpy as np
from numpy.typing import NDArray

from ps_calibration.detection import displacement
from ps_calibration.gauss_newton import NormalEquations, minimise
from ps_calibration.plate_light import (
    PlateLight,
    free_light,
    light_of,
    mean_light,
    measure_plate_light,
)
from ps_calibration.ring_fit import RingFit
from ps_calibration.ring_pictures import MOVED_PX, room_light, stated_tilt, without_room
from ps_calibration.ring_problem import (
    PANEL_PRIOR,
    PER_PANEL,
    SOFT,
    STEP,
    corrected,
    rigid_motions,
)
from ps_calibration.ring_target import RingTarget
from ps_calibration.robust import soft
from ps_calibration.shadow_model import light_and_rates
from ps_calibration.target_pose import TargetPose
from ps_calibration.verdict import out_of_place
from ps_calibration.wall_glow import wall_glow
from ps_head_driver.errors import PsError
from ps_head_driver.head_model import DIRECTIONS, CameraGeometry, HeadModel
from ps_head_driver.kinematics import PanelPose, PanelRing
from ps_head_driver.stack import Mode, Panel, Stack

# what is known of a panel beforehand: as of the bright field, but its LEDs may be others
_PRIOR = np.array([*PANEL_PRIOR[:5], 0.5])
_MODEL = 1e-3            # relative error expected of the model of the light
_THIN = 4                # one block in so many gets the fit close
_ROUNDS = 2              # of it: what the wall throws depends on where the panel is
_DEAD = 0.3              # of the median of the four panels
_LIKE = 0.5              # correlation of a panel's light with that as designed
_BURNT = 0.2             # part of the plate that may be saturated
_SOFT_SHADOW = 0.05, 0.95        # part of a panel seen from a block in soft shadow
_SHADED = 100            # blocks in soft shadow tell where a panel is
_POOR_RMS, _FAILED_RMS = 0.03, 0.10      # of what is left, relative to the panel's own light
_NOT_SEEN = 0.7          # of what is known beforehand: a deviation beyond tells nothing new
PARAMETERS = 'radial', 'tangential', 'z', 'tilt_offset', 'twist', 'log_intensity'
NOMINAL = 'it keeps the geometry of the head file'


@dataclass(frozen=True)
class DarkPanel:
    """One panel.

    :param verdict: OK, POOR or FAILED; a failed one keeps its nominal geometry.
    :param reason: of one that is not OK.
    :param correction: (PER_PANEL,) shift (radial, tangential, z), tilt_offset, twist, logarithm
        of the intensity relative to the mean of the bright field; zeros if it failed.
    :param covariance: (PER_PANEL, PER_PANEL) of it: what noise does.
    :param shaded: blocks of the plate in soft shadow of the wall.
    :param residuals: (N,) measured minus fitted light, relative to the light without shadow.
    :param edge_px: what they amount to as a shift of the shadow edges.
    :param scatter: of the residuals relative to the noise expected, robust, at least 1.
    """

    verdict: str
    reason: str = ''
    correction: NDArray = field(default_factory=lambda: np.zeros(PER_PANEL))
    covariance: NDArray = field(
        default_factory=lambda: np.full((PER_PANEL, PER_PANEL), math.nan))
    shaded: int = 0
    residuals: NDArray = field(default_factory=lambda: np.zeros(0))
    edge_px: float = math.nan
    scatter: float = math.nan

    @property
    def calibrated(self) -> bool:
        """Whether the correction is better than none."""
        return self.verdict != 'FAILED'

    @property
    def deviation(self) -> NDArray:
        """Standard deviations of the correction, (PER_PANEL,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def seen(self) -> NDArray:
        """Which parameters the pictures tell, (PER_PANEL,) bool; the others stay nominal."""
        return np.asarray(self.deviation < _NOT_SEEN * _PRIOR)

    @property
    def source(self) -> str:
        """What told: 'shadows', 'plate' (the fall-off over it alone) or 'nominal' (nothing)."""
        if not self.calibrated:
            return 'nominal'
        return 'shadows' if self.shaded >= _SHADED else 'plate'

    @property
    def rms(self) -> float:
        """Of the residuals; NaN without any."""
        known = self.residuals[np.isfinite(self.residuals)]
        return float(np.sqrt(np.mean(known**2))) if known.size else math.nan


@dataclass(frozen=True)
class DarkField:
    """The four panels.

    :param verdict: OK, POOR (not all panels, or badly), FAILED (no panel) or NONE (no pictures).
    :param reason: of a verdict that is not OK.
    :param tilt: of the servo while the pictures were taken, rad.
    :param position: which stack they are in.
    :param panels: E, N, W, S.
    :param light: what was fitted.
    """

    verdict: str
    reason: str
    tilt: float = math.nan
    position: int = 0
    panels: tuple[DarkPanel, ...] = ()
    light: PlateLight | None = None

    def corrected(self, head: HeadModel) -> HeadModel:
        """The head as designed with the dark-field panels as found."""
        if not self.panels:
            return head
        return corrected(head, np.stack([panel.correction for panel in self.panels]),
                         'dark_field')

    def poses(self, head: HeadModel) -> list[PanelPose]:
        """The panels as found, E, N, W, S; a failed one as designed. None without pictures."""
        if not self.panels:
            return []
        ring = PanelRing(self.corrected(head).dark_field)
        return ring.poses(self.tilt)


NOT_REACHED = DarkField('NONE', 'the bright field comes first')


def has_dark_field(stack: Stack) -> bool:
    """Whether a stack has a picture of a single dark-field panel."""
    return any(light.mode == Mode.DARK_FIELD and light.is_equation for light in stack.lights)


def calibrate_dark_field(stacks: Sequence[Stack], captures: Sequence[Sequence[NDArray]],
                         fit: RingFit, dots_px: NDArray, head: HeadModel, target: RingTarget,
                         camera: CameraGeometry) -> DarkField:
    """Fit the panels of the dark field.

    :param stacks: the first with pictures under single dark-field panels is used.
    :param captures: the bright-field pictures of each, as from light_only.
    :param fit: of the bright field.
    :param dots_px: (F, 2) dots of the target in the bright-field pictures.
    :param head: as designed.
    """
    position = next((k for k, stack in enumerate(stacks) if has_dark_field(stack)), None)
    if position is None:
        return DarkField('NONE', 'no pictures of the dark-field panels; they keep the geometry of '
                                 'the head file')
    stack = stacks[position]
    pictures, burnt, reasons = _pictures(stack)
    tilt = next(stated_tilt(light) for light in stack.lights
                if light.mode == Mode.DARK_FIELD and light.is_equation)
    ring = PanelRing(corrected(head, fit.panels).bright_field)
    bright = ring.poses(fit.tilts[position])
    mean = float(np.mean([panel.intensity for panel in bright]))
    bright = [replace(panel, intensity=panel.intensity / mean) for panel in bright]
    light = measure_plate_light(pictures, burnt, np.sum(captures[position][:4], axis=0), bright,
                                fit.pose, target, camera, fit.glow)
    designed = np.stack([light_of(fit.pose.panel_to_target(panel), light.points, target)
                         for panel in PanelRing(head.dark_field).poses(tilt)])
    gains = np.nansum(light.values, axis=1) / np.nansum(
        np.where(np.isfinite(light.values), designed, math.nan), axis=1)
    for i, reason in enumerate(reasons):
        reasons[i] = reason or _refused(i, light, designed, gains)
        # in a picture without light no dot could be found
        if not reasons[i] and displacement(pictures[i], dots_px, target, camera) > MOVED_PX:
            reasons[i] = 'the target moved in its picture; keep head and target still'
    usual = float(np.median([gain for gain, reason in zip(gains, reasons, strict=True)
                             if not reason] or [1.0]))
    panels = tuple(
        DarkPanel('FAILED', reason) if reason
        else fit_panel(i, light, tilt, math.log(usual), fit, head, target, camera)
        for i, reason in enumerate(reasons))
    return DarkField(*_judge(panels), tilt, position, panels, light)


def _pictures(stack: Stack) -> tuple[list[NDArray], list[NDArray], list[str]]:
    """E, N, W, S without the light of the room, where they are saturated, and what is wrong."""
    pictures, burnt, reasons, room = [], [], [], room_light(stack)
    for panel in (Panel.E, Panel.N, Panel.W, Panel.S):
        reason = ''
        try:
            picture, white = without_room(stack, panel, Mode.DARK_FIELD, room)
            if white.mean() > _BURNT:
                reason = 'its picture is saturated; lower its exposure'
        except PsError:
            reason = 'its picture is missing'
            picture, white = np.zeros(stack.shape, np.float32), np.zeros(stack.shape, bool)
        pictures.append(picture)
        burnt.append(white)
        reasons.append(reason)
    return pictures, burnt, reasons


def _refused(i: int, light: PlateLight, designed: NDArray, gains: NDArray) -> str:
    """Why a panel's picture cannot be its own; empty if it can."""
    no_light = 'it gives no light, or its picture was taken without it; check its cable and LEDs'
    if not gains[i] > _DEAD * np.median(gains):
        return no_light
    known = np.isfinite(light.values[i])
    likeness = np.corrcoef(light.values[i, known], designed[:, known])[0, 1:]
    best = int(likeness.argmax())
    if likeness[best] < _LIKE:              # all are dark: noise
        return no_light
    if best != i:
        return (f'its picture shows the light of panel {DIRECTIONS[best]}; check the cables of '
                'the panels')
    return ''


def _judge(panels: Sequence[DarkPanel]) -> tuple[str, str]:
    """Of all four, with what is wrong with each."""
    reasons = [f'dark-field panel {name}: {panel.reason}'
               + ('' if panel.calibrated else f'; {NOMINAL}')
               for name, panel in zip(DIRECTIONS, panels, strict=True) if panel.reason]
    if all(panel.verdict == 'OK' for panel in panels):
        return 'OK', ''
    return ('POOR' if any(panel.calibrated for panel in panels) else 'FAILED'), '; '.join(reasons)


class _Problem:
    """Residuals of one panel's light, and their derivatives, as functions of its parameters."""

    def __init__(self, i: int, light: PlateLight, tilt: float, usual: float, pose: TargetPose,
                 head: HeadModel, target: RingTarget, part: int = 1) -> None:
        self.i, self.tilt, self.pose, self.head, self.target = i, tilt, pose, head, target
        known = np.flatnonzero(np.isfinite(light.values[i]))[::part]
        self.points, self.values = light.points[known], light.values[i, known]
        self.start = np.array([*[0.0] * 5, usual])
        free = free_light(self.panel(self.start), self.points)
        self.noise = np.hypot(light.noise[i, known], _MODEL * free)

    def panel(self, x: NDArray) -> PanelPose:
        """In the target frame."""
        rows = np.zeros((4, PER_PANEL))
        rows[self.i] = x
        ring = PanelRing(corrected(self.head, rows, 'dark_field').dark_field)
        return self.pose.panel_to_target(ring.pose(DIRECTIONS[self.i], self.tilt))

    def left(self, x: NDArray) -> NDArray:
        """Measured minus predicted, relative to the noise."""
        light = light_of(self.panel(x), self.points, self.target)
        return np.asarray((self.values - light) / self.noise)

    def equations(self, x: NDArray) -> NormalEquations:
        panel = self.panel(x)
        light, by = light_and_rates(self.points, panel, self.target.height, self.target.footprint)
        motions = rigid_motions([panel], [
            [self.panel(x + step)] for step in STEP * np.eye(PER_PANEL)[:-1]])[:, 0] / STEP
        left, slope = soft((panel.intensity * light - self.values) / (self.noise * SOFT))
        rates = np.concatenate([motions @ by[:, :6].T, light[None]])
        rates *= panel.intensity * slope / self.noise
        return NormalEquations.of(SOFT * left, rates) + NormalEquations.of(
            (x - self.start) / _PRIOR, np.diag(1 / _PRIOR))


def fit_panel(i: int, light: PlateLight, tilt: float, usual: float, bright: RingFit,
              head: HeadModel, target: RingTarget, camera: CameraGeometry) -> DarkPanel:
    """Fit one panel.

    :param i: which, 0 to 3 for E, N, W, S.
    :param light: on the plate; where a value is NaN, the block is not used.
    :param tilt: of the servo, rad.
    :param usual: logarithm of the intensity to start from.
    :param bright: fit of the bright field: it tells the target's pose and the wall's light.
    :param head: as designed.
    """
    place = (i, light, tilt, usual, bright.pose, head, target)
    thin, problem = _Problem(*place, part=_THIN), _Problem(*place)
    measured, x = thin.values, thin.start
    for _ in range(_ROUNDS):
        thin.values = measured - bright.glow * wall_glow(thin.points, [thin.panel(x)], target)[0]
        x, _ = minimise(thin.equations, x)
    # what averaging over a block adds to the light in its middle, and what the wall throws there
    known = np.isfinite(light.values[i])
    panel = problem.panel(x)
    problem.values = problem.values - (
        mean_light(panel, light.corners, target)[known] - light_of(panel, problem.points, target)
    ) - bright.glow * wall_glow(problem.points, [panel], target)[0]
    x, equations = minimise(problem.equations, x)
    panel, left = problem.panel(x), problem.left(x)
    scatter = max(1.4826 * float(np.median(abs(left))), 1.0)
    covariance = equations.covariance() * scatter**2
    free = free_light(panel, problem.points)
    seen = light_of(panel, problem.points, target) / free
    shaded = int(np.sum((seen > _SOFT_SHADOW[0]) & (seen < _SOFT_SHADOW[1])))
    residuals = np.full(len(known), math.nan)
    residuals[known] = left * problem.noise / free
    pitch = camera.camera_standoff / camera.fx
    found = DarkPanel('OK', '', x, covariance, shaded, residuals,
                      _edge(problem, panel, left) / pitch, scatter)
    astray = out_of_place(x[:5])
    if found.rms > _FAILED_RMS or astray:
        return DarkPanel('FAILED', 'it would be far out of its place; check its mounting' if astray
                         else f'its shadows do not fit (residual {found.rms:.3f})',
                         residuals=residuals, shaded=shaded)
    if found.rms > _POOR_RMS:
        return replace(found, verdict='POOR', reason=f'its light fits badly (residual '
                       f'{found.rms:.3f}); clean the target and keep other light away')
    return found


def _edge(problem: _Problem, panel: PanelPose, left: NDArray) -> float:
    """What is left, as a shift of the shadow edges, m."""
    _, by = light_and_rates(problem.points, panel, problem.target.height,
                            problem.target.footprint)
    steep = panel.intensity * np.hypot(by[:, 6], by[:, 7]) / problem.noise
    edges = steep > 0.3 * steep.max()
    return float(np.sqrt(np.sum(left[edges]**2) / np.sum(steep[edges]**2)))
