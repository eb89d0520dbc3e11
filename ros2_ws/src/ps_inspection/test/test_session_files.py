"""Writing, reading, cutting off and recovering sessions, without ROS."""
from dataclasses import replace
import errno
import os
from pathlib import Path
import random
import shutil
import signal
import struct
import subprocess
import sys
import threading
import time

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
import pytest
import yaml

from ps_head_driver.errors import ErrorCode, PsError
from ps_inspection import bag_file
from ps_inspection.session_recovery import recover
from ps_inspection.session_writer import SessionWriter, WriterOptions
from ps_reconstruction.session_format import Topic, check_name, stack_id_of
from ps_reconstruction.session_reader import Scan, Session

BIG = Topic('/ps_head/big', 'std_msgs/msg/String', definition='string data\n', type_hash=(
    'RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18'))
SMALL = Topic('/ps_head/small', 'std_msgs/msg/UInt8', latched=True, definition='uint8 data\n')
QUICK = WriterOptions(sync=False, min_free_bytes=0, flush_period=0.05)


def string_cdr(text: bytes) -> bytes:
    return b'\0\1\0\0' + struct.pack('<I', len(text) + 1) + text + b'\0'


def record(folder: Path, big: int = 3, size: int = 100_000, **options: object) -> SessionWriter:
    writer = SessionWriter(
        folder, [BIG, SMALL], replace(QUICK, **options)
        if options else QUICK, {'session': {'part_id': 'p1'}})
    for i in range(big):
        writer.write(SMALL.name, b'\0\1\0\0' + bytes([i]), 1000 * i, 1000 * i)
        writer.write(BIG.name, string_cdr(bytes([65 + i]) * size), 1000 * i + 1, 1000 * i,
                     lambda: None)
    writer.add_metadata('late', {'key': 'value'})
    writer.close()
    return writer


@pytest.mark.parametrize('compression', ['none', 'lz4', 'zstd'])
def test_what_was_written_is_read_back(tmp_path: Path, compression: str) -> None:
    writer = record(tmp_path / 's', compression=compression)
    assert writer.error is None
    scan = Scan()
    messages = list(Session(tmp_path / 's').messages(scan))
    assert [(m.topic.name, m.log_time, m.publish_time) for m in messages] == [
        entry for i in range(3) for entry in (
            (SMALL.name, 1000 * i, 1000 * i), (BIG.name, 1000 * i + 1, 1000 * i))]
    assert messages[3].data == string_cdr(b'B' * 100_000)
    assert scan.complete
    assert not scan.problems
    assert scan.metadata == {'session': {'part_id': 'p1'}, 'late': {'key': 'value'}}
    assert scan.topics == [BIG, SMALL]
    assert scan.compression == compression


def test_other_tools_read_it(tmp_path: Path) -> None:
    anyreader = pytest.importorskip('rosbags.highlevel')
    mcap_reader = pytest.importorskip('mcap.reader')
    typesys = pytest.importorskip('rosbags.typesys')
    record(tmp_path / 's')
    store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    with anyreader.AnyReader([tmp_path / 's'], default_typestore=store) as reader:
        assert reader.message_count == 6
        assert {c.topic: c.msgcount for c in reader.connections} == {BIG.name: 3, SMALL.name: 3}
        latched = next(c for c in reader.connections if c.topic == SMALL.name)
        assert latched.ext.offered_qos_profiles[0].durability.name == 'TRANSIENT_LOCAL'
        texts = [reader.deserialize(data, c.msgtype).data[:2]
                 for c, _, data in reader.messages() if c.topic == BIG.name]
    assert texts == ['AA', 'BB', 'CC']
    with (tmp_path / 's' / 's_0.mcap').open('rb') as stream:
        summary = mcap_reader.make_reader(stream, validate_crcs=True).get_summary()
    assert summary.statistics.message_count == 6
    assert {s.encoding for s in summary.schemas.values()} == {'ros2msg'}


