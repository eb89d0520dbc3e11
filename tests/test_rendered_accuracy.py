"""Normals from rendered pictures against the renderer's truth; the two share no light model."""
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray
import pytest

from ps_head_driver.fake.renderer import Renderer, Sensor, make_renderer
from ps_head_driver.head_model import load_head, nominal_head_path
from ps_head_driver.kinematics import BrightFieldKinematics, lights_at
from ps_head_driver.stack import Plane, Stack, angular_error_deg
from ps_reconstruction.pipeline import Options, reconstruct

MOTOR_COUNTS, DARK_FIELD_TILT = 20000, 1.3
RENDERS, PATCH = 10, 9


def capture(renderer: Renderer, number: int = 0) -> Stack:
    """One bright-field stack, as the head would take it."""
    tilt = float(BrightFieldKinematics(renderer.head).tilt(MOTOR_COUNTS))
    images = [renderer.render(tilt, DARK_FIELD_TILT, np.eye(4)[i], frame=4 * number + i)
              for i in range(4)]
    return Stack(images, lights_at(renderer.head, MOTOR_COUNTS, DARK_FIELD_TILT)[:4],
                 renderer.camera)


def smoothed(normal: NDArray) -> NDArray:
    mean = np.asarray(cv2.blur(normal.astype(np.float64), (PATCH, PATCH)))
    return mean / np.linalg.norm(mean, axis=-1, keepdims=True)


def bias_deg(renderer: Renderer, options: Options) -> NDArray:
    """Angle between true and found normals, both averaged over patches and the latter over
    renders.
    """
    total = sum(reconstruct(capture(renderer, n), options, {'normal'}).normal.astype(np.float64)
                for n in range(RENDERS))
    return angular_error_deg(smoothed(total), smoothed(renderer.truth().normal))


@pytest.fixture(scope='module', params=['plate', 'tilted_plate', 'dome'])
def renderer(request: pytest.FixtureRequest) -> Renderer:
    return make_renderer(request.param, load_head(nominal_head_path()), scale=0.3)


def away_from_rim(renderer: Renderer) -> NDArray:
    """Pixels more than a patch away from the dome's rim and the picture's border."""
    height = renderer.truth().height
    assert height is not None
    kernel = np.ones((2 * PATCH + 1,) * 2, np.uint8)
    raised = (height > 1e-6).astype(np.uint8)
    edge = cv2.dilate(raised, kernel) != cv2.erode(raised, kernel)
    edge |= cv2.erode(np.ones_like(raised), np.ones((PATCH, PATCH), np.uint8),
                      borderType=cv2.BORDER_CONSTANT, borderValue=0) == 0
    return ~edge if renderer.scene.name == 'dome' else np.ones_like(edge)


def test_bias(renderer: Renderer) -> None:
    limit = 0.5 if renderer.scene.name == 'dome' else 0.1
    error = bias_deg(renderer, Options())[away_from_rim(renderer)]
    assert error.mean() < limit
    assert np.percentile(error, 99) < 2 * limit


def test_without_near_field_it_is_ten_degrees(renderer: Renderer) -> None:
    stack = capture(renderer)
    found = reconstruct(stack, Options(near_field=False), {'normal'}).normal
    assert angular_error_deg(found, renderer.truth().normal).mean() > 10


def test_height(renderer: Renderer) -> None:
    truth = renderer.truth().height
    assert truth is not None
    height = reconstruct(capture(renderer), outputs={'height'}).height
    error = height - truth
    error -= np.median(error)
    # noise of the slopes adds up to some micrometres; a wrong sign or scale to millimetres
    assert np.abs(error).mean() < 2e-5 + 0.02 * np.ptp(truth)


def test_stand_off_costs_little() -> None:
    """The paper claims stability under small changes of the spacing."""
    head = load_head(nominal_head_path())
    renderer = make_renderer('plate', head, Sensor(noise=False, bit_depth=16), scale=0.3)
    stack = capture(renderer)
    for offset in (-2e-3, 2e-3):
        wrong = replace(stack, plane=Plane(offset=offset))
        found = reconstruct(wrong, outputs={'normal'}).normal
        assert angular_error_deg(found, renderer.truth().normal).mean() < 0.5
