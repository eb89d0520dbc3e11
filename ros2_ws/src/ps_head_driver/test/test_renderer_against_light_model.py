"""Renderer and closed-form light model share no code, so that their agreement means something."""
import math

import numpy as np
import pytest

from ps_head_driver.fake.renderer import Sensor, make_renderer
from ps_head_driver.head_model import load_head, nominal_head_path
from ps_head_driver.kinematics import BrightFieldKinematics, lights_at
from ps_head_driver.light_model import light_vectors
from ps_head_driver.stack import Mode

HEAD = load_head(nominal_head_path())


@pytest.mark.parametrize('m_counts', [0, 25000])
def test_matt_plate(m_counts):
    df_tilt = 1.3
    renderer = make_renderer('tilted_plate', HEAD, Sensor(noise=False), scale=0.05)
    points = np.moveaxis(renderer._points[:3].reshape(3, *renderer.shape), 0, -1).astype(float)
    normal = renderer.truth().normal
    tilt = float(BrightFieldKinematics(HEAD).tilt(m_counts))
    singles = [light for light in lights_at(HEAD, m_counts, df_tilt) if light.is_equation]
    assert len(singles) == 8
    for light in singles:
        levels, off = np.eye(4)[light.panel], np.zeros(4)
        bright = light.mode is Mode.BRIGHT_FIELD
        rendered = renderer.radiance(
            tilt, df_tilt, levels if bright else off, off if bright else levels)
        expected = 0.8 / math.pi * np.sum(light_vectors(light, points) * normal, axis=-1)
        np.testing.assert_allclose(rendered, expected, rtol=5e-5)
