"""Ring calibration: the verdict on wrong pictures, and on the pictures of good heads.

Run with: python -m tests.bench calibration_verdicts, or for more heads
python tests/bench/bench_calibration_verdicts.py --heads 50
"""
import argparse
import math
from pathlib import Path
import shutil
import tempfile

from rich.console import Console
from rich.table import Table

from ps_calibration.calibrate import Calibration, calibrate
from ps_calibration.cli.ps_calibrate import calibrate_folders
from ps_calibration.ring_target import RingTarget, default_target_path, load_target
from ps_calibration.synthetic import random_bench, render_stack, solid_of
from ps_calibration.synthetic_faults import FAULTS, Rendered
from ps_head_driver.head_model import HeadModel, load_head, nominal_head_path
from ps_head_driver.kinematics import BrightFieldKinematics
from ps_head_driver.stack_folder_writer import write_stack

_GOOD = 3                # seed of the head that the faults happen to


def _damaged(rendered: Rendered) -> list[tuple[str, tuple[str, ...], Calibration]]:
    """Folders that cannot be used, through the command's own reading."""
    found = []

    def spoil(name: str, words: tuple[str, ...], change) -> None:  # type: ignore[no-untyped-def]
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place) / 'pictures'
            write_stack(rendered.good, folder)
            change(folder)
            found.append((name, words, calibrate_folders(
                [folder], rendered.target, rendered.nominal)[1]))

    def truncate(folder: Path) -> None:
        file = folder / '002.png'
        file.write_bytes(file.read_bytes()[:2000])

    def resize(folder: Path) -> None:
        import cv2
        file = str(folder / '002.png')
        cv2.imwrite(file, cv2.imread(file, cv2.IMREAD_UNCHANGED)[:-8])

    def forget(folder: Path) -> None:
        lights = (folder / 'lights.yaml').read_text().replace('panel: ALL', 'panel: NONE')
        (folder / 'lights.yaml').write_text(lights)

    spoil('file truncated', ('002.png',), truncate)
    spoil('pictures of different sizes', ('002.png', 'size'), resize)
    spoil('file missing', ('002.png',), lambda folder: (folder / '002.png').unlink())
    spoil('frame ALL missing', ('ALL is missing',), forget)
    spoil('no folder', ('pictures',), shutil.rmtree)
    return found


def faults(nominal: HeadModel, target: RingTarget, scale: float, counts: int) -> Table:
    """The verdict on everything that is wrong."""
    bench = random_bench(nominal, _GOOD)
    good = render_stack(bench, nominal, solid_of(target), counts, scale, _GOOD)
    rendered = Rendered(bench, nominal, target, good, scale)
    results = [(fault.name, fault.words, calibrate([fault.make(rendered)], target, nominal))
               for fault in FAULTS]
    results += _damaged(rendered)
    passed = sum(result.verdict == 'OK' for _, _, result in results)
    right = sum(_named(words, result) for _, words, result in results)
    table = Table(title=f'{len(results)} wrong inputs: {passed} passed as OK, '
                        f'{right} named rightly')
    for title in ('pictures', 'verdict', 'named', 'reason'):
        table.add_column(title)
    for name, words, result in results:
        table.add_row(name, result.verdict, 'yes' if _named(words, result) else 'NO',
                      result.reason)
    return table


def _named(words: tuple[str, ...], result: Calibration) -> bool:
    return result.verdict != 'OK' and any(word in result.reason for word in words)


def good_heads(nominal: HeadModel, target: RingTarget, scale: float, counts: int,
               heads: int) -> Table:
    """The verdict on heads within their tolerances."""
    tally: dict[str, list[str]] = {'OK': [], 'POOR': [], 'FAILED': []}
    for seed in range(1, heads + 1):
        bench = random_bench(nominal, seed)
        result = calibrate([render_stack(bench, nominal, solid_of(target), counts, scale, seed)],
                           target, nominal)
        tally[result.verdict].append(f'{seed}: {result.reason}'.rstrip(': '))
    alarms = heads - len(tally['OK'])
    table = Table(title=f'{heads} good heads: {alarms} false alarms')
    for title in ('verdict', 'heads', 'reasons'):
        table.add_column(title)
    for verdict, reasons in tally.items():
        table.add_row(verdict, str(len(reasons)),
                      '' if verdict == 'OK' else '; '.join(reasons))
    return table


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--heads', type=int, default=10)
    parser.add_argument('--scale', type=float, default=0.4, help='of the pictures')
    arguments, _ = parser.parse_known_args()
    nominal, target = load_head(nominal_head_path()), load_target(default_target_path())
    counts = BrightFieldKinematics(nominal).motor_counts(math.radians(30))
    console = Console()
    console.print(faults(nominal, target, arguments.scale, counts))
    if arguments.heads:
        console.print(good_heads(nominal, target, arguments.scale, counts, arguments.heads))


if __name__ == '__main__':
    main()
