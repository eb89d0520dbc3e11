"""Calibration of the dark-field panels over random heads, and what it does for a reconstruction.

Run with: python -m tests.bench dark_field_calibration, or for more heads
python tests/bench/bench_dark_field_calibration.py --heads 20
"""
import argparse
import math
import time
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from ps_calibration.before_after import outcome, relit
from ps_calibration.calibrate import calibrate, head_calibration
from ps_calibration.ring_fit import corrected
from ps_calibration.ring_target import RingTarget, default_target_path, load_target
from ps_calibration.synthetic import (
    dark_errors,
    errors_of,
    random_bench,
    render_stack,
    solid_of,
)
from ps_head_driver.calibration_file import PanelName
from ps_head_driver.head_model import HeadModel, load_head, nominal_head_path
from ps_head_driver.kinematics import BrightFieldKinematics
from ps_head_driver.stack import Mode, Truth

_ROWS = (('direction', 'light direction, deg'),
         ('relative', 'light of the four relative to each other, %'),
         ('mixed', 'light relative to the bright field, %'),
         ('bright', 'bright field, light direction, deg'),
         ('plate_df', 'flat plate from four DF pictures, normal bias, deg'),
         ('plate_bf_df', 'flat plate from BF and DF pictures, normal bias, deg'))
_DARK: tuple[PanelName, ...] = ('DF_E', 'DF_N', 'DF_W', 'DF_S')


def one_head(nominal: HeadModel, target: RingTarget, seed: int, scale: float, counts: int,
             with_plate: bool) -> dict[str, Any]:
    """Errors of one head before and after, and with the bright field alone calibrated."""
    bench = random_bench(nominal, seed)
    stack = render_stack(bench, nominal, solid_of(target), counts, scale, seed, dark_field=True)
    start = time.perf_counter()
    result = calibrate([stack], target, nominal)
    found: dict[str, Any] = {'verdicts': f'{result.verdict}/{result.dark.verdict}',
                             'reason': result.full_reason,
                             'seconds': time.perf_counter() - start,
                             'dark_s': result.timings_s.get('dark_field', math.nan)}
    if result.fit is None:
        return found
    tilt = float(BrightFieldKinematics(nominal).tilt(counts))
    made = head_calibration(result, nominal, target)
    without = made.model_copy(update={'panels': {
        name: panel for name, panel in made.panels.items() if name not in _DARK}})
    bright = errors_of(nominal, result.fit.pose.plane, bench, tilt).direction_deg.max()
    for when, head in (('before', nominal), ('after', result.dark.corrected(nominal))):
        errors = dark_errors(head, bench)
        mean = float(np.mean(errors.strength))
        found[when] = {'direction': float(errors.direction_deg.max()),
                       'relative': 100 * float(abs(errors.strength - mean).max()),
                       'mixed': 100 * abs(mean), 'bright': float(bright)}
    found['after']['bright'] = float(errors_of(
        corrected(nominal, result.fit.panels), result.fit.pose.plane, bench,
        tilt).direction_deg.max())
    if with_plate:
        blank = render_stack(bench, nominal, solid_of(target, height=0.0, dots=np.empty((0, 2))),
                             counts, scale, seed, dark_field=True)
        normal = bench.where.rotation[:, 2].astype(np.float32)
        truth = Truth(normal=np.broadcast_to(normal, (*blank.shape, 3)).copy())
        grazing = blank.subset([i for i, light in enumerate(blank.lights)
                                if light.mode == Mode.DARK_FIELD or light.name == 'NONE'])
        for when, calibration in (('before', without), ('after', made)):
            for name, pictures in (('plate_df', grazing), ('plate_bf_df', blank)):
                found[when][name] = outcome(relit(pictures, nominal, calibration),
                                            truth).bias_deg
    return found


def table(found: list[dict[str, Any]], scale: float) -> Table:
    """One row per figure, the worst panel of each head."""
    verdicts = [entry['verdicts'] for entry in found]
    made = Table(title=f'{len(found)} heads at scale {scale:g}; bright/dark field: '
                       + ', '.join(f'{verdicts.count(v)} {v}' for v in sorted(set(verdicts))))
    for column in ('', 'heads', 'before, median', 'before, worst', 'after, median',
                   'after, worst'):
        made.add_column(column, justify='right' if column else 'left')
    for name, row in _ROWS:
        before, after = ([entry[when][name] for entry in found if name in entry.get(when, {})]
                         for when in ('before', 'after'))
        if after:
            made.add_row(row, str(len(after)), *(f'{value:.3g}' for value in (
                np.median(before), max(before), np.median(after), max(after))))
    for name, row in (('dark_s', 'time for the dark field, s'), ('seconds', 'for all, s')):
        times = [entry[name] for entry in found]
        made.add_row(row, str(len(times)), '', '', f'{np.median(times):.3g}', f'{max(times):.3g}')
    return made


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--heads', type=int, default=6)
    parser.add_argument('--first', type=int, default=1, help='seed of the first head')
    parser.add_argument('--plates', type=int, default=2, help='heads to reconstruct a plate with')
    parser.add_argument('--scale', type=float, default=0.4, help='of the pictures')
    arguments, _ = parser.parse_known_args()       # tests.bench passes the names of benches
    nominal, target = load_head(nominal_head_path()), load_target(default_target_path())
    counts = BrightFieldKinematics(nominal).motor_counts(math.radians(30))
    first = arguments.first
    found = [one_head(nominal, target, seed, arguments.scale, counts,
                      seed < first + arguments.plates)
             for seed in range(first, first + arguments.heads)]
    console = Console(width=110)
    console.print(table(found, arguments.scale))
    for seed, entry in enumerate(found, first):
        if entry['reason']:
            console.print(f'head {seed}: {entry["reason"]}')


if __name__ == '__main__':
    main()
