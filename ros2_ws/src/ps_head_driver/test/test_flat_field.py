"""Flat fields: gain maps, and the lights that they are good for."""
from dataclasses import replace

import numpy as np
import pytest

from ps_head_driver.errors import PsError
from ps_head_driver.flat_field import TOLERANCE_COUNTS, gain_map, make_flat_field
from ps_head_driver.stack import Light, Panel


def test_gain_map_is_the_mean_without_ambient_at_reduced_size():
    rng = np.random.default_rng(0)
    truth = np.linspace(50, 150, 64)[None, :].repeat(48, 0)
    images = [(truth + 20 + rng.normal(0, 2, truth.shape)).astype(np.uint8) for _ in range(8)]
    gain = gain_map(images, np.full(truth.shape, 20, np.uint8), 12)
    assert gain.shape == (12, 16)
    assert gain.dtype == np.float32
    np.testing.assert_allclose(gain, truth.reshape(12, 4, 16, 4).mean((1, 3)), atol=1.0)


def test_gain_map_of_a_dark_corner_stays_positive():
    image = np.zeros((32, 32), np.uint8)
    image[:16] = 200
    assert gain_map([image], None, 8).min() > 0


def test_maps_are_per_unit_of_light_and_only_for_the_illumination_they_were_taken_with():
    lights = [Light(panel=Panel.E, exposure_time=0.002, motor_counts=100),
              Light(panel=Panel.W, exposure_time=0.004, motor_counts=100)]
    rounds = [[np.full((32, 40), 50, np.uint8), np.full((32, 40), 100, np.uint8)]] * 2
    flat = make_flat_field('flat-1', lights, rounds, None, 16)
    east, west = flat.for_lights([lights[0], replace(lights[1], intensity=0.5)])
    np.testing.assert_allclose(east, 1.0, rtol=1e-6)      # twice the time, twice the counts
    np.testing.assert_allclose(west, 0.5, rtol=1e-6)
    assert flat.for_lights([replace(lights[0], motor_counts=101 + TOLERANCE_COUNTS)]) == []
    assert flat.for_lights([Light(panel=Panel.N, motor_counts=100)]) == []


def test_a_light_of_several_panels_has_no_flat_field():
    rounds = [[np.ones((32, 32), np.uint8)]]
    with pytest.raises(PsError, match='single panels'):
        make_flat_field('flat-1', [Light(panel=Panel.ALL)], rounds, None, 8)
