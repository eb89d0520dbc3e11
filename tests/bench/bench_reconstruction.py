"""Reconstruction: least squares, height and the whole chain; ratios within one run."""
from collections.abc import Callable
from functools import partial
import os
from pathlib import Path
import time
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from ps_head_driver.camera_model import scaled_camera
from ps_head_driver.fake.renderer import Sensor, make_renderer
from ps_head_driver.head_model import load_head, nominal_head_path
from ps_head_driver.kinematics import BrightFieldKinematics, lights_at
from ps_head_driver.light_model import light_vectors
from ps_head_driver.stack import Plane, Stack, angular_error_deg
from ps_reconstruction import least_squares, pipeline
from ps_reconstruction.integration import Rays, gradients, height_from_normals, poisson
from ps_reconstruction.near_field import photometric_problem, stack_rays, surface_points
from ps_reconstruction.pipeline import Options, reconstruct
from ps_reconstruction.problem import expand, grid_size
from ps_reconstruction.weighted_integration import integrate

DATA = Path(os.environ.get('PS_DATA', Path(__file__).resolve().parents[3] / 'shared' / 'data'))
FIVE_MP = (2048, 2448)
MOTOR_COUNTS = 20000
TOPICS = set(pipeline.OUTPUTS) - {'roughness'}


def best(action: Callable[[], Any], rounds: int = 5) -> float:
    """Shortest time of some calls, s; one call before them warms up."""
    action()
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        action()
        times.append(time.perf_counter() - start)
    return min(times)


def panel_stack(shape: tuple[int, int], repeat: int = 1) -> Stack:
    """Random 8-bit pictures under the four bright-field panels; ``repeat`` adds noisy copies."""
    head = load_head(nominal_head_path())
    lights = lights_at(head, MOTOR_COUNTS, 1.3)[:4] * repeat
    rng = np.random.default_rng(0)
    return Stack([rng.integers(60, 200, shape, np.uint8) for _ in lights], lights,
                 scaled_camera(head.camera, shape[1], shape[0]))


def plate_stack(shape: tuple[int, int]) -> Stack:
    """A rendered flat plate."""
    head = load_head(nominal_head_path())
    renderer = make_renderer('plate', head, scale=shape[1] / head.camera.width_px)
    tilt = float(BrightFieldKinematics(head).tilt(MOTOR_COUNTS))
    height, width = renderer.camera.height_px, renderer.camera.width_px
    assert abs(height - shape[0]) < 100, (height, width)
    return Stack([renderer.render(tilt, 1.3, np.eye(4)[i], frame=i) for i in range(4)],
                 lights_at(head, MOTOR_COUNTS, 1.3)[:4], renderer.camera)


def least_squares_table() -> Table:
    """Near-field least squares against plain NumPy and against copying the same bytes."""
    table = Table('4 x 2448x2048, 8 bit', 'ms', 'times the kernel')
    stack = panel_stack(FIVE_MP)
    problem = photometric_problem(stack)
    out = least_squares.empty_solution(problem)
    kernel = best(lambda: least_squares.solve(problem, False, out))
    quality = best(lambda: least_squares.solve(problem, True, out))
    source = [*problem.frames, out.normal, out.albedo]
    target = [np.empty_like(a) for a in source]

    def copy() -> None:
        for a, b in zip(target, source, strict=True):
            np.copyto(a, b)

    inverse = np.linalg.pinv(problem.lights[0, 0])

    def constant_lights() -> None:
        g = np.stack(problem.frames, axis=-1).astype(np.float32) @ inverse.T.astype(np.float32)
        albedo = np.linalg.norm(g, axis=-1)
        _ = g / albedo[..., None]

    rows = {
        'kernel: normals, albedo (preallocated)': kernel,
        'kernel with confidence, reason, residual': quality,
        'copy of the bytes it reads and writes': best(copy),
        'plain NumPy, near field': best(lambda: least_squares.solve_reference(problem), 1),
        'plain NumPy, the same light everywhere': best(constant_lights, 2)}
    for name, seconds in rows.items():
        table.add_row(name, f'{seconds * 1e3:.1f}', f'{seconds / kernel:.2f}')
    return table


