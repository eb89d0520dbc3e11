"""Ring calibration over random heads, against the targets of the project.

Run with: python tests/bench/bench_calibration.py --heads 50 --scale 1
"""
import argparse
import math
import time

import numpy as np

from ps_calibration.calibrate import calibrate
from ps_calibration.ring_fit import corrected
from ps_calibration.ring_target import default_target_path, load_target
from ps_calibration.synthetic import errors_of, random_bench, render_stack, solid_of
from ps_head_driver.head_model import load_head, nominal_head_path
from ps_head_driver.kinematics import BrightFieldKinematics


def main() -> None:
    """Print one table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--heads', type=int, default=10)
    parser.add_argument('--first', type=int, default=1, help='seed of the first head')
    parser.add_argument('--scale', type=float, default=1.0, help='of the pictures')
    parser.add_argument('--tilt-deg', type=float, default=30.0)
    arguments = parser.parse_args()
    nominal, target = load_head(nominal_head_path()), load_target(default_target_path())
    kinematics = BrightFieldKinematics(nominal)
    counts = kinematics.motor_counts(math.radians(arguments.tilt_deg))
    directions, intensities, levels, z_scales, seconds = [], [], [], [], []
    for seed in range(arguments.first, arguments.first + arguments.heads):
        bench = random_bench(nominal, seed)
        stack = render_stack(bench, nominal, solid_of(target), counts, arguments.scale, seed)
        start = time.perf_counter()
        result = calibrate([stack], target, nominal)
        seconds.append(time.perf_counter() - start)
        print(f'head {seed}: {result.verdict} {result.reason}', flush=True)
        if result.fit is None:
            continue
        errors = errors_of(corrected(nominal, result.fit.panels), result.fit.pose.plane, bench,
                           float(kinematics.tilt(counts)))
        directions.append(errors.direction_deg)
        intensities.append(abs(errors.intensity))
        levels.append(errors.level_deg)
        z_scales.append(abs(result.z_scale - 1))
    print(f'{"":28}{"median":>10}{"worst":>10}   target')
    for name, values, target_text in (
            ('light direction, deg', directions, 'median 0.05, worst 0.15'),
            ('relative intensity, %', np.array(intensities) * 100, '0.3'),
            ('plane level, deg', levels, '0.03'),
            ('z scale, %', np.array(z_scales) * 100, ''),
            ('time, s', seconds, '10')):
        print(f'{name:28}{np.median(values):10.4f}{np.max(values):10.4f}   {target_text}')


if __name__ == '__main__':
    main()
