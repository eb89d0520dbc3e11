"""Dots and pose of the target, against rendered truth."""
import numpy as np
import pytest

from ps_calibration.detection import find_dots
from ps_calibration.ring_target import RingTarget
from ps_calibration.synthetic import Bench
from ps_calibration.target_pose import camera_to_plane, fit_pose
from ps_head_driver.camera_model import plane_points, project
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.stack import Stack, angular_error_deg


def test_dots_are_found_to_a_hundredth_of_a_pixel(
        stack: Stack, bench: Bench, target: RingTarget) -> None:
    truth = project(stack.camera, bench.where.position + target.dots @ bench.where.rotation.T)
    found = find_dots(np.sum(stack.images[:4], axis=0, dtype=np.float32), target, stack.camera)
    assert np.abs(found - truth).max() < 0.01


def test_pose_follows_from_the_dots(stack: Stack, bench: Bench, target: RingTarget) -> None:
    exact = project(stack.camera, bench.where.position + target.dots @ bench.where.rotation.T)
    pose = fit_pose(exact, target, stack.camera)
    assert pose.position == pytest.approx(bench.where.position, abs=1e-8)
    # both frames may differ by the turn that tilting brings: compare all axes
    assert angular_error_deg(pose.rotation.T, bench.where.rotation.T) == pytest.approx(0, abs=1e-3)


def test_homography_maps_pixels_to_the_tilted_plane(
        stack: Stack, bench: Bench, target: RingTarget) -> None:
    truth = project(stack.camera, bench.where.position + target.dots @ bench.where.rotation.T)
    plane = fit_pose(truth, target, stack.camera).plane
    ideal = stack.camera.model_copy(update={'distortion': (0.0,) * 5})
    pixel = np.array([101.5, 33.25])
    u, v, w = camera_to_plane(plane, stack.camera) @ [*pixel, 1]
    assert (u / w, v / w) == pytest.approx(plane_points(ideal, pixel, plane)[:2], abs=1e-9)


@pytest.mark.parametrize(('spoil', 'reason'), [
    (lambda picture: np.full_like(picture, 100), '0 of its 6 dots'),
    (lambda picture: picture[:, ::-1].copy(), 'mirrored'),
    (lambda picture: np.roll(picture, picture.shape[1] // 2, axis=1), 'not in its pattern'),
])
def test_another_picture_is_refused(
        stack: Stack, target: RingTarget, spoil, reason: str) -> None:
    picture = np.sum(stack.images[:4], axis=0, dtype=np.float32)
    with pytest.raises(PsError, match=reason) as refused:
        find_dots(spoil(picture), target, stack.camera)
    assert refused.value.code is ErrorCode.CALIBRATION_TARGET_NOT_FOUND