def test_metadata_is_what_rosbag2_writes(tmp_path: Path) -> None:
    record(tmp_path / 's')
    information = yaml.safe_load(
        (tmp_path / 's' / 'metadata.yaml').read_text())['rosbag2_bagfile_information']
    assert information['version'] == 9
    assert information['storage_identifier'] == 'mcap'
    assert information['message_count'] == 6
    assert information['starting_time'] == {'nanoseconds_since_epoch': 0}
    assert information['duration'] == {'nanoseconds': 2001}
    assert information['relative_file_paths'] == ['s_0.mcap']
    assert information['files'][0]['message_count'] == 6
    topic = information['topics_with_message_count'][1]
    assert topic['topic_metadata']['name'] == SMALL.name
    assert topic['topic_metadata']['offered_qos_profiles'][0]['durability'] == 'transient_local'
    assert information['custom_data'] == {'part_id': 'p1'}


@given(cut=st.floats(0, 1))
@settings(max_examples=25, deadline=None,
          suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_cut_anywhere_recovers_what_was_flushed_before(tmp_path: Path, cut: float) -> None:
    source = tmp_path / 'source'
    if not source.exists():
        record(source, compression='lz4')
    data = (source / 'source_0.mcap').read_bytes()
    size = 8 + int(cut * (len(data) - 8))
    folder = tmp_path / 'cut'
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    (folder / 'cut_0.mcap').write_bytes(data[:size])

    before = list(Session(folder).messages())
    result = recover(Session(folder))
    assert result.messages == len(before)
    assert result.changed
    assert list(Session(folder).messages()) == before
    assert Session(folder).info().complete
    assert not recover(Session(folder)).changed
    assert sorted(p.name for p in folder.iterdir()) == ['cut_0.mcap', 'metadata.yaml']


def test_damage_in_the_middle_costs_one_chunk(tmp_path: Path) -> None:
    record(tmp_path / 's', big=4)
    file = tmp_path / 's' / 's_0.mcap'
    data = bytearray(file.read_bytes())
    place = data.index(b'C' * 1000) + 500
    data[place] ^= 0xFF
    file.write_bytes(data)
    scan = Scan()
    kept = [m.data[8:9] for m in Session(tmp_path / 's').messages(scan) if m.topic == BIG]
    assert kept == [b'A', b'B', b'D']
    assert len(scan.problems) == 1
    result = recover(Session(tmp_path / 's'))
    assert result.changed
    assert Session(tmp_path / 's').info().scan.problems == []


def test_missing_metadata_is_made_again(tmp_path: Path) -> None:
    record(tmp_path / 's')
    metadata = tmp_path / 's' / 'metadata.yaml'
    original = metadata.read_text()
    metadata.unlink()
    assert recover(Session(tmp_path / 's')).changed
    assert metadata.read_text() == original


CHILD = """
import os, signal, sys, time
from pathlib import Path
signal.signal(signal.SIGPIPE, signal.SIG_DFL)       # an orphan ends
sys.path[:0] = {path!r}
from test_session_files import BIG, SMALL, string_cdr
from ps_inspection.session_writer import SessionWriter, WriterOptions
writer = SessionWriter(Path(sys.argv[1]), [BIG, SMALL], WriterOptions(min_free_bytes=0))
for i in range(100000):
    writer.write(SMALL.name, b'\\0\\1\\0\\0' + bytes([i % 256]), time.time_ns(), 0)
    text = str(i).encode()
    if not writer.write(BIG.name, string_cdr(text + b'.' * 500_000), time.time_ns(), 0,
                        lambda text=text: os.write(1, text + b'\\n')):
        sys.exit(f'refused: {{writer.error}}')
    time.sleep(0.002)
"""


@pytest.mark.parametrize('seed', range(3))
def test_kill_loses_no_acknowledged_message(tmp_path: Path, seed: int) -> None:
    """See tests/bench/bench_session.py for 100 kills."""
    lost, acknowledged, recovered = kill_and_recover(tmp_path / 's', random.Random(seed))
    assert acknowledged > 0
    assert not lost
    assert recovered >= acknowledged


def kill_and_recover(folder: Path, chance: random.Random) -> tuple[set[bytes], int, int]:
    """Kill a writing process at a random moment; (lost, acknowledged, recovered) messages."""
    code = CHILD.format(path=[*sys.path, str(Path(__file__).parent)])
    process = subprocess.Popen([sys.executable, '-c', code, str(folder)],
                               stdout=subprocess.PIPE, start_new_session=True)
    assert process.stdout is not None
    try:
        first = process.stdout.readline()
        time.sleep(chance.uniform(0, 0.3))
    finally:
        process.send_signal(signal.SIGKILL)
        rest = process.stdout.read()
        process.wait()
        process.stdout.close()
    # a line cut off by the kill is no acknowledgement
    acknowledged = set((first + rest).rpartition(b'\n')[0].split())
    result = recover(Session(folder))
    assert result.changed
    found = {m.data[8:].split(b'.')[0] for m in Session(folder).messages() if m.topic == BIG}
    return acknowledged - found, len(acknowledged), len(found)


# ---------------------------------------------------------------------------- what goes wrong

def wait_for(condition: object, seconds: float = 5.0) -> None:
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:     # type: ignore[operator]
        time.sleep(0.01)
    assert condition()                                    # type: ignore[operator]


def test_fault_of_the_caller_is_not_blamed_on_the_disk(tmp_path: Path) -> None:
    def acknowledge() -> None:
        raise BrokenPipeError('gone')

    writer = SessionWriter(tmp_path / 's', [BIG], WriterOptions(sync=False, min_free_bytes=0))
    writer.write(BIG.name, string_cdr(b'x'), 1, 1, acknowledge)
    writer.close()
    assert writer.error is not None
    assert writer.error.code == ErrorCode.SESSION_INTERNAL
    assert 'BrokenPipeError: gone' in writer.error.message
    recover(Session(tmp_path / 's'))
    assert len(list(Session(tmp_path / 's').messages())) == 1


def test_nearly_full_disk_ends_with_a_complete_session(tmp_path: Path, monkeypatch) -> None:
    errors: list[PsError] = []
    left = [10_000_000]

    def free_bytes(_bag: bag_file.BagFile) -> int:
        left[0] -= 1_000_000
        return left[0]

    monkeypatch.setattr(bag_file.BagFile, 'free_bytes', free_bytes)
    writer = SessionWriter(tmp_path / 's', [BIG, SMALL],
                           WriterOptions(sync=False, min_free_bytes=5_000_000), {}, errors.append)
    written: list[int] = []
    for i in range(10):
        writer.write(BIG.name, string_cdr(b'x' * 1000), i, i, lambda i=i: written.append(i))
    writer.close()
    assert [error.code for error in errors] == [ErrorCode.SESSION_DISK_FULL]
    assert 'nearly full' in errors[0].message
    assert 0 < len(written) < 10
    info = Session(tmp_path / 's').info()
    assert info.complete
    assert info.counts[BIG.name] == len(written)


def test_full_disk_leaves_what_was_acknowledged_readable(tmp_path: Path, monkeypatch) -> None:
    # as with a quota: full without notice
    monkeypatch.setattr(bag_file.BagFile, 'free_bytes', lambda _: 1 << 40)
    disk = tmp_path / 'disk'
    disk.mkdir()
    if os.geteuid() or subprocess.run(
            ['mount', '-t', 'tmpfs', '-o', 'size=3m', 'tmpfs', str(disk)],
            capture_output=True, check=False).returncode:
        pytest.skip('needs the right to mount a small tmpfs')
    try:
        errors: list[PsError] = []
        writer = SessionWriter(disk / 's', [BIG, SMALL], QUICK, {}, errors.append)
        written: list[int] = []
        for i in range(10):
            writer.write(BIG.name, string_cdr(b'x' * 500_000), i, i, lambda i=i: written.append(i))
        wait_for(lambda: writer.error)
        assert not writer.write(BIG.name, string_cdr(b'late'), 0, 0)
        writer.close()
        assert [error.code for error in errors] == [ErrorCode.SESSION_DISK_FULL]
        assert 'disk is full' in errors[0].message
        info = Session(disk / 's').info()
        assert not info.complete
        assert info.counts[BIG.name] == len(written) > 0
        with pytest.raises(PsError, match='disk is full'):
            recover(Session(disk / 's'))
        assert Session(disk / 's').info().counts == info.counts
    finally:
        subprocess.run(['umount', str(disk)], check=True)


def test_removed_folder_is_noticed(tmp_path: Path) -> None:
    errors: list[PsError] = []
    writer = SessionWriter(tmp_path / 's', [BIG, SMALL], QUICK, {}, errors.append)
    writer.write(BIG.name, string_cdr(b'x'), 0, 0, lambda: None)
    wait_for(lambda: writer.counts[BIG.name])
    shutil.rmtree(tmp_path / 's')
    acknowledged = threading.Event()
    writer.write(BIG.name, string_cdr(b'y'), 0, 0, acknowledged.set)
    wait_for(lambda: errors)
    writer.close()
    assert errors[0].code == ErrorCode.SESSION_WRITE_FAILED
    assert 'removed' in errors[0].message
    assert not acknowledged.is_set()


@pytest.mark.parametrize(('number', 'code'), [
    (errno.ENOSPC, ErrorCode.SESSION_DISK_FULL), (errno.EACCES, ErrorCode.SESSION_NO_PERMISSION),
    (errno.EROFS, ErrorCode.SESSION_NO_PERMISSION), (errno.EIO, ErrorCode.SESSION_WRITE_FAILED)])
def test_creation_errors_have_a_code(tmp_path: Path, monkeypatch, number: int,
                                     code: ErrorCode) -> None:
    def refuse(self: Path, *_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number), str(self))

    monkeypatch.setattr(Path, 'mkdir', refuse)
    with pytest.raises(PsError) as caught:
        SessionWriter(tmp_path / 's', [BIG])
    assert caught.value.code == code


