"""The robot description: its joints put the panels where the kinematics has them."""
import json
from pathlib import Path
from xml.etree import ElementTree as Xml

from heads import NOMINAL, random_head
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ps_head_driver import conversions as convert
from ps_head_driver.calibration_file import HeadCalibration, write_calibration
from ps_head_driver.cli.ps_urdf import main
from ps_head_driver.frames import LINK_FRAME, OPTICAL_FRAME, PLANE_FRAME, plane_to_optical
from ps_head_driver.head_frames import chain, static_transforms
from ps_head_driver.head_model import DIRECTIONS, HeadModel, nominal_head_path
from ps_head_driver.kinematics import BrightFieldKinematics, DarkFieldKinematics
from ps_head_driver.urdf import head_urdf, head_xacro

SHIPPED = Path(__file__).resolve().parents[1] / 'urdf'


def mounted(**mount) -> HeadModel:
    return HeadModel.model_validate({**NOMINAL.model_dump(), 'mount': mount})


def pose_in_root(robot: Xml.Element, frame: str, angles: dict[str, float]) -> np.ndarray:
    """(4, 4): a tree of joints evaluated as the URDF specification says."""
    joints = {joint.find('child').get('link'): joint for joint in robot.findall('joint')}
    pose = np.eye(4)
    while frame in joints:
        joint = joints[frame]
        origin = joint.find('origin')
        step = np.eye(4)
        step[:3, 3] = np.fromstring(origin.get('xyz'), sep=' ')
        turn = Rotation.from_euler('xyz', np.fromstring(origin.get('rpy'), sep=' '))
        if joint.get('type') == 'revolute':
            mimic = joint.find('mimic')
            name = mimic.get('joint') if mimic is not None else joint.get('name')
            axis = np.fromstring(joint.find('axis').get('xyz'), sep=' ')
            turn = turn * Rotation.from_rotvec(angles[name] * axis)
        step[:3, :3] = turn.as_matrix()
        pose = step @ pose
        frame = joint.find('parent').get('link')
    return pose


def test_shipped_description_is_what_the_head_file_makes():
    source = nominal_head_path().name
    assert (SHIPPED / 'ps_head.urdf').read_text() == head_urdf(NOMINAL, source)
    assert (SHIPPED / 'ps_head.urdf.xacro').read_text() == head_xacro(NOMINAL, source)


def test_description_is_one_tree_from_the_mounting_face():
    robot = Xml.fromstring(head_urdf(NOMINAL, ''))
    links = [link.get('name') for link in robot.findall('link')]
    children = [joint.find('child').get('link') for joint in robot.findall('joint')]
    parents = {joint.find('parent').get('link') for joint in robot.findall('joint')}
    assert len(set(links)) == len(links)
    assert sorted(children) == sorted(set(links) - {LINK_FRAME})
    assert parents <= set(links)
    for name in ('bf_e', 'bf_n', 'bf_w', 'bf_s', 'df_e', 'df_n', 'df_w', 'df_s'):
        assert f'ps_head_{name}_panel' in links


@pytest.mark.parametrize('seed', range(5))
def test_panels_are_where_the_kinematics_puts_them(seed):
    rng = np.random.default_rng(seed)
    head = random_head(rng)
    robot = Xml.fromstring(head_urdf(head, ''))
    bright, dark = BrightFieldKinematics(head), DarkFieldKinematics(head)
    tilt = rng.uniform(*bright.tilt_limits)
    dark_tilt = rng.uniform(*dark.tilt_limits)
    angles = {'ps_head_bf_e_tilt': tilt, 'ps_head_df_e_tilt': dark_tilt}
    to_plane = np.linalg.inv(pose_in_root(robot, PLANE_FRAME, {}))
    for name in DIRECTIONS:
        for ring, pose in (('bf', bright.panel_pose(name, tilt)),
                           ('df', dark.panel_pose(name, dark_tilt))):
            panel = to_plane @ pose_in_root(
                robot, f'ps_head_{ring}_{name.lower()}_panel', angles)
            np.testing.assert_allclose(panel[:3, 3], pose.center, atol=5e-7)
            np.testing.assert_allclose(panel[:3, 2], pose.axis, atol=5e-7)
            np.testing.assert_allclose(panel[:3, 0], pose.right, atol=5e-7)


def test_joint_limits_are_those_of_the_motor_and_servo():
    robot = Xml.fromstring(head_urdf(NOMINAL, ''))
    for ring, limits in (('bf', BrightFieldKinematics(NOMINAL).tilt_limits),
                         ('df', NOMINAL.dark_field.tilt_range)):
        joint = robot.find(f"joint[@name='ps_head_{ring}_n_tilt']")
        assert joint.find('mimic').get('joint') == f'ps_head_{ring}_e_tilt'
        limit = joint.find('limit')
        assert [float(limit.get('lower')), float(limit.get('upper'))] == pytest.approx(
            limits, abs=1e-6)


