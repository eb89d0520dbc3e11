"""Serialized messages from files: what claims more than it has is refused before it is decoded."""
import contextlib
import struct
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Image

from ps_interfaces.msg import HeadStatus, LightState, PhotometricStack, ReconstructionInfo
from ps_reconstruction import cdr
from ps_reconstruction.session_reader import decode

STACK = 'ps_interfaces/msg/PhotometricStack'


def stack_bytes(images: int = 2) -> bytes:
    message = PhotometricStack(stack_id='an id', part_id='teil-ü', camera_standoff=1.2345)
    for i in range(images):
        message.images.append(Image(height=3, width=5, step=5, encoding='mono8',
                                    data=bytes(range(15))))
        message.lights.append(LightState(name=f'light {i}', panel_size=np.array([0.06, 0.03])))
    return bytes(serialize_message(message))


@pytest.mark.parametrize(('message', 'name'), [
    (PhotometricStack(), 'PhotometricStack'), (ReconstructionInfo(message='x'),
                                               'ReconstructionInfo'),
    (HeadStatus(panel_temperatures=[300.0] * 8), 'HeadStatus')])
def test_own_messages_pass(message: Any, name: str) -> None:
    cdr.check(bytes(serialize_message(message)), f'ps_interfaces/msg/{name}')


def test_lists_of_messages_pass() -> None:
    decoded = decode(stack_bytes(3), STACK)
    assert [light.name for light in decoded.lights] == ['light 0', 'light 1', 'light 2']
    statuses = DiagnosticArray(status=[DiagnosticStatus(
        name='a', values=[KeyValue(key='k', value='v' * i) for i in range(5)])] * 3)
    cdr.check(bytes(serialize_message(statuses)), 'diagnostic_msgs/msg/DiagnosticArray')


@pytest.mark.parametrize('claimed', [3, 100, 1 << 20, 0xFFFFFFFF])
def test_a_list_longer_than_the_message_is_refused(claimed: int) -> None:
    data = bytearray(stack_bytes())
    place = data.index(struct.pack('<d', 1.2345)) + 8
    assert struct.unpack_from('<I', data, place) == (2,)
    struct.pack_into('<I', data, place, claimed)
    with pytest.raises(ValueError, match='images'):
        decode(bytes(data), STACK)


def test_a_long_list_of_nothing_is_refused() -> None:
    """4 MB of zeros are 4 million pictures to a decoder that trusts them, and 700 MB."""
    data = stack_bytes(0)
    place = data.index(struct.pack('<d', 1.2345)) + 8
    with pytest.raises(ValueError, match='images: 4000000 entries, the limit'):
        decode(data[:place] + struct.pack('<I', 4_000_000) + bytes(4_000_000), STACK)


@given(places=st.lists(st.tuples(st.integers(0, 2000), st.integers(0, 255)), max_size=6),
       cut=st.integers(0, 2000))
@settings(max_examples=300, deadline=None)
def test_damaged_messages_are_decoded_or_refused(
        places: list[tuple[int, int]], cut: int) -> None:
    data = bytearray(stack_bytes())
    for place, value in places:
        data[place % len(data)] = value
    with contextlib.suppress(ValueError):
        decode(bytes(data[:len(data) - cut % len(data)] if cut % 2 else data), STACK)
