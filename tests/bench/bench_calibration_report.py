"""Ring calibration: a full report of a rendered head, and its figures before and after.

Run with: python -m tests.bench calibration_report; the report is build/calibration/report.html.
It renders the ring (some pictures repeated) and three parts under a head that is not as designed,
and gives the folders to ps_calibrate.
"""
import argparse
import json
import math
from pathlib import Path
import shutil
import subprocess
import sys

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from ps_calibration.ring_target import RingTarget, default_target_path, load_target
from ps_calibration.synthetic import Bench, random_bench, render_stack, solid_of
from ps_head_driver.fake.renderer import OFF, Sensor, make_renderer
from ps_head_driver.fake.ring_renderer import placement
from ps_head_driver.head_model import HeadModel, load_head, nominal_head_path
from ps_head_driver.kinematics import BrightFieldKinematics, lights_at
from ps_head_driver.stack import Light, Panel, Stack
from ps_head_driver.stack_folder_writer import write_stack

PARTS = {'matt boss, 1 mm': 'boss', 'glossy plate': 'glossy_plate',
         'laminated copper': 'copper'}
_EDGE = 2e-4             # m below the plane: beside the part
_MARGIN_PX = 12          # at full size, from a part's edge


def picture_ring(bench: Bench, nominal: HeadModel, target: RingTarget, scale: float,
                 repeats: int, folder: Path) -> list[Path]:
    """Stacks of the ring at two motor positions, the second one repeated."""
    kinematics, folders = BrightFieldKinematics(nominal), []
    for degrees, count in ((24, 1), (30, repeats)):
        for k in range(count):
            counts = kinematics.motor_counts(math.radians(degrees))
            stack = render_stack(bench, nominal, solid_of(target), counts, scale,
                                 100 * degrees + k)
            folders.append(folder / f'ring at {degrees} degrees, {k + 1}')
            write_stack(stack, folders[-1])
    return folders


def picture_part(scene: str, bench: Bench, nominal: HeadModel, scale: float,
                 folder: Path) -> None:
    """Stack of a part with its truth; what lies beside the part is masked."""
    kinematics = BrightFieldKinematics(nominal)
    counts = kinematics.motor_counts(math.radians(30))
    renderer = make_renderer(scene, bench.head, Sensor(ambient=0.02, vignetting=0.1), scale, 5)
    tilt = float(kinematics.tilt(counts))
    images = [renderer.render(tilt, 1.2, list(levels), OFF, frame=i)
              for i, levels in enumerate((*np.eye(4), np.zeros(4)))]
    truth = renderer.truth()
    assert truth.height is not None
    part = cv2.erode((truth.height > -_EDGE).astype(np.uint8),
                     np.ones((2 * round(_MARGIN_PX * scale) + 1,) * 2)).astype(bool)
    lights = [*lights_at(nominal, counts, 1.2)[:4],
              Light(panel=Panel.NONE, motor_counts=counts, name='NONE')]
    write_stack(Stack(images=images, lights=lights, camera=renderer.camera,
                      mask=None if part.all() else part), folder, truth)


def _table(result: dict) -> Table:
    table = Table(title=f'{result["verdict"]} {result["reason"]}; z scale '
                        f'{result["z_scale"]:.4f}, condition {result["condition"]:.0f}')
    for title in ('', 'before', 'after', 'before, STV', 'after, STV'):
        table.add_column(title)
    for part in result['checks']:
        for key, name, factor, unit in (
                ('lean_deg', 'mean normal off', 1, ' deg'),
                ('bias_deg', 'normals off, mean', 1, ' deg'),
                ('height_scale', 'height scale', 100, ' %'),
                ('bow_m', 'height off, RMS', 1e6, ' um')):
            values = [part[when][method][key] for method in ('ls', 'stv')
                      for when in ('before', 'after')]
            if None not in values:
                table.add_row(f'{part["part"]}: {name}',
                              *(f'{factor * value:.3f}{unit}' for value in values))
    for group in result['repeatability']:
        table.add_row(f'repeatability of the light direction over {group["count"]}, deg', '',
                      f'{max(group["direction_deg"]):.4f}')
    return table


def main() -> None:
    """Render, calibrate and print the figures of the report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--out', type=Path, default=Path('build/calibration'))
    parser.add_argument('--scale', type=float, default=0.5, help='of the pictures')
    parser.add_argument('--seed', type=int, default=3, help='of the head')
    parser.add_argument('--repeats', type=int, default=3)
    arguments, _ = parser.parse_known_args()
    nominal, target = load_head(nominal_head_path()), load_target(default_target_path())
    # ring and parts lie on the same plane, as on a fixture
    bench = Bench(random_bench(nominal, arguments.seed).head,
                  placement(0.0012, -0.0008, 0.0, 0.04))
    pictures = arguments.out / 'pictures'
    shutil.rmtree(pictures, ignore_errors=True)
    ring = picture_ring(bench, nominal, target, arguments.scale, arguments.repeats, pictures)
    checks: list[str] = []
    for name, scene in PARTS.items():
        picture_part(scene, bench, nominal, arguments.scale, pictures / name)
        checks += ['--check', str(pictures / name)]
    report, figures = arguments.out / 'report.html', arguments.out / 'result.json'
    subprocess.run([sys.executable, '-m', 'ps_calibration.cli.ps_calibrate', *map(str, ring),
                    *checks, '--serial', 'PS-0042', '--out',
                    str(arguments.out / 'calibration.yaml'),
                    '--report', str(report), '--json', str(figures)], check=True)
    Console().print(_table(json.loads(figures.read_text())))
    print(f'report: {report}')


if __name__ == '__main__':
    main()
