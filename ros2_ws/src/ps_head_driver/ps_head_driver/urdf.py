"""URDF and xacro of a head, made from its head file so that no number is stated twice.

Panels hang on ps_head_plane, in which the head file states them. The visible shapes are plain
boxes and cylinders: they say where the head is, not what it looks like.
"""
import math
from xml.etree import ElementTree as Xml

from ps_head_driver.frames import CAMERA_FRAME, LINK_FRAME, PLANE_FRAME
from ps_head_driver.head_frames import (
    BRIGHT_FIELD_JOINT,
    DARK_FIELD_JOINT,
    Transform,
    static_transforms,
)
from ps_head_driver.head_model import DIRECTIONS, BrightField, DarkField, HeadModel
from ps_head_driver.kinematics import BrightFieldKinematics, PanelRing

ROBOT = 'ps_head'
_XACRO = 'http://www.ros.org/wiki/xacro'
_PANEL_THICKNESS = 0.004      # m, for the eye
_COLOURS = {'housing': '0.25 0.28 0.31 1', 'bright_field': '0.95 0.72 0.25 1',
            'dark_field': '0.55 0.42 0.75 1'}


def head_urdf(head: HeadModel, source: str) -> str:
    """URDF of the head alone; its root is ps_head_link.

    :param source: named in the file as what it was made from.
    :raises PsError: HEAD_BAD_REQUEST if the head cannot be assembled.
    """
    robot = Xml.Element('robot', name=ROBOT)
    _add_head(robot, head, '')
    return _text(robot, source)


def head_xacro(head: HeadModel, source: str) -> str:
    """The same as a xacro macro ``ps_head`` with the parameters parent, prefix and origin.

    :param source: named in the file as what it was made from.
    :raises PsError: HEAD_BAD_REQUEST if the head cannot be assembled.
    """
    Xml.register_namespace('xacro', _XACRO)
    robot = Xml.Element('robot')
    macro = Xml.SubElement(robot, f'{{{_XACRO}}}macro', name='ps_head',
                           params="parent prefix:='' *origin")
    mount = _joint(macro, '${prefix}' + f'{ROBOT}_mount', 'fixed', '${parent}',
                   '${prefix}' + LINK_FRAME)
    Xml.SubElement(mount, f'{{{_XACRO}}}insert_block', name='origin')
    _add_head(macro, head, '${prefix}')
    return _text(robot, source)


def _text(robot: Xml.Element, source: str) -> str:
    Xml.indent(robot)
    body = Xml.tostring(robot, encoding='unicode')
    return f'<?xml version="1.0"?>\n<!-- Made by ps_urdf from {source}; do not edit. -->\n{body}\n'


def _add_head(tree: Xml.Element, head: HeadModel, prefix: str) -> None:
    frames = static_transforms(head)
    bright = BrightFieldKinematics(head)
    tube = 0.8 * head.bright_field.hinge.r
    _housing(_link(tree, prefix + LINK_FRAME), tube, head.mount.xyz[0])
    for transform in frames:
        link = _link(tree, prefix + transform.child)
        if transform.child == CAMERA_FRAME:
            # the tube reaches from the camera down to the hinges
            _housing(link, tube, head.camera.camera_standoff - head.bright_field.hinge.z)
        _fixed(tree, prefix, transform)
    arm = head.bright_field.arm
    _add_ring(tree, prefix, 'bf', head.bright_field, bright.ring, bright.tilt_limits,
              (arm.along, arm.out))
    _add_ring(tree, prefix, 'df', head.dark_field, PanelRing(head.dark_field),
              head.dark_field.tilt_range, (0.0, 0.0))