def growth_table() -> Table:
    """Time per pixel and light must not grow with either."""
    table = Table('megapixels', 'lights', 'kernel, ms', 'ns per pixel and light')
    for shape, repeat in (((480, 640), 1), ((1024, 1280), 1), (FIVE_MP, 1), ((3648, 5472), 1),
                          ((1024, 1280), 2), ((1024, 1280), 4), ((1024, 1280), 24)):
        problem = photometric_problem(panel_stack(shape, repeat))
        out = least_squares.empty_solution(problem)
        seconds = best(partial(least_squares.solve, problem, False, out), 3)
        pixels = shape[0] * shape[1]
        table.add_row(f'{pixels / 1e6:.1f}', str(problem.count), f'{seconds * 1e3:.1f}',
                      f'{seconds / pixels / problem.count * 1e9:.2f}')
    return table


def chain_table() -> Table:
    """The whole pipeline on a rendered plate, and its stages."""
    table = Table('stage, ms', '1280x1024', '2448x1958')
    columns = []
    for shape in ((1024, 1280), FIVE_MP):
        stack = plate_stack(shape)
        total = best(partial(reconstruct, stack, outputs=TOPICS), 3)
        columns.append({**reconstruct(stack).timings, 'all but roughness': total})
    for stage in columns[0]:
        table.add_row(stage, *(f'{column[stage] * 1e3:.1f}' for column in columns))
    stack = plate_stack(FIVE_MP)
    normal = reconstruct(stack, outputs={'normal'}).normal
    du, dv = gradients(normal, stack_rays(stack))
    table.add_row('Poisson solution alone', '', f'{best(lambda: poisson(du, dv)) * 1e3:.1f}')
    return table


def depth_table() -> Table:
    """Depth from the true normals of DiLiGenT objects, mean absolute error and time."""
    solvers = {
        'fast': None, 'careful, smooth': partial(integrate, steepness=0.0),
        'careful, steps': None}
    table = Table('mean |error|, mm (time, ms)', *solvers)
    for file in sorted((DATA / 'diligent_depth').glob('*.npz')):
        truth = np.load(file)
        mask, depth, k = truth['mask'] > 0, truth['depth_mm'], truth['K']
        normal = truth['normal'].astype(np.float32)
        normal[~mask] = np.nan
        step = 32
        gh, gw = grid_size(mask.shape, step)
        u, v = np.meshgrid(np.arange(gw) * step, np.arange(gh) * step)
        rays = Rays(np.stack([(u - k[0, 2]) / k[0, 0], -(v - k[1, 2]) / k[1, 1]], axis=-1),
                    step, 1.5)
        solvers['careful, steps'] = partial(integrate, pitch=1 / k[0, 0], rounds=30)
        cells = []
        for solver in solvers.values():
            seconds = best(partial(height_from_normals, normal, rays, solver=solver), 1)
            found = (1.5 - height_from_normals(normal, rays, solver=solver)) * 1e3
            known = mask & np.isfinite(found) & np.isfinite(depth)
            found *= np.median(depth[known] / found[known])
            cells.append(f'{np.abs(found - depth)[known].mean():.3f} ({seconds * 1e3:.0f})')
        table.add_row(file.stem, *cells)
    return table


def offset_table() -> Table:
    """Normals of a matt plate and of a tilted one when the part stands too high or low."""
    table = Table('stands off by, mm', 'plate, degrees', 'plate tilted 6 degrees: lights on the '
                  'plane', 'after 2 rounds')
    head = load_head(nominal_head_path())
    camera = scaled_camera(head.camera, 320, 256)
    lights = lights_at(head, MOTOR_COUNTS, 1.3)[:4]

    def plane_picture(normal: NDArray, offset: float) -> Stack:
        base = Stack([np.zeros((256, 320), np.float32)], lights[:1], camera)
        rays = stack_rays(base)
        nodes = surface_points(rays, Plane((normal[0], normal[1], normal[2]), offset))
        points = expand(nodes, rays.step, (256, 320))
        frames = [light_vectors(light, points) @ normal for light in lights]
        return Stack([(f / max(a.max() for a in frames)).astype(np.float32) for f in frames],
                     lights, camera)

    tilted = np.array([-np.sin(0.105), 0.0, np.cos(0.105)])
    for offset in (-2e-3, -1e-3, 0.0, 1e-3, 2e-3):
        cells = []
        for normal, rounds in ((np.array([0, 0, 1.0]), 2), (tilted, 0), (tilted, 2)):
            stack = plane_picture(normal, offset)
            found = reconstruct(stack, Options(height_rounds=rounds), {'normal'}).normal
            truth = np.broadcast_to(normal, found.shape)
            cells.append(f'{np.nanmean(angular_error_deg(found, truth)):.3f}')
        table.add_row(f'{offset * 1e3:+.0f}', *cells)
    return table


