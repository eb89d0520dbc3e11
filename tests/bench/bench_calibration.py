"""Ring calibration over random heads, against what the project wants of it.

Run with: python -m tests.bench calibration, or all heads in parts that add up in a file:
python tests/bench/bench_calibration.py --heads 50 --scale 1 --results heads.jsonl
"""
import argparse
from collections.abc import Callable
import json
import math
from pathlib import Path
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from ps_calibration.before_after import outcome, relit
from ps_calibration.calibrate import calibrate, head_calibration
from ps_calibration.ring_fit import corrected
from ps_calibration.ring_target import RingTarget, default_target_path, load_target
from ps_calibration.synthetic import (
    Bench,
    errors_of,
    random_bench,
    render_part,
    render_stack,
    solid_of,
)
from ps_head_driver.head_model import HeadModel, load_head, nominal_head_path
from ps_head_driver.kinematics import BrightFieldKinematics
from ps_head_driver.stack import Plane, Truth

# name in the results, row of the table, unit, what is wanted
_ROWS = (('direction', 'light direction', 'deg', 'median 0.05, worst 0.15'),
         ('intensity', 'relative intensity', '%', '0.3'),
         ('level', 'plane level', 'deg', '0.03'),
         ('plate', 'flat plate, normal bias', 'deg', '0.15'),
         ('boss', 'height of the 1 mm boss', '%', '0.5'),
         ('z_scale', 'z scale', '%', ''),
         ('seconds', 'time', 's', '10'))


def one_head(nominal: HeadModel, target: RingTarget, seed: int, scale: float, counts: int,
             with_parts: bool) -> dict[str, Any]:
    """Errors of one head before and after, as numbers by the names of the table's rows."""
    bench = random_bench(nominal, seed)
    tilt = float(BrightFieldKinematics(nominal).tilt(counts))
    stack = render_stack(bench, nominal, solid_of(target), counts, scale, seed)
    start = time.perf_counter()
    result = calibrate([stack], target, nominal)
    found: dict[str, Any] = {'seed': seed, 'scale': scale, 'verdict': result.verdict,
                             'reason': result.reason, 'seconds': time.perf_counter() - start}
    if result.fit is None:
        return found
    after = errors_of(corrected(nominal, result.fit.panels), result.fit.pose.plane, bench, tilt)
    before = errors_of(nominal, Plane(), bench, tilt)
    for name, errors in (('before', before), ('after', after)):
        found[name] = {'direction': float(errors.direction_deg.max()),
                       'intensity': 100 * float(abs(errors.intensity).max()),
                       'level': errors.level_deg}
    found['after']['z_scale'] = 100 * abs(result.z_scale - 1)
    if with_parts:
        calibration = head_calibration(result, nominal, target)
        blank = render_stack(bench, nominal, solid_of(target, height=0.0,
                                                      dots=np.empty((0, 2))), counts, scale, seed)
        normal = bench.where.rotation[:, 2].astype(np.float32)
        flat = Truth(normal=np.broadcast_to(normal, (*blank.shape, 3)).copy())
        boss, truth = render_part(bench, nominal, 'boss', counts, scale, seed)
        # the boss lies on the nominal plane
        level = calibration.model_copy(update={'plane_normal': (0, 0, 1), 'plane_offset': 0})
        for name, plate, lights in (('before', None, None), ('after', calibration, level)):
            found[name]['plate'] = outcome(relit(blank, nominal, plate), flat).bias_deg
            found[name]['boss'] = 100 * abs(
                outcome(relit(boss, nominal, lights), truth).height_scale - 1)
    return found


def results(path: Path | None, seeds: range, scale: float,
            measure: Callable[[int], dict[str, Any]]) -> list[dict[str, Any]]:
    """Results of all heads; those that a file already holds are not measured again."""
    known = {}
    if path and path.is_file():
        known = {(entry['seed'], entry['scale']): entry
                 for entry in map(json.loads, path.read_text().splitlines())}
    for seed in seeds:
        if (seed, scale) not in known:
            known[seed, scale] = measure(seed)
            if path:
                with path.open('a') as file:
                    file.write(json.dumps(known[seed, scale]) + '\n')
    return [known[seed, scale] for seed in seeds]


