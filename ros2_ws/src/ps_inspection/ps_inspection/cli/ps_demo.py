"""ps_demo: one part through the whole cell, with a report."""
import argparse
import json
from pathlib import Path
import shutil
import sys

from rich.console import Console
from rich.table import Table

from ps_head_driver.errors import PsError
from ps_inspection.demo import DemoOptions, DemoResult, run


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='ps_demo', formatter_class=argparse.RawDescriptionHelpFormatter,
        description='Start a cell with fake hardware, inspect one part, write a report.',
        epilog='example: ps_demo --out build/demo\n'
               '         ps_demo --input pictures/ --out build/mine')
    parser.add_argument('--out', type=Path, default=Path('build/demo'), help='folder to write')
    parser.add_argument('--input', type=Path, metavar='FOLDER',
                        help='real pictures instead of a rendered part: a stack folder, or four '
                             'pictures ending in 000, 090, 180, 270 with optional flat_*')
    parser.add_argument('--scene', default='disc', help='rendered part (default: disc)')
    parser.add_argument('--cr', type=float, default=0.060, metavar='METRES',
                        help='convergence radius to set (default: 0.060)')
    parser.add_argument('--json', type=Path, metavar='FILE', help='machine-readable results')
    return parser


def main() -> None:
    """Run the command line."""
    arguments = _parser().parse_args()
    console = Console(highlight=False)
    out: Path = arguments.out
    if (out / 'report.html').is_file():
        shutil.rmtree(out)       # an earlier demo; anything else is left alone
    try:
        result = run(DemoOptions(out=out, scene=arguments.scene, input_folder=arguments.input,
                                 convergence_radius=arguments.cr),
                     progress=lambda line: console.print(f'[dim]·[/] {line}'))
    except PsError as error:
        sys.exit(f'ps_demo: {error.code.name}: {error.message} (logs: {out / "logs"})')
    except KeyboardInterrupt:
        sys.exit(130)
    if arguments.json:
        arguments.json.write_text(json.dumps(vars(result), indent=2))
    _print(console, result)
    if result.wrong:
        sys.exit('ps_demo: ' + '; '.join(result.wrong))


def _print(console: Console, result: DemoResult) -> None:
    table = Table(box=None, show_header=False, pad_edge=False)
    for name, seconds in result.timings_s.items():
        table.add_row(name, f'{seconds * 1e3:9.1f} ms')
    for title, values, factor, unit in (
            ('normal error', result.error_deg, 1.0, 'deg'),
            ('height error', result.height_error_m, 1e6, 'µm ')):
        for name, value in (values or {}).items():
            table.add_row(f'{title}, {name}', f'{value * factor:9.2f} {unit}')
    table.add_row('valid pixels', f'{result.valid_fraction * 100:9.1f} %')
    console.print(table)
    console.print(f'report: [bold]{result.files["report"]}[/]')


if __name__ == '__main__':
    main()