def rendered_table() -> Table:
    """Rendered matt scenes, 1280x1024, shot noise: near field on and off, degrees."""
    table = Table('scene', 'one capture', 'shot noise predicts', 'bias (9x9 pixels, 10 captures)',
                  'near field off', 'height error, µm')
    head = load_head(nominal_head_path())
    tilt = float(BrightFieldKinematics(head).tilt(MOTOR_COUNTS))
    lights = lights_at(head, MOTOR_COUNTS, 1.3)[:4]

    def smoothed(normal: Any) -> NDArray:
        mean = np.asarray(cv2.blur(normal.astype(np.float64), (9, 9)))
        return mean / np.linalg.norm(mean, axis=-1, keepdims=True)

    for scene in ('plate', 'tilted_plate', 'dome'):
        renderer = make_renderer(scene, head)
        truth = renderer.truth()
        assert truth.height is not None
        raised = (truth.height > 1e-6).astype(np.uint8)
        band = np.ones((21, 21), np.uint8)
        keep = cv2.dilate(raised, band) == cv2.erode(raised, band)
        keep = keep if scene == 'dome' else np.ones_like(keep)
        stacks = [Stack([renderer.render(tilt, 1.3, np.eye(4)[i], frame=4 * n + i)
                         for i in range(4)], lights, renderer.camera) for n in range(10)]
        results = [reconstruct(stack, outputs={'normal', 'height'}) for stack in stacks]
        off = reconstruct(stacks[0], Options(near_field=False), {'normal'}).normal
        assert results[0].height is not None
        height = results[0].height - truth.height
        mean = sum(result.normal.astype(np.float64) for result in results)
        errors = [angular_error_deg(results[0].normal, truth.normal),
                  angular_error_deg(smoothed(mean), smoothed(truth.normal)),
                  angular_error_deg(off, truth.normal)]
        single, bias, distant = (float(error[keep].mean()) for error in errors)
        table.add_row(scene, f'{single:.3f}', f'{_noise_deg(stacks[0], renderer.sensor):.3f}',
                      f'{bias:.4f}', f'{distant:.2f}',
                      f'{np.abs(height - np.median(height)).mean() * 1e6:.1f}')
    return table


def _noise_deg(stack: Stack, sensor: Sensor) -> float:
    """Mean angular error at the picture's centre that noise and quantisation alone give."""
    problem = photometric_problem(stack)
    i, j = (n // 2 for n in problem.lights.shape[:2])
    inverse = least_squares.pseudo_inverse(problem.lights)[i, j]
    y, x = (n // 2 for n in stack.shape)
    value = np.array([image[y - 4:y + 4, x - 4:x + 4].mean() / 255 for image in stack.images])
    variance = (value / sensor.full_well + (sensor.read_noise / sensor.full_well) ** 2
                + 1 / 12 / 255 ** 2)
    g = inverse @ value
    across = np.eye(3) - np.outer(g, g) / (g @ g)
    spread = across @ inverse @ np.diag(variance) @ inverse.T @ across
    sigma = np.sqrt(np.trace(spread) / 2 / (g @ g))
    return float(np.degrees(sigma * np.sqrt(np.pi / 2)))


def main() -> None:
    """Print the tables."""
    pipeline.warm_up()
    console = Console()
    for table in (least_squares_table, growth_table, chain_table, rendered_table, offset_table,
                  depth_table):
        console.print(table.__doc__, style='bold')
        console.print(table())


if __name__ == '__main__':
    main()
