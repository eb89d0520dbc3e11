"""STV: time against its NumPy oracle, deviation from it, growth, memory."""
from collections.abc import Callable
import dataclasses
from functools import partial
import time
import tracemalloc
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from ps_head_driver.camera_model import scaled_camera
from ps_head_driver.head_model import load_head, nominal_head_path
from ps_head_driver.kinematics import lights_at
from ps_head_driver.stack import Stack, angular_error_deg
from ps_reconstruction import least_squares, stv, stv_oracle
from ps_reconstruction.near_field import photometric_problem
from ps_reconstruction.problem import Problem, expand
from ps_reconstruction.stv import StvOptions, Trust

FIVE_MP = (2048, 2448)
MOTOR_COUNTS = 25000


def best(action: Callable[[], Any], rounds: int = 3) -> float:
    """Shortest time of some calls, s; one call before them warms up."""
    action()
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        action()
        times.append(time.perf_counter() - start)
    return min(times)


def near_field_scene(shape: tuple[int, int], count: int = 4) -> tuple[Problem, NDArray]:
    """8-bit pictures of a glossy, wavy surface under the panels (repeated), and its normals."""
    head = load_head(nominal_head_path())
    lights = lights_at(head, MOTOR_COUNTS, 1.3)[:4] * (count // 4)
    empty = [np.zeros(shape, np.uint8)] * len(lights)
    problem = photometric_problem(Stack(
        empty, lights, scaled_camera(head.camera, shape[1], shape[0])))
    y, x = np.mgrid[:shape[0], :shape[1]].astype(np.float32)
    normal = np.stack([0.25 * np.sin(x / 40), 0.25 * np.sin(y / 50), np.ones_like(x)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    rng = np.random.default_rng(0)
    frames: list[NDArray] = []
    pictures: list[NDArray] = []
    for t in range(count):
        if t < 4:
            light = expand(problem.lights[:, :, t], problem.step, shape).astype(np.float32)
            power = np.linalg.norm(light, axis=-1)
            half = light / power[..., None] + np.array([0, 0, 1], np.float32)
            half /= np.linalg.norm(half, axis=-1, keepdims=True)
            cosine = np.sum(normal * half, axis=-1)
            pictures.append(np.clip(np.sum(normal * light, axis=-1), 0, None)
                            + 0.4 * power / (1 + (1 / cosine ** 2 - 1) / 0.02) ** 2)
        noisy = pictures[t % 4] * (200 / pictures[0].max()) + rng.normal(0, 1, shape)
        frames.append(np.clip(np.round(noisy), 0, 255).astype(np.uint8))
    return dataclasses.replace(problem, frames=frames), normal


def crop(problem: Problem, size: int) -> Problem:
    """The upper left corner, under the same lights."""
    return dataclasses.replace(problem, frames=[
        np.ascontiguousarray(f[:size, :size]) for f in problem.frames])


def speed_table() -> Table:
    """The compiled solver against least squares and the oracle, per pixel."""
    table = Table('4 x 2448x2048, 8 bit, near field', 's', 'x LS', 'oracle: x per pixel',
                  'mean error, deg')
    problem, normal = near_field_scene(FIVE_MP)
    out = least_squares.empty_solution(problem)
    pixels = FIVE_MP[0] * FIVE_MP[1]

    def row(name: str, seconds: float, oracle: str) -> None:
        error = np.nanmean(angular_error_deg(out.normal[::4, ::4], normal[::4, ::4]))
        table.add_row(name, f'{seconds:.3f}', f'{seconds / plain:.1f}', oracle, f'{error:.2f}')

    plain = best(partial(least_squares.solve, problem, True, out))
    row('least squares', plain, '')
    small = crop(problem, 40)
    decided = stv.plan(problem)
    start = time.perf_counter()
    g = stv_oracle.solve(small, decided=decided)
    slow = (time.perf_counter() - start) / 1600
    for name, options in (('STV, no patches', StvOptions(patch=1)), ('STV, 5x5', StvOptions())):
        seconds = best(partial(stv.solve, problem, options, True, out))
        row(name, seconds, f'{slow / (seconds / pixels):.0f}' if options.patch == 5 else '')
    deviation = angular_error_deg(g / np.linalg.norm(g, axis=-1, keepdims=True),
                                  out.normal[:40, :40])[:36, :36]
    table.caption = (f'trust {decided.trust.name}; deviation from the oracle, weights shared: '
                     f'median {np.nanmedian(deviation):.3f}, '
                     f'p90 {np.nanpercentile(deviation, 90):.3f} deg')
    return table


def growth_table() -> Table:
    """Time per pixel and light over image size and number of lights; all stages forced on."""
    table = Table('megapixels', 'lights', 's', 'ns per pixel and light', 'float32 planes')
    head = load_head(nominal_head_path())
    panels = lights_at(head, MOTOR_COUNTS, 1.3)[:4]
    rng = np.random.default_rng(0)
    options = StvOptions(trust=Trust.REFLECTANCE)
    for shape, count in (((512, 640), 4), ((1024, 1280), 4), (FIVE_MP, 4), ((3648, 5472), 4),
                         ((512, 640), 8), ((512, 640), 16), ((512, 640), 96)):
        problem = photometric_problem(Stack(
            [rng.integers(100, 120, shape, np.uint8) for _ in range(count)],
            panels * (count // 4), scaled_camera(head.camera, shape[1], shape[0])))
        out = least_squares.empty_solution(problem)
        seconds = best(partial(stv.solve, problem, options, True, out), 1)
        tracemalloc.start()
        stv.solve(problem, options, True, out)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        pixels = shape[0] * shape[1]
        table.add_row(f'{pixels / 1e6:.1f}', str(count), f'{seconds:.3f}',
                      f'{seconds / pixels / count * 1e9:.1f}', f'{peak / (4 * pixels):.2f}')
    return table


def main() -> None:
    """Print the tables."""
    console = Console(width=130)
    console.print(speed_table())
    console.print(growth_table())


if __name__ == '__main__':
    main()
