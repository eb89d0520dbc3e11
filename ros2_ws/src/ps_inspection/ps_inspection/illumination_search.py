"""Choose the ring of panels and the convergence radius with few captures.

A search by branch and bound: light adds linearly, so the consensus of the pictures taken so far
predicts the least error of every setting (illumination_score.py). What was found beyond that at
the settings tried (gloss, cast shadows) changes only gradually with the tilt of the panels. A
setting is tried only while it could, on these terms, beat the best one by a worthwhile amount.
"""
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.light_model import light_vectors
from ps_head_driver.stack import Light, Mode, Stack
from ps_inspection.illumination_score import (
    Blocks,
    Consensus,
    Region,
    consensus,
    error_of,
    least_error,
    reduce_stack,
)

BUDGET = 6
WORTHWHILE = 0.03         # relative gain that is worth a capture
REACH = np.radians(20)    # of tilt, over which gloss and cast shadows may vanish at best
BOUND_BLOCKS = 1500       # that a prediction looks at


@dataclass(frozen=True)
class Setting:
    """One illumination that can be chosen.

    :param convergence_radius: m.
    :param tilt: of the panels, rad.
    :param lights: the four panels there, E N W S.
    """

    mode: Mode
    convergence_radius: float
    tilt: float
    lights: tuple[Light, ...]


@dataclass(frozen=True)
class Probe:
    """A setting with its stack."""

    setting: Setting
    blocks: Blocks


class IlluminationSearch:
    """Asks for one stack after the other: ``next()``, take it, ``add()``, until it says None.

    :param settings: to choose from.
    :param budget: captures at most.
    :raises PsError: INSPECTION_BAD_REQUEST without settings or budget.
    """

    def __init__(self, settings: Sequence[Setting], budget: int = BUDGET,
                 region: Region = Region()) -> None:  # noqa: B008
        if not settings or budget < 1:
            raise PsError(ErrorCode.INSPECTION_BAD_REQUEST,
                          'a search needs at least one setting and a budget of one capture')
        self.settings, self.budget, self.region = list(settings), budget, region
        self.probes: list[Probe] = []

    def next(self) -> Setting | None:
        """The setting to take a stack of now; None when more would not help."""
        tried = {id(probe.setting) for probe in self.probes}
        open_settings = [s for s in self.settings if id(s) not in tried]
        if not open_settings or len(self.probes) >= self.budget:
            return None
        # each ring once: what one cannot see of its own errors, the other shows
        seen = {probe.setting.mode for probe in self.probes}
        unseen = [s for s in open_settings if s.mode not in seen]
        if unseen:
            return min(unseen, key=self.least_error)
        predicted = [self.predicted_error(s) for s in open_settings]
        best = int(np.argmin(predicted))
        # nor does a setting of a single ring see its own errors without another to compare with
        compared = len(self.probes) > 1
        if compared and predicted[best] > (1 - WORTHWHILE) * min(self.errors):
            return None
        return open_settings[best]

    def add(self, setting: Setting, stack: Stack) -> None:
        """Take in the stack of a setting.

        :raises PsError: RECONSTRUCTION_* if it cannot be used, INSPECTION_BAD_REQUEST for a region
            outside the picture.
        """
        blocks = reduce_stack(stack, self.region)
        if self.probes and len(blocks.values) != len(self.probes[0].blocks.values):
            raise PsError(ErrorCode.RECONSTRUCTION_BAD_STACK,
                          'the pictures of the probes are not of one size')
        self.probes.append(Probe(setting, blocks))
        for name in ('consensus', 'errors'):
            self.__dict__.pop(name, None)

    @cached_property
    def consensus(self) -> Consensus:
        """Of all probes so far."""
        return consensus([probe.blocks for probe in self.probes])

    @cached_property
    def errors(self) -> list[float]:
        """Expected angular error of the normals of each probe, as now known, rad."""
        return [error_of(probe.blocks, self.consensus.normals) for probe in self.probes]

    @property
    def best(self) -> Setting:
        """The best setting tried."""
        return self.probes[int(np.argmin(self.errors))].setting

    @property
    def last_shares(self) -> tuple[float, float]:
        """Shares of shadowed and of saturated values in the last probe."""
        blocks = self.probes[-1].blocks
        return float(blocks.shadowed.mean()), float(blocks.saturated.mean())

    def least_error(self, setting: Setting) -> float:
        """Error of a setting from noise and attached shadows alone, rad; before any probe in
        arbitrary units, for a flat part.
        """
        if not self.probes:
            flat, centre = np.array([[0.0, 0.0, 1.0]]), np.zeros((1, 3))
            return least_error(_vectors(setting, centre), flat, 1.0)
        # the brightness that this ring was found to have
        index = max((i for i, probe in enumerate(self.probes)
                     if probe.setting.mode == setting.mode), default=0)
        blocks = self.probes[index].blocks
        some = slice(None, None, -(-len(blocks.points) // BOUND_BLOCKS))
        return least_error(
            _vectors(setting, blocks.points[some]) / blocks.brightness,
            self.consensus.gains[index] * self.consensus.normals[some], blocks.noise)

    def predicted_error(self, setting: Setting) -> float:
        """The least that is to be expected of a setting, rad."""
        near = sorted((probe.setting.tilt, error ** 2 - self.least_error(probe.setting) ** 2)
                      for probe, error in zip(self.probes, self.errors, strict=True)
                      if probe.setting.mode == setting.mode)
        tilts, excess = (np.array(values) for values in zip(*near, strict=True))
        beyond = np.sqrt(max(float(np.interp(setting.tilt, tilts, excess)), 0.0))
        beyond *= max(0.0, 1 - float(np.abs(tilts - setting.tilt).min()) / REACH)
        return float(np.hypot(self.least_error(setting), beyond))


def _vectors(setting: Setting, points: np.ndarray) -> np.ndarray:
    return np.stack([light_vectors(light, points) for light in setting.lights], axis=-2)