def test_existing_session_is_not_touched(tmp_path: Path) -> None:
    record(tmp_path / 's')
    before = (tmp_path / 's' / 's_0.mcap').read_bytes()
    with pytest.raises(PsError, match='exists') as caught:
        SessionWriter(tmp_path / 's', [BIG])
    assert caught.value.code == ErrorCode.SESSION_BAD_REQUEST
    assert (tmp_path / 's' / 's_0.mcap').read_bytes() == before


def test_full_queue_refuses_the_newest(tmp_path: Path, monkeypatch) -> None:
    gate = threading.Event()
    write = bag_file.BagFile.write

    def slow(*arguments: object) -> None:
        gate.wait(5)
        write(*arguments)       # type: ignore[arg-type]

    monkeypatch.setattr(bag_file.BagFile, 'write', slow)
    writer = SessionWriter(tmp_path / 's', [BIG],
                           WriterOptions(sync=False, min_free_bytes=0, queue_bytes=2500))
    taken = [writer.write(BIG.name, string_cdr(bytes([65 + i]) * 1000), i, i) for i in range(5)]
    gate.set()
    writer.close()
    assert taken == [True, True, False, False, False]
    assert writer.refused == 3
    assert [m.data[8:9] for m in Session(tmp_path / 's').messages()] == [b'A', b'B']


