"""ps_reconstruct: pictures or a recorded session in, surface files out. Same code as the node."""
import argparse
from collections.abc import Iterator
import dataclasses
import json
from pathlib import Path
import sys
import time
from typing import Any

import numpy as np
from rich.console import Console

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.stack import Stack, Truth, angular_error_deg
from ps_head_driver.stack_folder import read_stack
from ps_reconstruction.pipeline import METHODS, OUTPUTS, Options, reconstruct
from ps_reconstruction.result_files import write_result
from ps_reconstruction.session_reader import Scan, Session, is_session


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    options = _parser().parse_args(arguments)
    console = Console(highlight=False, markup=False)
    try:
        reports = [_process(stack, truth, folder, options, console)
                   for stack, truth, folder in _inputs(options)]
        if options.json:
            _write_json(options.json, reports)
    except PsError as error:
        print(f'ps_reconstruct: {error.message}', file=sys.stderr)
        return 1
    except OSError as error:
        print(f'ps_reconstruct: {error}', file=sys.stderr)
        return 1
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='ps_reconstruct', formatter_class=argparse.RawDescriptionHelpFormatter,
        description='Reconstruct normals, slopes, albedo, height and shape from pictures.',
        epilog='example:\n  ps_reconstruct metal_disc --flat metal_disc --out result\n'
               '  ps_reconstruct ballPNG --lights four --out ball --json ball.json')
    parser.add_argument('input', type=Path, metavar='INPUT',
                        help='stack folder, four-direction picture folder or recorded session')
    parser.add_argument('--out', type=Path, required=True, metavar='DIR',
                        help='folder for the results')
    parser.add_argument('--method', choices=METHODS, default='ls', help='solver (default: ls)')
    parser.add_argument('--lights', default='all', metavar='SET',
                        help='all, four, ten (subsets.json) or 1-based indices such as 1,5,9')
    parser.add_argument('--flat', type=Path, metavar='DIR',
                        help='pictures of a flat matt board under the same lights')
    parser.add_argument('--slant', type=float, default=45.0, metavar='DEG',
                        help='slant of lights of unknown geometry (default: 45)')
    parser.add_argument('--near-field', action=argparse.BooleanOptionalAction, default=True,
                        help='light vectors per pixel (default: yes)')
    parser.add_argument('--bits', type=int, default=0, metavar='N',
                        help='bits that count of a pixel in 16, for 10, 12 or 14-bit cameras')
    parser.add_argument('--careful', action='store_true',
                        help='integrate with confidence weights and height steps')
    parser.add_argument('--pixel-pitch', type=float, default=0.0, metavar='M',
                        help='pixel distance, m, for pictures without camera data')
    parser.add_argument('--json', type=Path, metavar='FILE', help='write the figures as JSON')
    return parser


def _inputs(options: argparse.Namespace) -> Iterator[tuple[Stack, Truth | None, Path]]:
    """Stacks with their truth and output folder."""
    if not options.input.exists():
        raise PsError(ErrorCode.RECONSTRUCTION_BAD_STACK, f'{options.input}: no such file')
    if not 1 <= options.slant <= 85:
        raise PsError(ErrorCode.RECONSTRUCTION_BAD_PARAMETER,
                      f'--slant: {options.slant:g} is outside 1 to 85 degrees')
    if not is_session(options.input):
        stack, truth = read_stack(options.input, lights=options.lights, flat=options.flat,
                                  slant=float(np.radians(options.slant)))
        yield stack, truth, options.out
        return
    if options.lights != 'all' or options.flat is not None:
        raise PsError(ErrorCode.RECONSTRUCTION_BAD_PARAMETER,
                      '--lights and --flat are for picture folders; a recorded stack carries both')
    yield from _recorded(options)


def _recorded(options: argparse.Namespace) -> Iterator[tuple[Stack, Truth | None, Path]]:
    """Stacks of a session; what a crash cut off is left out."""
    # needs ROS, which picture folders do not
    from ps_head_driver.conversions import message_to_stack
    scan, number = Scan(), -1
    for number, message in enumerate(Session(options.input).stacks(scan)):
        yield message_to_stack(message), None, options.out / f'{number:06d}'
    for problem in scan.problems:
        print(f'ps_reconstruct: {options.input}: {problem}', file=sys.stderr)
    if number < 0:
        raise PsError(ErrorCode.SESSION_NOT_A_SESSION, f'{options.input}: holds no stack')


def _process(stack: Stack, truth: Truth | None, out: Path, options: argparse.Namespace,
             console: Console) -> dict[str, Any]:
    """Reconstruct one stack, write its files, print and return its figures."""
    result = reconstruct(stack, Options(
        method=options.method, near_field=options.near_field, careful=options.careful,
        bits=options.bits, pixel_pitch=options.pixel_pitch), set(OUTPUTS))
    start = time.perf_counter()
    write_result(result, out)
    result.timings['write'] = time.perf_counter() - start
    error = None
    if truth is not None:
        degrees = angular_error_deg(result.normal, truth.normal)
        if stack.mask is not None:
            degrees = degrees[stack.mask]
        degrees = degrees[np.isfinite(degrees)]
        if degrees.size:
            error = {'mean': float(degrees.mean()), 'median': float(np.median(degrees)),
                     'p90': float(np.percentile(degrees, 90))}
    report = {
        'method': result.method, 'lights': len(stack.equations().images), 'error_deg': error,
        'valid_fraction': result.valid_fraction, 'timings_s': result.timings,
        'near_field': result.near_field, 'residual_rms': _number(result.residual_rms),
        'metric': result.metric, 'pixel_pitch': result.pixel_pitch,
        'roughness': {name: _number(value) for name, value
                      in dataclasses.asdict(result.roughness).items()},
        'out': str(out)}
    console.print(f'{out}: {result.method}, {report["lights"]} lights, '
                  f'{result.valid_fraction:.1%} valid, '
                  f'{sum(result.timings.values()):.2f} s')
    if error:
        console.print('angular error: mean {mean:.3f}, median {median:.3f}, p90 {p90:.3f} deg'
                      .format(**error))
    return report


def _number(value: float) -> float | None:
    """JSON knows no NaN."""
    return float(value) if np.isfinite(value) else None


def _write_json(path: Path, reports: list[dict[str, Any]]) -> None:
    content = reports[0] if len(reports) == 1 else {'stacks': reports}
    path.write_text(json.dumps(content, indent=2) + '\n', encoding='utf-8')


if __name__ == '__main__':
    sys.exit(main())
