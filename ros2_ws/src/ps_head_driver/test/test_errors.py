"""The error codes of the pure modules are those of the interface."""
from pathlib import Path
import re

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.stack import Geometry, Mode, Panel

INTERFACES = Path(__file__).resolve().parents[2] / 'ps_interfaces' / 'msg'


def constants(message: str) -> dict[str, int]:
    text = (INTERFACES / f'{message}.msg').read_text()
    return {name: int(value) for name, value in re.findall(r'^uint\d+ (\w+) = (\d+)', text, re.M)}


def test_error_codes_equal_the_interface():
    assert constants('ErrorCode') == {code.name: code.value for code in ErrorCode}


def test_panel_names_equal_the_interface():
    ours = {member.name: member.value for kind in (Mode, Panel, Geometry) for member in kind}
    assert constants('Panel') == ours


def test_codes_are_unique_and_in_the_range_of_their_server():
    first = {'HEAD': 1, 'SEQUENCER': 2, 'CR': 3, 'CALIBRATION': 4, 'RECONSTRUCTION': 5,
             'SESSION': 6, 'INSPECTION': 7}
    assert len({code.value for code in ErrorCode}) == len(ErrorCode)
    for code in ErrorCode:
        if code:
            assert code // 100 == first[code.name.split('_')[0]], code


def test_error_carries_code_and_message():
    error = PsError(105, 'a move is running')
    assert error.code is ErrorCode.HEAD_BUSY
    assert str(error) == error.message == 'a move is running'
