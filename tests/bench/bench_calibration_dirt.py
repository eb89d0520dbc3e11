"""Ring calibration from a dirty, scratched or shiny target: verdict and what the lights are off.

Run with: python -m tests.bench calibration_dirt, or larger pictures
python tests/bench/bench_calibration_dirt.py --scale 1
"""
import argparse
from collections.abc import Callable
import math

from rich.console import Console
from rich.table import Table

from ps_calibration.calibrate import calibrate
from ps_calibration.ring_fit import corrected
from ps_calibration.ring_target import default_target_path, load_target
from ps_calibration.synthetic import errors_of, random_bench, render_stack, solid_of
from ps_calibration.synthetic_dirt import glints, shiny_wall, specks
from ps_head_driver.head_model import load_head, nominal_head_path
from ps_head_driver.kinematics import BrightFieldKinematics
from ps_head_driver.stack import Stack

_HEAD = 3                # seed


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--scale', type=float, default=0.4, help='of the pictures')
    arguments, _ = parser.parse_known_args()       # tests.bench passes the names of benches
    nominal, target = load_head(nominal_head_path()), load_target(default_target_path())
    counts = BrightFieldKinematics(nominal).motor_counts(math.radians(30))
    bench = random_bench(nominal, _HEAD)
    clean = render_stack(bench, nominal, solid_of(target), counts, arguments.scale, _HEAD)
    tilt = float(BrightFieldKinematics(nominal).tilt(counts))
    cases: list[tuple[str, Callable[[Stack], Stack]]] = [
        ('clean', lambda stack: stack),
        *((f'{n} specks of dust', lambda stack, n=n: specks(stack, n)) for n in (50, 200, 800)),
        *((f'{n} glints a panel', lambda stack, n=n: glints(stack, n)) for n in (10, 40, 160)),
        *((f'wall throws {100 * part:g} % onto the plate',
           lambda stack, part=part: shiny_wall(stack, bench, target, part))
          for part in (0.02, 0.05, 0.1)),
    ]
    table = Table(title=f'One head, pictures at scale {arguments.scale:g}')
    for column in ('target', 'verdict', 'direction, deg', 'intensity, %', 'level, deg',
                   'z scale, %', 'reason'):
        table.add_column(column)
    for name, spoil in cases:
        result = calibrate([spoil(clean)], target, nominal)
        figures = [''] * 4
        if result.fit is not None:
            off = errors_of(corrected(nominal, result.fit.panels), result.fit.pose.plane, bench,
                            tilt)
            figures = [f'{off.direction_deg.max():.3f}', f'{100 * abs(off.intensity).max():.2f}',
                       f'{off.level_deg:.3f}', f'{100 * (result.z_scale - 1):+.2f}']
        table.add_row(name, result.verdict, *figures, result.reason)
    Console(width=120).print(table)


if __name__ == '__main__':
    main()
