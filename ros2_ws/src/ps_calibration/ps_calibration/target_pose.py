"""Where a target lies under the camera: from its dots to plane, pose and homography."""
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from ps_calibration.ring_target import RingTarget
from ps_head_driver.camera_model import plane_points, project
from ps_head_driver.head_model import CameraGeometry
from ps_head_driver.kinematics import PanelPose
from ps_head_driver.stack import Plane

# what the six numbers of a pose are: position (m), then turn about the normal, tilts (rad)
SIZE = 6


@dataclass(frozen=True)
class TargetPose:
    """The target frame in ps_head_plane.

    :param numbers: (6,) x, y, z of its origin (m), turn about its normal, tilts about
        x and y of ps_head_plane (rad).
    """

    numbers: NDArray

    @property
    def position(self) -> NDArray:
        """Origin, (3,) m."""
        return self.numbers[:3]

    @cached_property
    def rotation(self) -> NDArray:
        """(3, 3); columns are the target's axes."""
        tilt = Rotation.from_rotvec([self.numbers[4], self.numbers[5], 0.0])
        turn = Rotation.from_rotvec([0.0, 0.0, self.numbers[3]])
        matrix: NDArray = (tilt * turn).as_matrix()
        return matrix

    @property
    def plane(self) -> Plane:
        """The base plate."""
        normal = self.rotation[:, 2]
        return Plane((float(normal[0]), float(normal[1]), float(normal[2])),
                     float(normal @ self.position))

    def to_target(self, points: NDArray) -> NDArray:
        """From ps_head_plane into the target frame, (..., 3)."""
        return (points - self.position) @ self.rotation

    def panel_to_target(self, panel: PanelPose) -> PanelPose:
        """A panel given in ps_head_plane, in the target frame."""
        return replace(panel, center=self.to_target(panel.center),
                       axis=panel.axis @ self.rotation, right=panel.right @ self.rotation)

    def to_head(self, points: NDArray) -> NDArray:
        """From the target frame into ps_head_plane, (..., 3)."""
        return points @ self.rotation.T + self.position


def dot_errors(numbers: NDArray, dots_px: NDArray, target: RingTarget,
               camera: CameraGeometry) -> NDArray:
    """Predicted minus measured dots, (2 F,) px."""
    predicted = project(camera, TargetPose(numbers).to_head(target.dots))
    return np.asarray(predicted - dots_px).ravel()


def fit_pose(dots_px: NDArray, target: RingTarget, camera: CameraGeometry) -> TargetPose:
    """Pose of the target from its dots.

    :param dots_px: (F, 2) as from find_dots.
    """
    on_plane = plane_points(camera, dots_px, Plane())[:, :2] @ [1, 1j]
    there = target.dots[:, :2] @ [1, 1j]
    turn = np.angle(np.vdot(there - there.mean(), on_plane - on_plane.mean()))
    origin = on_plane.mean() - np.exp(1j * turn) * there.mean()
    start = np.array([origin.real, origin.imag, 0.0, turn, 0.0, 0.0])
    fit = least_squares(dot_errors, start, x_scale=[1e-4, 1e-4, 1e-4, 1e-2, 1e-2, 1e-2],
                        args=(dots_px, target, camera))
    return TargetPose(fit.x)


def camera_to_plane(plane: Plane, camera: CameraGeometry) -> NDArray:
    """Homography from undistorted pixels to ps_head_plane x and y on the plane, (3, 3), m."""
    ideal = camera.model_copy(update={'distortion': (0.0,) * 5})
    right, bottom = camera.width_px - 1.0, camera.height_px - 1.0
    corners = np.array([[0, 0], [right, 0], [right, bottom], [0, bottom]], np.float32)
    points = plane_points(ideal, corners, plane)[:, :2]
    matrix, _ = cv2.findHomography(corners.astype(np.float64), points)
    return np.asarray(matrix)
