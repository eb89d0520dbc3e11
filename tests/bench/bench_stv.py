"""STV: time against its NumPy oracle, deviation from it, growth, memory, rendered shapes."""
from collections.abc import Callable
import dataclasses
from functools import partial
import os
from pathlib import Path
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
from ps_reconstruction.problem import Problem, constant_lights, expand
from ps_reconstruction.stv import StvOptions, Trust

DATA = Path(os.environ.get('PS_DATA', Path(__file__).resolve().parents[3] / 'shared' / 'data'))
FIVE_MP = (2048, 2448)
MOTOR_COUNTS = 25000
RING_SLANT = 25.0      # degrees, of the light rings over the rendered shapes


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


def ggx(n_l: NDArray, n_h: NDArray, n_v: NDArray, l_h: NDArray, alpha: float, f0: float
        ) -> NDArray:
    """Cook-Torrance reflectance: GGX distribution, Smith's shadowing, Schlick's Fresnel."""
    square = alpha * alpha
    distribution = square / (np.pi * (n_h ** 2 * (square - 1) + 1) ** 2)

    def shadowing(cosine: NDArray) -> NDArray:
        return 2 * cosine / (cosine + np.sqrt(square + (1 - square) * cosine ** 2))

    fresnel = f0 + (1 - f0) * (1 - l_h) ** 5
    lit = np.maximum(n_l, 1e-3)
    result: NDArray = distribution * shadowing(lit) * shadowing(n_v) * fresnel / (4 * lit * n_v)
    return result


REFLECTANCES = {     # diffuse albedo; roughness and normal reflectance of the gloss
    'matt': (0.7, 0.3, 0.0), 'satin': (0.4, 0.4, 0.08), 'glossy': (0.5, 0.2, 0.05),
    'metal-like': (0.0, 0.35, 0.8), 'smooth metal': (0.03, 0.2, 0.8)}


def visible(depth: NDArray, mask: NDArray, camera: NDArray, light: NDArray) -> NDArray:
    """Whether the light reaches each pixel of the mask: a march over the depth map."""
    v, u = np.nonzero(mask)
    fx, fy, cx, cy = camera[0, 0], camera[1, 1], camera[0, 2], camera[1, 2]
    z = depth[v, u]
    point = np.stack([(u - cx) / fx * z, -(v - cy) / fy * z, -z], axis=-1)
    pitch = float(np.mean(z) / fx)
    seen = np.ones(len(u), np.bool_)
    step = 3.0
    while step < 600 and seen.any():
        place = point + pitch * step * light
        row = np.round(cy - fy * place[:, 1] / -place[:, 2]).astype(int)
        column = np.round(cx + fx * place[:, 0] / -place[:, 2]).astype(int)
        inside = ((row >= 0) & (row < mask.shape[0]) & (column >= 0) & (column < mask.shape[1]))
        row, column = np.where(inside, row, 0), np.where(inside, column, 0)
        hit = inside & mask[row, column] & (
            -depth[row, column] > place[:, 2] + pitch * (0.3 + 0.002 * step))
        seen &= ~hit
        step *= 1.03
        step += 0.5
    return seen


def shapes_table(directions: NDArray) -> Table:
    """Mean and p90 error of LS and STV on the seven ground-truth shapes, with cast shadows."""
    table = Table('shape', *REFLECTANCES, title=f'{len(directions)} lights: LS mean/p90 > STV')
    worse = 0
    for file in sorted((DATA / 'diligent_depth').glob('*.npz')):
        with np.load(file) as arrays:
            truth, camera = arrays['normal'].astype(float), arrays['K']
            depth, mask = arrays['depth_mm'].astype(float), arrays['mask'].astype(bool)
        mask &= np.isfinite(depth) & (np.linalg.norm(truth, axis=-1) > 0.5)
        rows, columns = np.nonzero(mask)
        corner = (rows.min(), columns.min())
        window = (slice(corner[0], rows.max() + 1), slice(corner[1], columns.max() + 1))
        v, u = np.nonzero(mask)
        view = -np.stack([(u - camera[0, 2]) / camera[0, 0], -(v - camera[1, 2]) / camera[1, 1],
                          -np.ones(len(u))], axis=-1)
        view /= np.linalg.norm(view, axis=1, keepdims=True)
        n = truth[mask]
        seen = np.stack([visible(depth, mask, camera, d) for d in directions], axis=-1)
        n_l, n_v = n @ directions.T, np.clip(np.sum(n * view, axis=1), 0.02, 1)[:, None]
        half = directions + view[:, None]
        half /= np.linalg.norm(half, axis=-1, keepdims=True)
        n_h = np.clip(np.einsum('pi,pti->pt', n, half), 0, 1)
        l_h = np.einsum('ti,pti->pt', directions, half)
        cells = []
        for diffuse, alpha, f0 in REFLECTANCES.values():
            value = (diffuse / np.pi + (ggx(n_l, n_h, n_v, l_h, alpha, f0) if f0 else 0)
                     ) * np.maximum(n_l, 0) * seen
            value *= 0.7 / np.percentile(value, 99)
            value += 0.002 * np.random.default_rng(0).normal(size=value.shape)
            frames = []
            for t in range(len(directions)):
                frame = np.zeros(mask.shape)
                frame[mask] = np.clip(value[:, t], 0, 1)
                frames.append(np.round(frame[window] * 65535).astype(np.uint16))
            grid, step = constant_lights(directions, frames[0].shape)
            problem = Problem(frames, grid, step, np.full((len(directions), 1), 1 / 65535),
                              mask=np.ascontiguousarray(mask[window]), saturation=65535)
            pair = []
            for solution in (least_squares.solve(problem), stv.solve(problem)):
                error = angular_error_deg(solution.normal[problem.mask], n)
                error = np.where(np.isfinite(error), error, 90)
                pair.append((float(error.mean()), float(np.percentile(error, 90))))
            worse += any(b > a + 0.005 for a, b in zip(*pair, strict=True))
            cells.append(f'{pair[0][0]:.2f}/{pair[0][1]:.2f} > {pair[1][0]:.2f}/{pair[1][1]:.2f}')
        table.add_row(file.stem, *cells)
    table.caption = f'STV worse than LS in mean or p90: {worse}'
    return table


def main() -> None:
    """Print the tables."""
    console = Console(width=130)
    console.print(speed_table())
    console.print(growth_table())
    folder = DATA / 'diligent' / 'ballPNG'
    if not (DATA / 'diligent_depth').is_dir() or not folder.is_dir():
        console.print(f'{DATA}: no DiLiGenT data, no rendered shapes')
        return
    directions = np.loadtxt(folder / 'light_directions.txt')
    azimuth = np.radians([0, 90, 180, 270])
    slant = np.radians(RING_SLANT)
    ring = np.stack([np.sin(slant) * np.cos(azimuth), np.sin(slant) * np.sin(azimuth),
                     np.full(4, np.cos(slant))], axis=-1)
    four = np.argmax(ring @ directions.T, axis=1)
    console.print(shapes_table(directions[four]))
    if os.environ.get('PS_BENCH_ALL'):      # takes minutes
        console.print(shapes_table(directions))


if __name__ == '__main__':
    main()
