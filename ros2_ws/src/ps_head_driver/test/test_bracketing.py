"""Bracketed exposures become one linear frame with a wider range."""
import numpy as np
import pytest

from ps_head_driver.bracketing import FULL_SCALE, merge

EXPOSURES = (0.001, 0.004, 0.016)


def taken(light, exposure, bits=8, rng=None):
    """What a linear camera makes of light that fills its range in 1 ms where it is 1."""
    full = (1 << bits) - 1
    electrons = light * exposure / 0.001 * 10_000
    if rng is not None:
        electrons = rng.poisson(electrons)
    return np.clip(np.rint(electrons / 10_000 * full), 0, full).astype(
        np.uint8 if bits == 8 else np.uint16)


@pytest.mark.parametrize('bits', [8, 16])
def test_merged_is_linear_over_the_whole_range(bits):
    light = np.geomspace(1e-4, 0.97, 400).reshape(20, 20)
    merged = merge([taken(light, e, bits) for e in EXPOSURES], EXPOSURES)
    assert merged.dtype == np.uint16
    step = 65535 / ((1 << bits) - 1)       # one grey value of the shortest exposure
    # just above the range of a longer exposure the shorter one has 60 grey values left
    np.testing.assert_allclose(merged, light * FULL_SCALE, rtol=0.5 / 60 * step / 257 + 5e-3,
                               atol=max(step / 16, 1.0))


def test_order_of_the_exposures_does_not_matter():
    light = np.linspace(0, 1.5, 100).reshape(10, 10)
    frames = [taken(light, e) for e in EXPOSURES]
    np.testing.assert_array_equal(
        merge(frames, EXPOSURES), merge(frames[::-1], EXPOSURES[::-1]))


def test_saturated_everywhere_stays_saturated():
    light = np.array([[0.5, 0.99, 1.0, 20.0]])
    merged = merge([taken(light, e) for e in EXPOSURES], EXPOSURES)
    assert (merged == FULL_SCALE).tolist() == [[False, True, True, True]]


def test_dark_parts_gain_from_the_long_exposures():
    rng = np.random.default_rng(1)
    light = np.full((100, 100), 0.01)
    frames = [taken(light, e, rng=rng) for e in EXPOSURES]
    merged = merge(frames, EXPOSURES) / FULL_SCALE
    alone = frames[0] / 255
    assert merged.mean() == pytest.approx(0.01, rel=0.01)
    assert merged.std() < 0.3 * alone.std()


def test_colours_are_merged_each_by_itself():
    light = np.zeros((4, 4, 3))
    light[...] = (0.9, 0.1, 0.01)
    merged = merge([taken(light, e) for e in EXPOSURES], EXPOSURES)
    np.testing.assert_allclose(merged / FULL_SCALE, light, rtol=0.02, atol=3e-4)