def test_one_message_larger_than_the_queue_is_taken(tmp_path: Path) -> None:
    writer = SessionWriter(tmp_path / 's', [BIG],
                           WriterOptions(sync=False, min_free_bytes=0, queue_bytes=10))
    assert writer.write(BIG.name, string_cdr(b'x' * 1000), 0, 0)
    writer.close()
    assert writer.counts == {BIG.name: 1}


def test_small_messages_reach_the_file_without_closing(tmp_path: Path) -> None:
    writer = SessionWriter(tmp_path / 's', [SMALL], QUICK)
    writer.write(SMALL.name, b'\0\1\0\0\7', 0, 0)
    wait_for(lambda: list(Session(tmp_path / 's').messages()))
    writer.close()


@pytest.mark.parametrize('name', [
    '', '.', '..', '../x', '/etc', 'a/b', 'a\\b', '.hidden', 'a\nb', 'x' * 101, 'ä', '-rf'])
def test_names_that_could_escape_are_refused(name: str) -> None:
    with pytest.raises(PsError) as caught:
        check_name(name)
    assert caught.value.code == ErrorCode.SESSION_BAD_REQUEST


def test_plain_names_are_taken() -> None:
    assert check_name('Part-7_b.2') == 'Part-7_b.2'


# ---------------------------------------------------------------------------- foreign files

