"""ps_cr: motor position for a convergence radius, without a graph."""
import argparse
import json
import math
from pathlib import Path
import sys

from ps_head_driver.convergence_radius import Branch, CrSolution, CrSolver
from ps_head_driver.errors import PsError
from ps_head_driver.head_model import load_head, nominal_head_path


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='ps_cr', formatter_class=argparse.RawDescriptionHelpFormatter,
        description='Convergence radius (a diameter, in metres) to motor counts, and back.',
        epilog='example: ps_cr --cr 0.06 --plot cr.png\n'
               '         ps_cr --motor-counts 20000 --head my_head.yaml --json cr.json')
    given = parser.add_mutually_exclusive_group(required=True)
    given.add_argument('--cr', type=float, metavar='METRES', help='wanted convergence radius')
    given.add_argument('--motor-counts', type=int, metavar='M', help='motor position')
    parser.add_argument('--light-height', type=float, metavar='METRES',
                        help="h at the motor's reference position (default: the head's own)")
    parser.add_argument('--branch', choices=['any', 'uncrossed', 'crossed'], default='any')
    parser.add_argument('--head', type=Path, metavar='YAML', help='head file (default: nominal)')
    parser.add_argument('--plot', type=Path, metavar='FILE', help='draw the head and CR(m)')
    parser.add_argument('--json', type=Path, metavar='FILE', help='machine-readable result')
    return parser


def as_json(solution: CrSolution) -> dict:
    """The result under the names of the documentation; null for an infinite or missing number."""
    def number(value: float) -> float | None:
        return value if math.isfinite(value) else None
    return {
        'motor_counts': solution.motor_counts, 'tilt_rad': solution.tilt,
        'cr_m': solution.convergence_radius, 'light_height_m': solution.light_height,
        'residual_m': solution.residual, 'branch': solution.branch.name,
        'dcr_dm_m_per_count': number(solution.dcr_dm),
        'reachable_m': [number(end) for end in solution.reachable],
        'center_offset_m': list(solution.center)}


def _length(metres: float) -> str:
    return f'{metres * 1e3:.2f} mm' if abs(metres) < 10 else f'{metres:.0f} m'


def _print(solution: CrSolution) -> None:
    low, high = solution.reachable
    x, y = solution.center
    print(f'motor counts   {solution.motor_counts}\n'
          f'tilt           {math.degrees(solution.tilt):.3f} deg\n'
          f'CR             {_length(solution.convergence_radius)} '
          f'({solution.branch.name.lower()}, reachable {_length(low)} to {_length(high)})\n'
          f'light height   {_length(solution.light_height)}\n'
          f'sensitivity    {solution.dcr_dm * 1e6:.3f} um per count\n'
          f'circle fit     residual {_length(solution.residual)}, centre '
          f'({_length(x)}, {_length(y)})')


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    given = _parser().parse_args(arguments)
    try:
        head = load_head(given.head or nominal_head_path())
        solver = CrSolver(head, given.light_height)
        if given.cr is not None:
            solution = solver.inverse(given.cr, Branch[given.branch.upper()])
        else:
            solution = solver.forward(given.motor_counts)
        if given.json:
            given.json.write_text(json.dumps(as_json(solution), indent=2) + '\n')
        if given.plot:
            from ps_head_driver.cli.cr_plot import plot  # slow to import
            plot(head, solver, solution, given.plot)
    except PsError as error:
        print(f'ps_cr: {error.code.name}: {error.message}', file=sys.stderr)
        return 1
    except OSError as error:
        print(f'ps_cr: {error.filename}: {error.strerror}', file=sys.stderr)
        return 1
    _print(solution)
    return 0


if __name__ == '__main__':
    sys.exit(main())
