"""The fixed frames of the head and the names of its joints, from the head model.

ps_head_link (mounting face) -> ps_head_camera_link -> ps_head_camera_optical_frame ->
ps_head_plane. The two camera frames are those of REP 103: x forward, y left, z up, and
x right, y down, z forward. The URDF and ps_interfaces/HeadCalibration both come from here.
"""
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ps_head_driver.frames import CAMERA_FRAME, LINK_FRAME, OPTICAL_FRAME, PLANE_FRAME
from ps_head_driver.head_model import HeadModel

# one joint each turns a ring: the others of the ring mimic it
BRIGHT_FIELD_JOINT = 'ps_head_bf_e_tilt'
DARK_FIELD_JOINT = 'ps_head_df_e_tilt'

_QUARTER = np.pi / 2


@dataclass(frozen=True)
class Transform:
    """Pose of the frame ``child`` in the frame ``parent``, as tf2 has it."""

    parent: str
    child: str
    xyz: tuple[float, float, float]      # m
    rpy: tuple[float, float, float]      # rad, about the fixed axes x, y, z in this order

    def matrix(self) -> NDArray:
        """(4, 4) float64: coordinates in ``child`` to coordinates in ``parent``."""
        result = np.eye(4)
        result[:3, :3] = Rotation.from_euler('xyz', self.rpy).as_matrix()
        result[:3, 3] = self.xyz
        return result

    def quaternion(self) -> tuple[float, float, float, float]:
        """Rotation as x, y, z, w."""
        x, y, z, w = Rotation.from_euler('xyz', self.rpy).as_quat(canonical=True)
        return float(x), float(y), float(z), float(w)


def static_transforms(head: HeadModel) -> list[Transform]:
    """The chain from the mounting face to the nominal measurement plane, in this order.

    :param head: as designed, or as calibrated: then the plane is where the calibrated stand-off
        puts it.
    """
    return [
        Transform(LINK_FRAME, CAMERA_FRAME, head.mount.xyz, head.mount.rpy),
        Transform(CAMERA_FRAME, OPTICAL_FRAME, (0.0, 0.0, 0.0), (-_QUARTER, 0.0, -_QUARTER)),
        Transform(OPTICAL_FRAME, PLANE_FRAME, (0.0, 0.0, head.camera.camera_standoff),
                  (2 * _QUARTER, 0.0, 0.0)),
    ]


def chain(transforms: Sequence[Transform], child: str = PLANE_FRAME) -> NDArray:
    """(4, 4) float64: coordinates in ``child`` to coordinates in the first frame of a chain.

    :raises ValueError: if the chain does not lead to ``child``.
    """
    result = np.eye(4)
    for transform in transforms:
        result = result @ transform.matrix()
        if transform.child == child:
            return result
    raise ValueError(f'no frame {child} in {[transform.child for transform in transforms]}')
