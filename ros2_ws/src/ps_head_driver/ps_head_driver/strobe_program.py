"""Strobe programs in the terms of panels and seconds, and the light that each step really made."""
from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.protocol import FULL_LEVEL, Step, StepRecord
from ps_head_driver.stack import Light, Mode, Panel, panel_name

LONGEST_S = 60.0
_NOWHERE = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class StrobeStep:
    """One step as asked for; fields of ps_interfaces/StrobeStep, seconds."""

    mode: Mode
    panel: Panel
    intensity: float
    settle: float
    strobe_duration: float
    period: float

    @property
    def name(self) -> str:
        """'BF_E', 'DF_ALL', 'BOTH_N', ... or 'NONE'."""
        if self.panel is Panel.NONE:
            return 'NONE'
        return panel_name(self.mode, self.panel)

    @property
    def mask(self) -> int:
        """Panels of the step as in the wire protocol."""
        if self.panel is Panel.NONE:
            return 0
        ring = 0xF if self.panel is Panel.ALL else 1 << self.panel
        return (ring if self.mode != Mode.DARK_FIELD else 0) | (
            ring << 4 if self.mode != Mode.BRIGHT_FIELD else 0)


def parse_step(index: int, mode: int, panel: int, intensity: float, settle: float,
               strobe_duration: float, period: float) -> StrobeStep:
    """Check the fields of one requested step.

    :raises PsError: HEAD_BAD_REQUEST naming step and field.
    """
    def refuse(field: str, value: object, allowed: str) -> PsError:
        return PsError(ErrorCode.HEAD_BAD_REQUEST,
                       f'steps[{index}].{field}: {value} is not {allowed}')

    if mode not in Mode._value2member_map_:
        raise refuse('mode', mode, 'BRIGHT_FIELD, DARK_FIELD or BOTH')
    if panel not in Panel._value2member_map_:
        raise refuse('panel', panel, 'E, N, W, S, ALL or NONE')
    if not 0 <= intensity <= 1:                     # also refuses NaN
        raise refuse('intensity', intensity, 'within 0 to 1')
    for field, value in (('settle', settle), ('period', period)):
        if not 0 <= value <= LONGEST_S:
            raise refuse(field, value, f'within 0 to {LONGEST_S:g} s')
    if not 1e-6 <= strobe_duration <= LONGEST_S:
        raise refuse('strobe_duration', strobe_duration, f'within 1e-6 to {LONGEST_S:g} s')
    return StrobeStep(Mode(mode), Panel(panel), intensity, settle, strobe_duration, period)


def encode_steps(steps: Sequence[StrobeStep]) -> list[Step]:
    """The program in the board's units."""
    return [Step(step.mask, round(step.intensity * FULL_LEVEL), round(step.settle * 1e6),
                 max(1, round(step.strobe_duration * 1e6)), round(step.period * 1e6))
            for step in steps]


def light_of(step: StrobeStep, record: StepRecord, panels: Sequence[Light]) -> Light:
    """The light of one step as the board had it.

    :param record: what the board did.
    :param panels: lights_at() the position where it did it: BF E N W S, DF E N W S.
    :returns: geometry of the panel; zero geometry where several panels or none were on.
    """
    dark = step.mode is Mode.DARK_FIELD
    levels = [level / FULL_LEVEL for level in record.levels]
    if step.panel in (Panel.ALL, Panel.NONE) or step.mode is Mode.BOTH:
        base = Light(position=_NOWHERE, axis=_NOWHERE, right=_NOWHERE,
                     tilt=panels[4 if dark else 0].tilt, intensity=max(levels))
    else:
        index = step.panel + (4 if dark else 0)
        nominal = panels[index].intensity
        assert isinstance(nominal, float)
        base = replace(panels[index], intensity=nominal * levels[index])
    return replace(
        base, name=step.name, mode=step.mode, panel=step.panel, motor_counts=record.motor_counts,
        strobe_duration=record.strobe_us * 1e-6, strobe_counter=record.strobe_counter,
        device_time_ns=record.time_us * 1000)


def check_intensities(values: Sequence[float]) -> None:
    """Refuse intensities that are not none or eight values within 0 to 1.

    :raises PsError: HEAD_BAD_REQUEST.
    """
    if len(values) not in (0, 8):
        raise PsError(ErrorCode.HEAD_BAD_REQUEST,
                      f'intensities: {len(values)} values; give 8 (BF E N W S, DF E N W S) or '
                      'none')
    for i, value in enumerate(values):
        if not (math.isfinite(value) and 0 <= value <= 1):
            raise PsError(ErrorCode.HEAD_BAD_REQUEST,
                          f'intensities[{i}]: {value} is not within 0 to 1')
