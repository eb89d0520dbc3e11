"""Wire protocol: inverse pairs, any bytes, and the examples of docs/protocol.md."""
import contextlib
from pathlib import Path
import re

from hypothesis import given, settings
from hypothesis import strategies as st
import pytest

from ps_head_driver import protocol
from ps_head_driver.protocol import (
    Activity,
    BoardInfo,
    Capability,
    Command,
    End,
    Fault,
    FrameDecoder,
    Packet,
    Status,
    StatusFlag,
    Step,
    StepRecord,
)

U8, U16, U32, U64 = (st.integers(0, 2**bits - 1) for bits in (8, 16, 32, 64))
I32 = st.integers(-2**31, 2**31 - 1)
PACKETS = st.builds(Packet, U8, U8, U16, st.binary(max_size=protocol.MAX_BODY))
STEPS = st.builds(Step, U8, U16, U32, U32, U32, st.booleans())
EIGHT = st.lists(U16, min_size=8, max_size=8).map(tuple)


@given(st.binary(max_size=254))
def test_cobs_has_no_zero_and_one_byte_overhead(data: bytes) -> None:
    encoded = protocol.cobs_encode(data)
    assert 0 not in encoded
    assert len(encoded) == len(data) + 1
    assert protocol.cobs_decode(encoded) == data


@given(st.lists(PACKETS, max_size=5), st.lists(st.integers(1, 40), max_size=40), st.binary())
def test_packets_survive_any_cutting_and_noise_before(
        packets: list[Packet], cuts: list[int], noise: bytes) -> None:
    wire = noise + b'\0' + b''.join(map(protocol.encode, packets))
    decoder, received = FrameDecoder(), []
    for length in [*cuts, len(wire)]:
        received += decoder.feed(wire[:length])
        wire = wire[length:]
    assert received[-len(packets):] == packets if packets else True


@settings(max_examples=500)
@given(st.lists(st.binary(max_size=200), max_size=20))
def test_no_byte_sequence_raises_and_memory_is_bounded(chunks: list[bytes]) -> None:
    decoder = FrameDecoder()
    for chunk in chunks:
        for packet in decoder.feed(chunk):
            assert len(packet.body) <= protocol.MAX_BODY
    assert len(decoder._buffer) < protocol.MAX_WIRE


@given(PACKETS, st.data())
def test_a_changed_byte_is_noticed(packet: Packet, data: st.DataObject) -> None:
    frame = protocol.encode(packet)[:-1]
    position = data.draw(st.integers(0, len(frame) - 1))
    change = data.draw(st.integers(1, 255))
    damaged = bytearray(frame)
    damaged[position] ^= change
    received = FrameDecoder().feed(bytes(damaged) + b'\0')
    # a byte that becomes a delimiter leaves two fragments, each of which needs a right CRC
    assert packet not in received


def test_wire_size_limit() -> None:
    assert len(protocol.encode(Packet(255, 255, 65535, bytes(56)))) == protocol.MAX_WIRE == 64
    with pytest.raises(protocol.ProtocolError, match='57 bytes'):
        protocol.encode(Packet(1, 1, 1, bytes(57)))
    assert protocol.STATUS_REPLY.size + 1 <= protocol.MAX_BODY
    assert protocol.RECORD_REPLY.size + 1 <= protocol.MAX_BODY


@given(st.lists(STEPS, min_size=1, max_size=32))
def test_programs_survive_the_packets(steps: list[Step]) -> None:
    received: list[Step] = []
    for body in protocol.pack_steps(steps):
        assert len(body) <= protocol.MAX_BODY
        first, some = protocol.parse_steps(body)
        assert first == len(received)
        received += some
    assert received == steps


@given(st.builds(
    Status, st.sampled_from(Activity), st.sampled_from(End), st.integers(0, 7).map(StatusFlag),
    st.integers(0, 31).map(Fault), U8, I32, U16, U8, U32, U32, U64, EIGHT))
def test_status_inverse(status: Status) -> None:
    assert Status.parse(status.pack()) == status


@given(st.builds(StepRecord, U8, U32, U32, U64, U32, I32, EIGHT))
def test_record_inverse(record: StepRecord) -> None:
    assert StepRecord.parse(record.pack()) == record


@given(st.builds(
    BoardInfo, U8, st.tuples(U8, U8, U8), st.integers(0, 3).map(Capability), U8,
    st.from_regex(r'[A-Za-z0-9-]{0,16}', fullmatch=True)))
def test_hello_inverse(info: BoardInfo) -> None:
    assert BoardInfo.parse(info.pack()) == info


@given(st.binary(max_size=60))
def test_bodies_of_any_content_raise_nothing_else(body: bytes) -> None:
    for parse in (Status.parse, StepRecord.parse, BoardInfo.parse, protocol.parse_steps):
        with contextlib.suppress(protocol.ProtocolError):
            parse(body)


def test_examples_of_the_document() -> None:
    """Every hex line of docs/protocol.md is a valid packet of the command it stands under."""
    text = (Path(__file__).resolve().parents[4] / 'docs' / 'protocol.md').read_text()
    examples = re.findall(r'^(\w+) (request|reply): `([0-9A-F ]+)`', text, re.MULTILINE)
    assert {name for name, _, _ in examples} == set(Command.__members__)
    for name, direction, line in examples:
        wire = bytes.fromhex(line)
        packet, = FrameDecoder().feed(wire)
        assert packet.type == Command[name] + (protocol.REPLY if direction == 'reply' else 0)
        assert protocol.encode(packet) == wire
