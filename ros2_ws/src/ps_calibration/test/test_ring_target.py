"""Target files: what they must hold, and what they are refused for."""
import numpy as np
import pytest
import yaml

from ps_calibration.ring_target import RingTarget, default_target_path, load_target
from ps_head_driver.errors import ErrorCode, PsError


@pytest.fixture
def content() -> dict:
    return yaml.safe_load(default_target_path().read_text())


def test_distance_is_zero_under_the_wall_and_grows_from_its_faces() -> None:
    target = load_target(default_target_path())
    x = np.array([0.011, 0.0, 0.0, 0.0, 0.014, 0.011])
    y = np.array([0.0, 0.011, 0.008, 0.015, 0.0, -0.003])
    assert target.distance(x, y) == pytest.approx([0, 0, 0.002, 0.003, 0.002, 0.003])


@pytest.mark.parametrize(('change', 'named'), [
    ({'inner_radius': 0.013}, 'inner_radius'),
    ({'arc': [0.0, 4.0]}, 'arc'),
    ({'slits': {'azimuths': [4.0], 'width': 0.001}}, 'azimuths'),
    ({'height': -1.0}, 'height'),
    ({'colour': 'blue'}, 'colour'),
])
def test_an_impossible_target_is_refused_by_name(
        content: dict, change: dict, named: str, tmp_path) -> None:
    path = tmp_path / 'target.yaml'
    path.write_text(yaml.safe_dump({**content, **change}))
    with pytest.raises(PsError, match=named) as refused:
        load_target(path)
    assert refused.value.code is ErrorCode.CALIBRATION_BAD_REQUEST
    assert str(path) in refused.value.message


@pytest.mark.parametrize(('centres', 'reason'), [
    ([[-0.02, -0.015], [0.02, -0.015], [-0.02, 0.015], [0.02, 0.015], [0.0, 0.0]], 'mirrored'),
    ([[-0.02, -0.015], [0.02, -0.015], [-0.02, 0.015], [0.02, 0.015], [0.0, 0.011]], 'under'),
    ([[-0.02, -0.015], [0.02, -0.015], [-0.02, 0.015], [0.02, 0.015], [0.04, 0.0]], 'fit'),
])
def test_dots_that_cannot_serve_are_refused(
        content: dict, centres: list, reason: str) -> None:
    content['fiducials']['centres'] = centres
    with pytest.raises(ValueError, match=reason):
        RingTarget.model_validate(content)
