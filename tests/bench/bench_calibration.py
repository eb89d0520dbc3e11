"""Ring calibration: accuracy over random heads and repeatability, against what is wanted.

Run with: python tests/bench/bench_calibration.py --heads 50 --scale 0.5
"""
import argparse
import math
import time
from typing import Any

import numpy as np

from ps_calibration.calibrate import calibrate
from ps_calibration.ring_fit import corrected
from ps_calibration.ring_target import RingTarget, default_target_path, load_target
from ps_calibration.synthetic import errors_of, random_bench, render_stack, solid_of
from ps_head_driver.head_model import HeadModel, load_head, nominal_head_path
from ps_head_driver.kinematics import BrightFieldKinematics
from ps_head_driver.stack import Plane


def accuracy(nominal: HeadModel, target: RingTarget, seeds: range, scale: float,
             tilt: float) -> None:
    """Print the errors over random heads, before and after the calibration."""
    counts = BrightFieldKinematics(nominal).motor_counts(tilt)
    found, before, z_scales, seconds = [], [], [], []
    for seed in seeds:
        bench = random_bench(nominal, seed)
        stack = render_stack(bench, nominal, solid_of(target), counts, scale, seed)
        start = time.perf_counter()
        result = calibrate([stack], target, nominal)
        seconds.append(time.perf_counter() - start)
        print(f'head {seed}: {result.verdict} {result.reason}', flush=True)
        if result.fit is None:
            continue
        before.append(errors_of(nominal, Plane(), bench, tilt))
        found.append(errors_of(corrected(nominal, result.fit.panels), result.fit.pose.plane,
                               bench, tilt))
        z_scales.append(abs(result.z_scale - 1))
    print(f'{"":28}{"median":>10}{"worst":>10}{"before":>10}   target')

    def row(name: str, values: Any, first: Any, wanted: str) -> None:
        was = f'{np.max(first):10.3f}' if first is not None else f'{"":10}'
        print(f'{name:28}{np.median(values):10.4f}{np.max(values):10.4f}{was}   {wanted}')

    row('light direction, deg', [e.direction_deg for e in found],
        [e.direction_deg for e in before], 'median 0.05, worst 0.15')
    row('relative intensity, %', [100 * abs(e.intensity) for e in found],
        [100 * abs(e.intensity) for e in before], '0.3')
    row('plane level, deg', [e.level_deg for e in found], [e.level_deg for e in before], '0.03')
    row('z scale, %', 100 * np.array(z_scales), None, '')
    row('time, s', seconds, None, '10')


def positions(nominal: HeadModel, target: RingTarget, scale: float) -> None:
    """Print what two motor positions, fitted together, find for the second one's tilt."""
    kinematics, bench = BrightFieldKinematics(nominal), random_bench(nominal, 3)
    counts = [kinematics.motor_counts(math.radians(degrees)) for degrees in (20, 30)]
    start = time.perf_counter()
    result = calibrate([render_stack(bench, nominal, solid_of(target), m, scale) for m in counts],
                       target, nominal)
    seconds = time.perf_counter() - start
    print(f'two positions: {result.verdict} {result.reason}')
    if result.fit is not None:
        error = result.fit.tilts[1] - float(kinematics.tilt(counts[1]))
        print(f'tilt of the second against the first: {math.degrees(error):.4f} deg off, '
              f'{seconds:.1f} s with rendering')


def repeatability(nominal: HeadModel, target: RingTarget, repeats: int, scale: float,
                  tilt: float) -> None:
    """Print the scatter of the light directions over pictures that differ by their noise."""
    counts = BrightFieldKinematics(nominal).motor_counts(tilt)
    bench = random_bench(nominal, 3)
    directions = []
    for seed in range(repeats):
        stack = render_stack(bench, nominal, solid_of(target), counts, scale, 100 + seed)
        fit = calibrate([stack], target, nominal).fit
        if fit is not None:
            directions.append(errors_of(corrected(nominal, fit.panels), fit.pose.plane, bench,
                                        tilt).direction_deg)
    print(f'repeatability over {len(directions)}, deg '
          f'{np.std(directions, axis=0, ddof=1).max():.4f}   target 0.01')


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--only',
                        choices=('accuracy', 'positions', 'repeatability'))
    parser.add_argument('--heads', type=int, default=10)
    parser.add_argument('--first', type=int, default=1, help='seed of the first head')
    parser.add_argument('--scale', type=float, default=0.5, help='of the pictures')
    parser.add_argument('--tilt-deg', type=float, default=30.0)
    arguments, _ = parser.parse_known_args()       # tests.bench passes the names of benches
    nominal, target = load_head(nominal_head_path()), load_target(default_target_path())
    scale, tilt = arguments.scale, math.radians(arguments.tilt_deg)
    # the tilt that the motor reaches, rounded to a count
    tilt = float(BrightFieldKinematics(nominal).tilt(
        BrightFieldKinematics(nominal).motor_counts(tilt)))
    if arguments.only in (None, 'accuracy'):
        seeds = range(arguments.first, arguments.first + arguments.heads)
        accuracy(nominal, target, seeds, scale, tilt)
    if arguments.only in (None, 'positions'):
        positions(nominal, target, scale)
    if arguments.only in (None, 'repeatability'):
        repeatability(nominal, target, 10, scale, tilt)


if __name__ == '__main__':
    main()
