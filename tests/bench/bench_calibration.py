"""Ring calibration over random heads and over wrong pictures, against the targets of the project.

Run with: python tests/bench/bench_calibration.py --heads 50 --scale 0.5
"""
import argparse
import math
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ps_calibration.calibrate import calibrate
from ps_calibration.ring_fit import corrected
from ps_calibration.ring_target import RingTarget, default_target_path, load_target
from ps_calibration.synthetic import (
    Bench,
    errors_of,
    random_bench,
    render_stack,
    solid_of,
    with_images,
)
from ps_head_driver.head_model import HeadModel, load_head, nominal_head_path
from ps_head_driver.kinematics import BrightFieldKinematics
from ps_head_driver.stack import Plane, Stack


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


def _pictures(stack: Stack, **frames: NDArray) -> Stack:
    names = ['E', 'N', 'W', 'S', 'ALL', 'NONE']
    return with_images(stack, [frames.get(name, image)
                               for name, image in zip(names, stack.images, strict=True)])


def _with_specks(stack: Stack) -> Stack:
    """Dust on the plate: sixty dark specks of a few pixels, the same in all pictures."""
    random = np.random.default_rng(5)
    images = [image.copy() for image in stack.images]
    for _ in range(60):
        row, column = (int(random.integers(0, n - 4)) for n in stack.shape)
        for image in images:
            image[row:row + 3, column:column + 3] //= 3
    return with_images(stack, images)


def confusion(nominal: HeadModel, target: RingTarget, scale: float, tilt: float) -> None:
    """Print the verdict on good and on wrong pictures."""
    counts, bench = BrightFieldKinematics(nominal).motor_counts(tilt), random_bench(nominal, 3)
    slits = target.slits.azimuths

    def ring(at: Bench = bench, **changes: Any) -> Stack:
        return render_stack(at, nominal, solid_of(target, **changes), counts, scale, 3)

    good = ring()
    east, north, _, south, all_on, none = good.images
    cases = {
        'good': good,
        'good, 60 specks of dust': _with_specks(good),
        'ring missing': ring(height=0.0),
        'turned over': ring(height=0.0, dots=np.array([[0.1, 0.1]])),
        'wall 25 % too high': ring(height=1.25 * target.height),
        'radii 0.5 mm too small': ring(radii=(target.inner_radius - 5e-4,
                                              target.outer_radius - 5e-4)),
        'middle slit blocked': ring(slits=slits[:2] + slits[3:]),
        'panel N dead': _pictures(good, N=none),
        'panels E and N swapped': _pictures(good, E=north, N=east),
        'frame E saturated': _pictures(
            good, E=np.clip(east.astype(int) * 3, 0, 255).astype(np.uint8)),
        'too dark': with_images(good, [image // 20 for image in good.images]),
        'moved by 2 px in frame S': _pictures(good, S=np.roll(south, 2, axis=1)),
        'something else': with_images(good, [
            *[np.full_like(all_on, 100)] * 5, np.zeros_like(none)]),
    }
    print(f'{"pictures":26}{"verdict":9}reason')
    for name, stack in cases.items():
        result = calibrate([stack], target, nominal)
        print(f'{name:26}{result.verdict:9}{result.reason}', flush=True)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--only',
                        choices=('accuracy', 'positions', 'repeatability', 'confusion'))
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
    if arguments.only in (None, 'confusion'):
        confusion(nominal, target, scale, tilt)


if __name__ == '__main__':
    main()
