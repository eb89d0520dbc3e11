"""Steps in panels and seconds to the board's units, and records to lights."""
import math
from typing import Any

import pytest

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.head_model import load_head, nominal_head_path
from ps_head_driver.kinematics import lights_at
from ps_head_driver.protocol import FULL_LEVEL, StepRecord
from ps_head_driver.stack import Mode, Panel
from ps_head_driver.strobe_program import (
    StrobeStep,
    check_intensities,
    encode_steps,
    light_of,
    parse_step,
)


@pytest.mark.parametrize(('mode', 'panel', 'mask', 'name'), [
    (Mode.BRIGHT_FIELD, Panel.E, 0x01, 'BF_E'), (Mode.BRIGHT_FIELD, Panel.S, 0x08, 'BF_S'),
    (Mode.DARK_FIELD, Panel.N, 0x20, 'DF_N'), (Mode.BOTH, Panel.W, 0x44, 'BOTH_W'),
    (Mode.BRIGHT_FIELD, Panel.ALL, 0x0F, 'BF_ALL'), (Mode.DARK_FIELD, Panel.ALL, 0xF0, 'DF_ALL'),
    (Mode.BOTH, Panel.ALL, 0xFF, 'BOTH_ALL'), (Mode.BOTH, Panel.NONE, 0x00, 'NONE')])
def test_masks_and_names(mode: Mode, panel: Panel, mask: int, name: str) -> None:
    step = parse_step(0, mode, panel, 0.5, 0.002, 0.004, 0.0167)
    assert (step.mask, step.name) == (mask, name)
    encoded, = encode_steps([step])
    assert encoded.panels == mask
    assert (encoded.settle_us, encoded.strobe_us, encoded.period_us) == (2000, 4000, 16700)
    assert encoded.level == pytest.approx(FULL_LEVEL / 2, abs=1)


@pytest.mark.parametrize(('field', 'value'), [
    ('mode', 3), ('panel', 6), ('intensity', -0.1), ('intensity', math.nan), ('settle', 61.0),
    ('strobe_duration', 0.0), ('strobe_duration', math.nan), ('period', -1.0)])
def test_bad_fields_are_named(field: str, value: Any) -> None:
    fields: dict[str, Any] = {'mode': 0, 'panel': 0, 'intensity': 1.0, 'settle': 0.0,
                              'strobe_duration': 0.01, 'period': 0.0, field: value}
    with pytest.raises(PsError, match=rf'steps\[3\]\.{field}') as error:
        parse_step(3, **fields)
    assert error.value.code is ErrorCode.HEAD_BAD_REQUEST


def test_lights_carry_what_the_board_did() -> None:
    panels = lights_at(load_head(nominal_head_path()), 25000, 1.3)
    record = StepRecord(0, 17, 18, 5_000_000, 3999, 25001, (0, 0, 0, 0, 0, 32768, 0, 0))
    light = light_of(StrobeStep(Mode.DARK_FIELD, Panel.N, 1, 0, 0.004, 0), record, panels)
    assert light.is_equation
    assert light.position == panels[5].position
    assert light.tilt == pytest.approx(1.3)
    assert light.intensity == pytest.approx(0.5, abs=1e-4)
    assert (light.motor_counts, light.strobe_counter) == (25001, 17)
    assert light.device_time_ns == 5_000_000_000
    assert light.strobe_duration == pytest.approx(3.999e-3)
    for mode, panel in ((Mode.BRIGHT_FIELD, Panel.ALL), (Mode.BOTH, Panel.E),
                        (Mode.BRIGHT_FIELD, Panel.NONE)):
        light = light_of(StrobeStep(mode, panel, 1, 0, 0.004, 0), record, panels)
        assert not light.is_equation
        assert light.position == light.axis == light.right == (0, 0, 0)
        assert light.tilt == panels[0].tilt


def test_intensities() -> None:
    check_intensities([])
    check_intensities([0.0, 1.0] * 4)
    for wrong in ([1.0] * 7, [1.0] * 7 + [1.1], [1.0] * 7 + [math.nan]):
        with pytest.raises(PsError, match='intensities'):
            check_intensities(wrong)
