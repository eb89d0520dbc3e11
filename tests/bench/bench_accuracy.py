"""Normal error on rendered scenes of known shape, near field on and off, beside the shot noise.

Bias: normals averaged over 9 x 9 pixels and RENDERS noisy renders. Shot noise: what a linear
propagation of the photon noise of each pixel predicts for the unaveraged error.
"""
import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from ps_head_driver.convergence_radius import inverse
from ps_head_driver.fake.renderer import Renderer, Sensor, make_renderer
from ps_head_driver.head_model import load_head, nominal_head_path
from ps_head_driver.kinematics import lights_at
from ps_head_driver.light_model import light_grid
from ps_head_driver.stack import Stack, angular_error_deg
from ps_reconstruction.pipeline import Options, reconstruct

HEAD = load_head(nominal_head_path())
CONVERGENCE_RADIUS = 0.06
RENDERS = 10
SCALE = 0.5
EXPOSURE = 0.004
SENSOR = Sensor()


def stack_of(renderer: Renderer, tilt: float, motor_counts: int, first_frame: int) -> Stack:
    """Four noisy bright-field pictures and the light that the nominal head says they had."""
    images = [renderer.render(tilt, 1.3, list(np.eye(4)[i]), [0.0] * 4, EXPOSURE, EXPOSURE,
                              frame=first_frame + i) for i in range(4)]
    return Stack(images=images, lights=lights_at(HEAD, motor_counts, 1.3)[:4],
                 camera=renderer.camera)


def shot_noise_deg(stack: Stack, normal: NDArray, mask: NDArray) -> float:
    """Mean angular error that photon noise alone gives, by drawing from it at 400 pixels."""
    rng = np.random.default_rng(0)
    rows, columns = (index[rng.integers(0, len(index), 400)] for index in [
        np.array(axis) for axis in np.nonzero(mask)])
    vectors = light_grid(stack.lights, stack.camera, stack.shape).at(rows, columns)
    levels = np.stack([image[rows, columns] for image in stack.images], axis=-1).astype(float)
    electrons = SENSOR.full_well / SENSOR.maximum
    noise = np.sqrt(levels * electrons + SENSOR.read_noise**2) / electrons
    drawn = levels + rng.normal(size=(300, *levels.shape)) * noise
    solve = np.linalg.pinv(vectors)
    clean = (solve @ levels[..., None])[..., 0]
    noisy = (solve @ drawn[..., None])[..., 0]
    return float(np.mean(angular_error_deg(noisy, np.broadcast_to(clean, noisy.shape))))


def measure(scene: str) -> dict[str, tuple[float, float, float]]:
    """Mean error, bias and shot-noise prediction in degrees, with and without near field."""
    solution = inverse(HEAD, CONVERGENCE_RADIUS)
    renderer = make_renderer(scene, HEAD, SENSOR, scale=SCALE)
    truth = renderer.truth()
    mask = np.ones(truth.normal.shape[:2], bool)
    if scene == 'dome':
        assert truth.height is not None
        # on the dome, away from its rim, where its foot and the shadow it casts are
        inside = (truth.height > 1e-5).astype(np.uint8)
        mask = cv2.erode(inside, np.ones((31, 31), np.uint8)) > 0
    result = {}
    for near_field in (True, False):
        total = np.zeros(truth.normal.shape)
        errors = []
        for i in range(RENDERS):
            stack = stack_of(renderer, solution.tilt, solution.motor_counts, 4 * i)
            normal = reconstruct(stack, Options(near_field=near_field), {'normal'}).normal
            errors.append(float(np.nanmean(angular_error_deg(normal, truth.normal)[mask])))
            total += np.nan_to_num(normal)
        mean = cv2.boxFilter(total, -1, (9, 9))
        target = cv2.boxFilter(truth.normal.astype(float), -1, (9, 9))
        bias = angular_error_deg(mean, target)[mask]
        result['near field' if near_field else 'distant'] = (
            float(np.mean(errors)), float(np.mean(bias)), shot_noise_deg(stack, normal, mask))
    return result


def main() -> None:
    """Print one table."""
    table = Table('scene', 'light model', 'mean error', 'shot noise alone', 'bias',
                  title=f'normal error, degrees; {RENDERS} renders, 8 bit')
    for scene in ('plate', 'tilted_plate', 'dome'):
        for model, (error, bias, noise) in measure(scene).items():
            table.add_row(scene, model, f'{error:.3f}', f'{noise:.3f}', f'{bias:.3f}')
    Console().print(table)


if __name__ == '__main__':
    main()
