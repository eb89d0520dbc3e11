"""CR reached after a motor calibration from rendered ring pictures, arriving from either side.

Run with: python -m tests.bench motor_calibration, or more heads and larger pictures:
python tests/bench/bench_motor_calibration.py --heads 3 --scale 1
"""
import argparse
import math

from rich.console import Console
from rich.table import Table

from ps_calibration.calibrate import calibrate
from ps_calibration.motor_calibration import Approach, motor_of
from ps_calibration.ring_fit import corrected
from ps_calibration.ring_target import RingTarget, default_target_path, load_target
from ps_calibration.synthetic import random_bench, render_stack, solid_of
from ps_head_driver.convergence_radius import CrSolver
from ps_head_driver.head_model import HeadModel, load_head, nominal_head_path
from ps_head_driver.kinematics import BrightFieldKinematics

PLAY = 300                                                       # counts
POSITIONS: tuple[tuple[float, Approach], ...] = (
    (12, 'up'), (20, 'up'), (26, 'down'), (30, 'up'), (34, 'down'))    # degrees by design
WANTED = (0.03, 0.045, 0.06, 0.08, 0.1, 0.12)                    # CR, m


def as_made(head: HeadModel) -> HeadModel:
    """A head whose crank and rod are not as designed: 0.57 degrees, 0.2 %, 0.1 mm."""
    field = head.bright_field
    crank = field.crank.model_copy(update={
        'offset': field.crank.offset + 0.01, 'radius': field.crank.radius * 1.002})
    return head.model_copy(update={'bright_field': field.model_copy(update={
        'crank': crank, 'rod_length': field.rod_length - 1e-4})})


def one_head(nominal: HeadModel, target: RingTarget, seed: int, scale: float,
             ) -> list[tuple[float, float, float]]:
    """Errors of CR before, and after when arriving from below and from above, m, per WANTED."""
    bench = random_bench(nominal, seed)
    real, designed = as_made(bench.head), BrightFieldKinematics(nominal)
    motor, stacks = BrightFieldKinematics(real), []
    for degrees, side in POSITIONS:
        counts = designed.motor_counts(math.radians(degrees))
        tilt = float(motor.tilt(counts + PLAY * (side == 'down')))
        stacks.append(render_stack(bench, nominal, solid_of(target), counts, scale,
                                   round(10 * seed + degrees), tilt))
    result = calibrate(stacks, target, nominal)
    found = motor_of(result, stacks, nominal, [side for _, side in POSITIONS])
    if result.fit is None or found is None:
        raise SystemExit(f'head {seed}: {result.verdict} {result.reason}')
    head = corrected(nominal, result.fit.panels)
    head = head.model_copy(update={'bright_field': found.correction.corrected(head.bright_field)})
    calibrated, true, before = CrSolver(head), CrSolver(real), CrSolver(nominal)

    def error(counts: int, wanted: float) -> float:
        return true.forward(counts).convergence_radius - wanted

    return [(error(before.inverse(wanted).motor_counts, wanted), error(counts, wanted),
             error(round(counts - found.backlash_counts) + PLAY, wanted))
            for wanted in WANTED for counts in [calibrated.inverse(wanted).motor_counts]]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--heads', type=int, default=1)
    parser.add_argument('--scale', type=float, default=0.5, help='of the pictures')
    arguments, _ = parser.parse_known_args()       # tests.bench passes the names of benches
    nominal, target = load_head(nominal_head_path()), load_target(default_target_path())
    table = Table(title=f'CR at scale {arguments.scale:g}, errors in mm; wanted 0.2')
    for column in ('head', 'CR*, mm', 'before', 'from below', 'from above'):
        table.add_column(column, justify='right')
    for seed in range(1, arguments.heads + 1):
        for wanted, errors in zip(WANTED, one_head(nominal, target, seed, arguments.scale),
                                  strict=True):
            table.add_row(str(seed), f'{1e3 * wanted:.0f}', *(f'{1e3 * e:+.2f}' for e in errors))
    Console(width=110).print(table)


if __name__ == '__main__':
    main()