def table(found: list[dict[str, Any]], scale: float) -> Table:
    """One row per target of the project."""
    verdicts = [entry['verdict'] for entry in found]
    made = Table(title=f'{len(found)} heads at scale {scale:g}: '
                       + ', '.join(f'{verdicts.count(v)} {v}' for v in sorted(set(verdicts))))
    for column in ('', 'heads', 'before, worst', 'median', '95 %', 'worst', 'wanted'):
        made.add_column(column, justify='left' if column in ('', 'wanted') else 'right')
    for name, row, unit, wanted in _ROWS:
        first, last = ([value for entry in found if 'after' in entry for value in [
            entry['seconds'] if name == 'seconds' else entry[when].get(name)]
            if value is not None] for when in ('before', 'after'))
        if last:
            was = f'{max(first):.3g}' if first and name != 'seconds' else ''
            made.add_row(f'{row}, {unit}', str(len(last)), was, *(
                f'{np.quantile(last, part):.3g}' for part in (0.5, 0.95, 1)), wanted)
    return made


def repeatability(nominal: HeadModel, target: RingTarget, repeats: int, scale: float,
                  counts: int) -> str:
    """Scatter of the light directions over pictures that differ by their noise."""
    bench, tilt = random_bench(nominal, 3), float(BrightFieldKinematics(nominal).tilt(counts))
    directions: list[NDArray] = []
    for seed in range(repeats):
        stack = render_stack(bench, nominal, solid_of(target), counts, scale, 100 + seed)
        fit = calibrate([stack], target, nominal).fit
        if fit is not None:
            directions.append(light_vectors_of(corrected(nominal, fit.panels), bench, tilt))
    spread = np.std(directions, axis=0, ddof=1)              # (4, 3)
    worst = math.degrees(np.linalg.norm(spread, axis=1).max())
    return f'light directions repeat over {len(directions)} to {worst:.4f} deg, wanted 0.01'


def light_vectors_of(head: HeadModel, bench: Bench, tilt: float) -> NDArray:
    """Unit vectors towards the lights at the middle of the true plane, (4, 3)."""
    from ps_calibration.target_pose import TargetPose
    from ps_calibration.uncertainty import light_directions
    turn = bench.where.rotation
    flat = np.array([*bench.where.position, 0, math.asin(-turn[1, 2]), math.asin(turn[0, 2])])
    return light_directions(head, TargetPose(flat), bench.head.camera, tilt)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--heads', type=int, default=5)
    parser.add_argument('--first', type=int, default=1, help='seed of the first head')
    parser.add_argument('--parts', type=int, default=2, help='heads to reconstruct parts with')
    parser.add_argument('--repeats', type=int, default=0, help='of noise, on one head; 10 is '
                        'what the project asks for')
    parser.add_argument('--scale', type=float, default=0.5, help='of the pictures')
    parser.add_argument('--tilt-deg', type=float, default=30.0)
    parser.add_argument('--results', type=Path, metavar='JSONL',
                        help='file of results: heads in it are not done again')
    arguments, _ = parser.parse_known_args()       # tests.bench passes the names of benches
    nominal, target = load_head(nominal_head_path()), load_target(default_target_path())
    counts = BrightFieldKinematics(nominal).motor_counts(math.radians(arguments.tilt_deg))
    scale, first = arguments.scale, arguments.first
    found = results(
        arguments.results, range(first, first + arguments.heads), scale,
        lambda seed: one_head(nominal, target, seed, scale, counts,
                              seed < first + arguments.parts))
    console = Console(width=110)
    console.print(table(found, scale))
    if arguments.repeats:
        console.print(repeatability(nominal, target, arguments.repeats, scale, counts))


if __name__ == '__main__':
    main()