@pytest.mark.parametrize('content', [b'', b'\x89MCAP', b'not a bag' * 10])
def test_foreign_files_are_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / 's_0.mcap').write_bytes(content)
    with pytest.raises(PsError) as caught:
        Session(tmp_path)
    assert caught.value.code == ErrorCode.SESSION_NOT_A_SESSION


@pytest.mark.parametrize('path', ['missing', '.'])
def test_no_bag_is_refused(tmp_path: Path, path: str) -> None:
    with pytest.raises(PsError) as caught:
        Session(tmp_path / path)
    assert caught.value.code == ErrorCode.SESSION_NOT_A_SESSION


def test_links_left_in_a_session_do_not_lead_out_of_it(tmp_path: Path) -> None:
    record(tmp_path / 's')
    folder, outside = tmp_path / 's', tmp_path / 'outside'
    outside.write_text('mine')
    (folder / 'metadata.yaml').unlink()
    for name in ('metadata.yaml', 'metadata.yaml.tmp', 's_0.mcap.recovering'):
        (folder / name).symlink_to(outside)
    file = folder / 's_0.mcap'
    file.write_bytes(file.read_bytes()[:-20])
    recover(Session(folder))
    assert outside.read_text() == 'mine'
    assert Session(folder).info().complete


def test_bombs_are_not_inflated(tmp_path: Path) -> None:
    for compression in ('lz4', 'zstd'):
        record(tmp_path / compression, big=2, size=3_000_000, compression=compression)
        session = Session(tmp_path / compression, max_chunk_bytes=1_000_000)
        scan = Scan()
        assert list(session.messages(scan)) == []
        assert 'limit' in scan.problems[0]


@given(places=st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), min_size=1, max_size=8))
@settings(max_examples=300, deadline=None,
          suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_damaged_bytes_never_crash_the_reader(
        tmp_path: Path, places: list[tuple[float, int]]) -> None:
    source = tmp_path / 'source'
    if not source.exists():
        record(source, size=100, compression='lz4')
    data = bytearray((source / 'source_0.mcap').read_bytes())
    for place, value in places:
        data[8 + int(place * (len(data) - 9))] = value
    (tmp_path / 'bad').mkdir(exist_ok=True)
    (tmp_path / 'bad' / 'bad_0.mcap').write_bytes(data)
    messages = list(Session(tmp_path / 'bad', max_chunk_bytes=1 << 20).messages())
    assert len(messages) <= 6


def test_stack_id_without_decoding() -> None:
    rclpy = pytest.importorskip('rclpy.serialization')
    messages = pytest.importorskip('ps_interfaces.msg')
    for frame in ('', 'a', 'abcd', 'ps_head_camera_optical'):
        stack = messages.PhotometricStack(stack_id='7f3a-ü')
        stack.header.frame_id = frame
        assert stack_id_of(rclpy.serialize_message(stack)) == '7f3a-ü'
    assert stack_id_of(b'\0\1\0\0') == ''
