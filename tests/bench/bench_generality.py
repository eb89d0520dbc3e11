"""LS and STV on seven rendered shapes, many materials, 96, ten and four lights: never worse."""
from dataclasses import asdict
import json
import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from ps_head_driver.stack import angular_error_deg
from ps_reconstruction import least_squares, stv
from ps_reconstruction.benchmark import Error, rank_correlation
from ps_reconstruction.problem import Problem, constant_lights
from tests.bench.shape_renderer import MATERIALS, MIXED, Shape

DATA = Path(os.environ.get('PS_DATA', Path(__file__).resolve().parents[3] / 'shared' / 'data'))
THREE = ('matt', 'glossy', 'metal-like')      # by default; PS_BENCH_ALL=1: all
SETS = {'four': [76, 56, 28, 49], 'ten': [76, 56, 28, 49, 96, 48, 4, 41, 89, 17],
        '96': list(range(1, 97))}             # 1-based numbers of DiLiGenT's lights
WORSE = 0.005                                 # degrees, what counts as worse


def problem_of(shape: Shape, value: NDArray, lights: list[int]) -> Problem:
    """16-bit pictures (P, T) of a shape under the lights of these numbers."""
    window = shape.window()
    frames = []
    for t in lights:
        frame = np.zeros(shape.mask.shape)
        frame[shape.mask] = value[:, t - 1]
        frames.append(np.round(frame[window] * 65535).astype(np.uint16))
    grid, step = constant_lights(shape.directions[np.array(lights) - 1], frames[0].shape)
    return Problem(frames, grid, step, np.full((len(lights), 1), 1 / 65535),
                   mask=np.ascontiguousarray(shape.mask[window]), saturation=65535)


def compare(shape: Shape, value: NDArray, lights: list[int]) -> tuple[Error, Error, float, str]:
    """Errors of LS and of STV, rank correlation of STV's confidence, and its trust."""
    problem = problem_of(shape, value, lights)
    decided = stv.plan(problem)
    found = {'ls': least_squares.solve(problem), 'stv': stv.solve(problem, decided=decided)}
    degrees = {name: angular_error_deg(solution.normal[problem.mask], shape.normal)
               for name, solution in found.items()}
    confidence = found['stv'].confidence
    assert confidence is not None
    return (Error.of(degrees['ls']), Error.of(degrees['stv']),
            rank_correlation(confidence[problem.mask], -degrees['stv']), decided.trust.name)


def text(error: Error) -> str:
    """Mean / median / p90."""
    return f'{error.mean:.2f} / {error.median:.2f} / {error.p90:.2f}'


def main() -> None:
    """Print one table, and how often STV is worse."""
    console = Console(width=120)
    folder = DATA / 'diligent' / 'ballPNG'
    files = sorted((DATA / 'diligent_depth').glob('*.npz'))
    if not files or not folder.is_dir():
        console.print(f'{DATA}: no DiLiGenT data, no rendered shapes')
        return
    directions = np.loadtxt(folder / 'light_directions.txt')
    materials = [*MATERIALS, *MIXED] if os.environ.get('PS_BENCH_ALL') else list(THREE)
    chosen = [name for name in os.environ.get('PS_BENCH_SHAPES', '').split(',') if name]
    table = Table('lights', 'material', 'shape', 'LS', 'STV', 'trust', 'confidence: rank corr.',
                  title='angular error, degrees: mean / median / p90')
    worse = total = 0
    rows = []
    for file in files:
        if chosen and file.stem not in chosen:
            continue
        shape = Shape.load(file, directions, int(os.environ.get('PS_BENCH_STRIDE', '1')))
        for material in materials:
            value = shape.render(material)
            for name, lights in SETS.items():
                ls, robust, correlation, trust = compare(shape, value, lights)
                rows.append((name, material, shape.name, asdict(ls), asdict(robust), correlation))
                bad = robust.mean > ls.mean + WORSE or robust.p90 > ls.p90 + WORSE
                worse, total = worse + bad, total + 1
                if bad:
                    console.print(f'worse: {shape.name}, {material}, {name} lights: {text(ls)} > '
                                  f'{text(robust)}, {trust}', style='red')
                table.add_row(name, material, shape.name, text(ls), text(robust) + ' !' * bad,
                              trust, f'{correlation:.2f}')
        console.print(f'{shape.name}: done, {worse} of {total} worse', style='dim')
    table.caption = f'STV worse than LS in mean or p90: {worse} of {total}'
    console.print(table)
    if os.environ.get('PS_BENCH_JSON'):
        Path(os.environ['PS_BENCH_JSON']).write_text(json.dumps(rows), encoding='utf-8')


if __name__ == '__main__':
    main()
