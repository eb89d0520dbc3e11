"""Parameters of all nodes: each says what it is, in which unit and range."""
import importlib
import math

import pytest

from ps_head_driver.ros_support import Parameter
from ps_inspection.graph import NODES

ALL = [(node.executable, parameter) for node in NODES for parameter in
       importlib.import_module(f'{node.package}.nodes.{node.executable}').PARAMETERS]


@pytest.mark.parametrize(('node', 'parameter'), ALL, ids=lambda x: getattr(x, 'name', x))
def test_parameter_is_described_and_numbers_have_a_range(node: str, parameter: Parameter):
    assert len(parameter.description) > 5
    assert parameter.check(parameter.default) == ''
    if isinstance(parameter.default, bool | str | list | tuple):
        return
    assert parameter.choices or parameter.minimum is not None or parameter.maximum is not None
    descriptor = parameter.descriptor()
    assert descriptor.additional_constraints or descriptor.floating_point_range or (
        descriptor.integer_range)


@pytest.mark.parametrize(('node', 'parameter'), ALL, ids=lambda x: getattr(x, 'name', x))
def test_wrong_values_are_refused_with_name_and_range(node: str, parameter: Parameter):
    wrong = [value for value in (
        'no such choice' if parameter.choices else None,
        None if parameter.minimum is None else parameter.minimum - 1,
        None if parameter.maximum is None else parameter.maximum + 1,
        math.nan if isinstance(parameter.default, float) else None) if value is not None]
    for value in wrong:
        reason = parameter.check(value)
        assert parameter.name in reason, value
        assert len(reason) > len(parameter.name) + 10
