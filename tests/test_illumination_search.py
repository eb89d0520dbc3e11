"""The illumination search against scenes whose truth is known; the bench has the whole table."""
from dataclasses import replace

from bench.bench_illumination_search import HEAD, SCALE, measure, settings, take
import numpy as np
import pytest

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.fake.renderer import Sensor, make_renderer
from ps_head_driver.stack import Mode, angular_error_deg
from ps_inspection.illumination_score import Region, consensus, reduce_stack
from ps_inspection.illumination_search import IlluminationSearch
from ps_reconstruction.pipeline import reconstruct

CHOICES = settings(7)
DARK = CHOICES[-1]


@pytest.mark.parametrize(('scene', 'ring'), [
    ('scratches', Mode.DARK_FIELD),                        # gloss: grazing light sees less of it
    ('boss:height=0.004,slope=0.7', Mode.BRIGHT_FIELD),    # steep: grazing light leaves shadows
])
def test_search_finds_what_an_exhaustive_sweep_finds(scene, ring):
    both, bright = measure(scene, CHOICES)
    assert both['found'].mode == ring
    assert both['regret'] < 0.05
    assert bright['regret'] < 0.05
    assert max(both['probes'], bright['probes']) <= 6
    # what it expects is about what comes out
    assert both['expected'] == pytest.approx(both['error'], rel=0.5)


def test_matt_part_needs_a_picture_of_each_ring_only():
    renderer = make_renderer('plate', HEAD, scale=SCALE)
    search = IlluminationSearch(CHOICES)
    while (setting := search.next()) is not None:
        search.add(setting, take(renderer, setting, len(search.probes)))
    assert len(search.probes) == 2
    assert search.best.mode == Mode.DARK_FIELD       # the steeper light, the less noise


def test_noise_is_measured_from_the_pictures():
    sensor = Sensor(bit_depth=16)
    stack = take(make_renderer('copper', HEAD, sensor, scale=SCALE), CHOICES[0], 0)
    # electrons at full scale give the shot noise of a value of 1
    assert reduce_stack(stack).noise == pytest.approx(sensor.full_well ** -0.5, rel=0.1)


def test_rings_need_not_be_calibrated_against_each_other():
    renderer = make_renderer('scratches', HEAD, Sensor(bit_depth=16), scale=SCALE)
    bright, dark = (take(renderer, setting, 1) for setting in (CHOICES[0], DARK))
    dimmer = replace(dark, images=[(image * 0.6).astype(image.dtype) for image in dark.images])
    normals = [consensus([reduce_stack(bright), reduce_stack(other)]) for other in (dark, dimmer)]
    assert normals[1].gains[1] == pytest.approx(0.6 * normals[0].gains[1], rel=0.01)
    unit = [c.normals / np.linalg.norm(c.normals, axis=-1, keepdims=True) for c in normals]
    assert np.degrees(np.arccos(np.clip(np.sum(unit[0] * unit[1], axis=-1), -1, 1))).mean() < 0.05


@pytest.mark.parametrize('bits', [8, 12])
def test_saturated_and_shadowed_shares_are_reported(bits: int):
    search = IlluminationSearch(CHOICES)
    stack = take(make_renderer('dome:height=0.008', HEAD, scale=SCALE), DARK, 0)
    white = replace(stack, images=[np.where(image > 60, 255, image).astype(np.uint8)
                                   for image in stack.images])
    if bits == 12:      # as the cameras deliver them: in the upper bits of 16
        white = replace(white, images=[
            np.round(image / 255 * 4095).astype(np.uint16) << 4 for image in white.images])
    search.add(DARK, white)
    shadowed, saturated = search.last_shares
    truth = np.mean([image > 60 for image in stack.images])
    assert saturated == pytest.approx(truth, abs=0.01)
    assert 0.02 < shadowed < 0.4


def test_what_cannot_be_used_is_refused():
    stack = take(make_renderer('plate', HEAD, scale=0.1), DARK, 0)
    for region in (Region(100, 0, 60, 60), Region(0, 0, 8, 8), Region(-5, 0, 50, 50)):
        with pytest.raises(PsError, match='roi') as error:
            reduce_stack(stack, region)
        assert error.value.code == ErrorCode.INSPECTION_BAD_REQUEST
    with pytest.raises(PsError, match='camera'):
        reduce_stack(replace(stack, camera=None))
    with pytest.raises(PsError):
        IlluminationSearch([], 6)
    search = IlluminationSearch(CHOICES)
    search.add(DARK, stack)
    with pytest.raises(PsError, match='one size'):
        search.add(CHOICES[0], take(make_renderer('plate', HEAD, scale=0.2), CHOICES[0], 0))


def test_region_decides():
    """A steep boss in a wide flat plate: the plate's best light is not the boss's."""
    renderer = make_renderer('boss:height=0.004,slope=0.7', HEAD, scale=SCALE)
    height, width = renderer.shape
    corner = Region(0, 0, width // 4, height // 4)
    search = IlluminationSearch(CHOICES, region=corner)
    while (setting := search.next()) is not None:
        search.add(setting, take(renderer, setting, len(search.probes)))
    assert search.best.mode == Mode.DARK_FIELD


def test_one_ring_alone_is_compared_with_itself():
    """The rim of the dome lies in shadow at the CR of the least noise, which that cannot tell."""
    renderer = make_renderer('dome:height=0.006', HEAD, scale=SCALE)
    bright = [setting for setting in CHOICES if setting.mode == Mode.BRIGHT_FIELD]
    found = {}
    for budget in (1, 6):
        search = IlluminationSearch(bright, budget)
        while (setting := search.next()) is not None:
            search.add(setting, take(renderer, setting, len(search.probes)))
        found[budget] = search.best
    error = {budget: np.nanmean(angular_error_deg(
        reconstruct(take(renderer, setting, 99), outputs={'normal'}).normal,
        renderer.truth().normal)) for budget, setting in found.items()}
    assert error[6] < 0.95 * error[1]
