"""Convergence radius: time per solve, nominal head and 300 heads with random tolerances."""
from collections.abc import Callable
from contextlib import suppress
import time

import numpy as np
from rich.console import Console
from rich.table import Table

from ps_head_driver.convergence_radius import CrSolver, forward, inverse
from ps_head_driver.errors import PsError
from ps_head_driver.head_model import DIRECTIONS, HeadModel, load_head, nominal_head_path

HEADS = 300
WANTED = 0.06


def _with_tolerances(head: HeadModel, rng: np.random.Generator) -> HeadModel:
    data = head.model_dump()
    for name in DIRECTIONS:
        data['bright_field']['panels'][name].update(
            tilt_offset=rng.normal(0, 0.01), twist=rng.normal(0, 0.01),
            shift=tuple(rng.normal(0, 1e-3, 3)))
    return HeadModel.model_validate(data)


def _times_ms(action: Callable, arguments: list) -> np.ndarray:
    times = []
    for argument in arguments:
        start = time.perf_counter()
        with suppress(PsError):      # a refusal takes a full search as well
            action(argument)
        times.append((time.perf_counter() - start) * 1e3)
    return np.array(times)


def main() -> None:
    """Print the table."""
    nominal = load_head(nominal_head_path())
    rng = np.random.default_rng(0)
    random = [_with_tolerances(nominal, rng) for _ in range(HEADS)]
    inverse(nominal, WANTED)      # compiles the circle fit
    table = Table(title='Wall time per solve, ms')
    for title in ('heads', 'what', 'median', '99 %'):
        table.add_column(title)
    for heads_name, heads in (('nominal', [nominal] * HEADS), ('random', random)):
        solvers = [CrSolver(head) for head in heads]
        for solver in solvers:
            with suppress(PsError):
                solver.inverse(WANTED)
        for what, action, arguments in (
                ('inverse, from the head file', lambda head: inverse(head, WANTED), heads),
                ('inverse, same head again', lambda solver: solver.inverse(WANTED), solvers),
                ('forward, from the head file', lambda head: forward(head, 20000), heads),
                ('forward, same head again', lambda solver: solver.forward(20000), solvers)):
            times = _times_ms(action, arguments)
            table.add_row(heads_name, what, f'{np.median(times):.2f}',
                          f'{np.percentile(times, 99):.2f}')
    Console().print(table)


if __name__ == '__main__':
    main()
