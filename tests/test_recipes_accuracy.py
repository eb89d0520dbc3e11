"""Every kind of recipe on rendered pictures: the stack is right, its normals meet the truth."""
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ps_head_driver.acquisition import Settings
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.fake.cell import FakeCell, fake_cell
from ps_head_driver.fake.renderer import Sensor
from ps_head_driver.stack import Stack, angular_error_deg
from ps_reconstruction.pipeline import Options, reconstruct

SCALE = 0.2
BRIGHT = [{'panel': panel} for panel in 'ENWS']
DARK = [{'panel': panel, 'mode': 'DARK_FIELD'} for panel in 'ENWS']


@pytest.fixture(scope='module')
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FakeCell]:
    """A shallow dome in a bright room."""
    with fake_cell(tmp_path_factory.mktemp('cell'), 'dome', SCALE,
                   Sensor(ambient=0.1)) as cell:
        yield cell


@pytest.fixture(autouse=True)
def default_settings(cell: FakeCell) -> None:
    cell.settings = Settings()


def error_deg(cell: FakeCell, stack: Stack) -> float:
    """Median angle between normals of a stack and the truth."""
    normal = reconstruct(stack, Options(), {'normal'}).normal
    truth = cell.camera.renderer.truth().normal
    return float(np.nanmedian(angular_error_deg(normal, truth)))


@pytest.mark.parametrize(('recipe', 'names', 'limit'), [
    ({'steps': BRIGHT, 'ambient': True}, 'BF_E BF_N BF_W BF_S', 1.0),
    ({'steps': DARK, 'exposure': 0.006, 'ambient': True}, 'DF_E DF_N DF_W DF_S', 3.0),
    ({'steps': BRIGHT + DARK, 'ambient': True},
     'BF_E BF_N BF_W BF_S DF_E DF_N DF_W DF_S', 2.0),
    ({'steps': [{**step, 'convergence_radius': radius} for radius in (0.08, 0.03)
                for step in BRIGHT], 'ambient': True},
     'BF_E BF_N BF_W BF_S BF_E BF_N BF_W BF_S', 1.0),
    ({'steps': [{**step, 'exposure': 0.001 * (1 + i)} for i, step in enumerate(BRIGHT)]},
     'BF_E BF_N BF_W BF_S', 6.0),
], ids=['bright field', 'dark field', 'both', 'two CR', 'own exposures'])
@pytest.mark.parametrize('hardware', [True, False], ids=['hardware', 'host'])
def test_recipe(cell: FakeCell, recipe: dict[str, Any], names: str, limit: float, hardware: bool):
    cell.settings = Settings(hardware=hardware, host_margin=0.3)
    stack = cell.stack(recipe)
    assert [light.name for light in stack.lights] == names.split()
    if stack.ambient is not None:
        assert stack.ambient.mean() == pytest.approx(
            255 * 0.1 * cell.camera.renderer.albedo.mean() * stack.lights[0].exposure_time / 0.004,
            rel=0.05)
    assert error_deg(cell, stack) < limit
    for light in stack.lights:
        assert light.exposure_time == pytest.approx(
            min(light.exposure_time, light.strobe_duration))
        assert light.position != (0, 0, 0)


def test_two_cr_in_one_stack_have_two_geometries(cell: FakeCell):
    stack = cell.stack({'steps': [
        {'panel': panel, 'convergence_radius': radius} for radius in (0.08, 0.03)
        for panel in 'ENWS']})
    wide, narrow = stack.lights[0], stack.lights[4]
    assert wide.motor_counts < narrow.motor_counts
    assert wide.position != narrow.position
    # taken one by one they are the same, within the noise of the motor's position
    alone = cell.stack({'steps': [{'panel': 'E', 'convergence_radius': 0.03}]}).lights[0]
    assert alone.motor_counts == pytest.approx(narrow.motor_counts, abs=4)
    assert alone.position == pytest.approx(narrow.position, abs=1e-6)


def test_bracket_is_linear_and_knows_its_saturation(cell: FakeCell):
    """Four times too bright for one exposure: the bracket has what a shorter exposure has."""
    short = cell.stack({'steps': BRIGHT, 'exposure': 0.002, 'ambient': True})
    stack = cell.stack({'steps': BRIGHT, 'exposure': 0.002, 'bracket': [1, 4, 16],
                        'ambient': True})
    burnt = cell.stack({'steps': BRIGHT, 'exposure': 0.032, 'ambient': True})
    assert stack.images[0].dtype == np.uint16
    assert [light.exposure_time for light in stack.lights] == [0.002] * 4
    assert np.mean(burnt.images[0] == 255) > 0.5
    assert np.mean(stack.images[0] > 0.98 * 65535) < 0.01
    # the same light, with less noise
    for merged, image in zip(stack.images, short.images, strict=True):
        assert merged.mean() / 65535 == pytest.approx(image.mean() / 255, rel=0.01)
    assert error_deg(cell, stack) < min(1.0, error_deg(cell, short) + 0.05)
    assert error_deg(cell, burnt) > 3 * error_deg(cell, stack)


def test_panels_that_move_within_a_program_are_refused(cell: FakeCell,
                                                       monkeypatch: pytest.MonkeyPatch):
    from ps_head_driver.fake import cell as fake

    def moving(*arguments: Any):
        lights = run(*arguments)
        return [replace(light, motor_counts=light.motor_counts + 3 * i)
                for i, light in enumerate(lights)]

    run = fake.ClientHead.run
    monkeypatch.setattr(fake.ClientHead, 'run', moving)
    with pytest.raises(PsError, match='moved by 9 counts') as error:
        cell.stack({'steps': BRIGHT})
    assert error.value.code == ErrorCode.SEQUENCER_MOTION


def test_a_light_that_may_have_gone_off_too_soon_is_refused(cell: FakeCell):
    cell.settings = Settings(hardware=False, host_margin=0.02)
    with pytest.raises(PsError, match='host_margin') as error:
        cell.stack({'steps': BRIGHT, 'exposure': 0.1})
    assert error.value.code == ErrorCode.SEQUENCER_FRAME_MISMATCH