def test_frames_look_the_way_the_conventions_say():
    """REP 103: x of the link is forward, z of the optical frame too; the plane looks back."""
    head = mounted(xyz=(0.08, 0.0, 0.0))
    to_link = chain(static_transforms(head))
    standoff = head.camera.camera_standoff
    np.testing.assert_allclose(to_link[:3, 3], [0.08 + standoff, 0, 0], atol=1e-12)
    optical = chain(static_transforms(head), OPTICAL_FRAME)
    forward, left, up = np.eye(3)
    np.testing.assert_allclose(optical[:3, :3].T, [-left, -up, forward], atol=1e-12)
    np.testing.assert_allclose(to_link[:3, :3].T, [-left, up, -forward], atol=1e-12)


def test_plane_and_optical_frame_agree_with_the_picture():
    """The transform is the rotation that the pictures' conversion uses."""
    in_optical = static_transforms(NOMINAL)[2].matrix()
    vectors = np.random.default_rng(1).normal(size=(5, 3))
    np.testing.assert_allclose(vectors @ in_optical[:3, :3].T, plane_to_optical(vectors),
                               atol=1e-12)
    np.testing.assert_allclose(in_optical[:3, 3], [0, 0, NOMINAL.camera.camera_standoff])


@pytest.mark.parametrize('mount', [
    {'xyz': (0.08, 0, 0)}, {'xyz': (0.05, -0.02, 0.01), 'rpy': (0.1, -0.2, 1.3)}])
def test_calibration_message_has_the_transforms_of_the_description(mount):
    head = mounted(**mount)
    robot = Xml.fromstring(head_urdf(head, ''))
    message = convert.calibration_to_message(None, head)
    assert [t.header.frame_id for t in message.transforms][1:] == [
        t.child_frame_id for t in message.transforms][:-1]
    pose = np.eye(4)
    for transform in message.transforms:
        q, p = transform.transform.rotation, transform.transform.translation
        step = np.eye(4)
        step[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
        step[:3, 3] = p.x, p.y, p.z
        pose = pose @ step
        np.testing.assert_allclose(
            pose, pose_in_root(robot, transform.child_frame_id, {}), atol=1e-6)


def calibration(**changes) -> HeadCalibration:
    from datetime import UTC, datetime
    return HeadCalibration(
        calibration_id='a', created=datetime(2026, 1, 1, tzinfo=UTC), head_serial='PS-1',
        camera=NOMINAL.camera.model_copy(update={'camera_standoff': 0.2987}), verdict='OK',
        **changes)


def test_calibrated_standoff_moves_the_plane_in_the_message():
    message = convert.calibration_to_message(calibration(), NOMINAL)
    assert message.transforms[-1].transform.translation.z == 0.2987
    assert message.transforms[0].transform.translation.x == NOMINAL.mount.xyz[0]


def substituted(element: Xml.Element, prefix: str) -> list:
    """Tags and attributes of a xacro tree with its prefix filled in."""
    return [element.tag, {key: value.replace('${prefix}', prefix)
                          for key, value in element.attrib.items()},
            [substituted(child, prefix) for child in element]]


def test_xacro_macro_is_the_same_head_behind_a_mount():
    macro = Xml.fromstring(head_xacro(NOMINAL, ''))[0]
    assert macro.get('params').split() == ['parent', "prefix:=''", '*origin']
    assert macro[0].find('parent').get('link') == '${parent}'
    plain = Xml.fromstring(head_urdf(NOMINAL, ''))
    assert [substituted(e, '') for e in macro[1:]] == [substituted(e, '') for e in plain]
    named = [name for e in macro.iter() for key, name in e.attrib.items()
             if e.tag in ('link', 'joint') and key == 'name']
    assert all(name.startswith('${prefix}ps_head_') for name in named)


def test_command_writes_what_its_arguments_say(tmp_path, capsys):
    write_calibration(calibration(), tmp_path / 'calibration.yaml')
    files = [tmp_path / name for name in ('h.urdf', 'h.urdf.xacro', 'h.json', 'h.svg')]
    assert main(['--out', str(files[0]), '--calibration', str(tmp_path / 'calibration.yaml'),
                 '--json', str(files[2]), '--drawing', str(files[3])]) == 0
    assert main(['--out', str(files[1])]) == 0
    assert 'calibration.yaml' in files[0].read_text()
    assert files[1].read_text() == head_xacro(NOMINAL, 'head.yaml')
    assert json.loads(files[2].read_text())['transforms'][-1]['xyz_m'] == [0, 0, 0.2987]
    drawing = Xml.parse(files[3]).getroot()
    assert drawing.tag.endswith('svg')
    assert capsys.readouterr().out == ''
    assert main([]) == 0
    assert Xml.fromstring(capsys.readouterr().out).get('name') == 'ps_head'


@pytest.mark.parametrize(('words', 'said'), [
    (['--head', '/nowhere.yaml'], 'HEAD_BAD_REQUEST: /nowhere.yaml'),
    (['--calibration', '/nowhere.yaml'], 'CALIBRATION_FILE_NOT_FOUND'),
    (['--out', '/nowhere/x.urdf'], '/nowhere/x.urdf'),
    (['--drawing', '/nowhere/x.nonsense'], 'nonsense')])
def test_command_says_what_is_wrong(capsys, words, said):
    assert main(words) == 1
    message = capsys.readouterr().err
    assert said in message
    assert message.count('\n') == 1
