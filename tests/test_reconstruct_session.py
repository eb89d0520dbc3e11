"""ps_reconstruct on a recorded session: the same result as on the stack itself."""
from dataclasses import replace
import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('rclpy')

from rclpy.serialization import serialize_message

from ps_head_driver.conversions import stack_to_message
from ps_head_driver.fake.renderer import make_renderer
from ps_head_driver.head_model import load_head, nominal_head_path
from ps_head_driver.kinematics import BrightFieldKinematics, lights_at
from ps_head_driver.stack import Stack
from ps_inspection.session_writer import SessionWriter, WriterOptions
from ps_reconstruction.cli.ps_reconstruct import main
from ps_reconstruction.pipeline import reconstruct
from ps_reconstruction.session_format import STACK_TYPE, Topic
from ps_reconstruction.session_reader import Scan, Session


@pytest.fixture(scope='module')
def stack() -> Stack:
    head = load_head(nominal_head_path())
    renderer = make_renderer('dome', head, scale=0.2)
    tilt = float(BrightFieldKinematics(head).tilt(20000))
    return Stack([renderer.render(tilt, 1.3, np.eye(4)[i], frame=i) for i in range(4)],
                 lights_at(head, 20000, 1.3)[:4], renderer.camera, stack_id='dome')


def record(stack: Stack, folder: Path, count: int) -> Path:
    topic = Topic('/ps_head/stack', STACK_TYPE)
    writer = SessionWriter(folder, [topic], WriterOptions(min_free_bytes=0))
    for number in range(count):
        data = bytes(serialize_message(stack_to_message(stack)))
        assert writer.write(topic.name, data, number, number)
    writer.close()
    return folder


def test_every_stack_gives_what_it_gives_directly(stack: Stack, tmp_path: Path) -> None:
    session, report = record(stack, tmp_path / 'session', 2), tmp_path / 'report.json'
    assert main([str(session), '--out', str(tmp_path / 'out'), '--json', str(report)]) == 0
    assert len(json.loads(report.read_text())['stacks']) == 2
    expected = reconstruct(stack)
    for folder in ('000000', '000001'):
        result = np.load(tmp_path / 'out' / folder / 'result.npz')
        np.testing.assert_array_equal(result['normal'], expected.normal)
        np.testing.assert_array_equal(result['height'], expected.height)


def test_a_cut_off_session_is_good_up_to_there(
    stack: Stack, tmp_path: Path, capsys: pytest.CaptureFixture,
) -> None:
    # large enough for several chunks of the file
    large = replace(stack, images=[np.tile(image, (8, 8)) for image in stack.images])
    session = Session(record(large, tmp_path / 'session', 4))
    assert len(list(session.stacks())) == 4
    file = session.file
    whole = file.read_bytes()
    file.write_bytes(whole[:int(len(whole) * 0.8)])
    scan = Scan()
    assert 1 <= len(list(session.stacks(scan))) < 4
    assert 'ends inside a record' in scan.problems[0]
    file.write_bytes(b'not a session')
    assert main([str(file.parent), '--out', str(tmp_path / 'bad')]) == 1
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