def _add_ring(tree: Xml.Element, prefix: str, ring_name: str, field: BrightField | DarkField,
              ring: PanelRing, limits: tuple[float, float], arm: tuple[float, float]) -> None:
    """Four hinged panels. At tilt 0 the hinge's x is the panel's width, y points outwards and z
    down; the joint turns about x.
    """
    master = BRIGHT_FIELD_JOINT if ring_name == 'bf' else DARK_FIELD_JOINT
    width, height = field.panel_size
    for index, name in enumerate(DIRECTIONS):
        panel = f'{ROBOT}_{ring_name}_{name.lower()}'
        link = _link(tree, f'{prefix}{panel}_link')
        y, z = arm
        _shape(link, 'bright_field' if ring_name == 'bf' else 'dark_field', 'box',
               {'size': _numbers(width, height, _PANEL_THICKNESS)},
               (0.0, y, z - _PANEL_THICKNESS / 2), (0.0, 0.0, 0.0))
        right = ring.right[index]
        tilt_offset = field.panels[name].tilt_offset      # type: ignore[index]
        joint = _joint(tree, f'{prefix}{panel}_tilt', 'revolute', prefix + PLANE_FRAME,
                       f'{prefix}{panel}_link')
        _origin(joint, ring.hinges[index],
                (math.pi + tilt_offset, 0.0, math.atan2(right[1], right[0])))
        Xml.SubElement(joint, 'axis', xyz='1 0 0')
        # URDF wants effort and velocity too; the head's board looks after both
        Xml.SubElement(joint, 'limit', lower=_numbers(limits[0]), upper=_numbers(limits[1]),
                       effort='1', velocity='1')
        if f'{panel}_tilt' != master:
            Xml.SubElement(joint, 'mimic', joint=prefix + master)
        # the frame of the light: z out of the face, x along the width
        _link(tree, f'{prefix}{panel}_panel')
        _fixed(tree, prefix, Transform(
            f'{panel}_link', f'{panel}_panel', (0.0, y, z), (0.0, 0.0, 0.0)))


def _housing(link: Xml.Element, radius: float, length: float) -> None:
    if length > 0:
        _shape(link, 'housing', 'cylinder',
               {'radius': _numbers(radius), 'length': _numbers(length)},
               (length / 2, 0.0, 0.0), (0.0, math.pi / 2, 0.0))


def _shape(link: Xml.Element, colour: str, shape: str, size: dict[str, str],
           xyz: tuple[float, float, float], rpy: tuple[float, float, float]) -> None:
    for kind in ('visual', 'collision'):
        part = Xml.SubElement(link, kind)
        _origin(part, xyz, rpy)
        Xml.SubElement(Xml.SubElement(part, 'geometry'), shape, size)
        if kind == 'visual':
            material = Xml.SubElement(part, 'material', name=f'{ROBOT}_{colour}')
            Xml.SubElement(material, 'color', rgba=_COLOURS[colour])


def _link(tree: Xml.Element, name: str) -> Xml.Element:
    return Xml.SubElement(tree, 'link', name=name)


def _fixed(tree: Xml.Element, prefix: str, transform: Transform) -> None:
    joint = _joint(tree, f'{prefix}{transform.child}_joint', 'fixed', prefix + transform.parent,
                   prefix + transform.child)
    _origin(joint, transform.xyz, transform.rpy)


def _joint(tree: Xml.Element, name: str, kind: str, parent: str, child: str) -> Xml.Element:
    joint = Xml.SubElement(tree, 'joint', name=name, type=kind)
    Xml.SubElement(joint, 'parent', link=parent)
    Xml.SubElement(joint, 'child', link=child)
    return joint


def _origin(element: Xml.Element, xyz: tuple[float, float, float],
            rpy: tuple[float, float, float]) -> None:
    Xml.SubElement(element, 'origin', xyz=_numbers(*xyz), rpy=_numbers(*rpy))


def _numbers(*values: float) -> str:
    """Micrometres and microradians are as fine as a machine can be built."""
    return ' '.join(f'{round(float(value), 7) + 0.0:.7f}'.rstrip('0').rstrip('.')
                    for value in values)
