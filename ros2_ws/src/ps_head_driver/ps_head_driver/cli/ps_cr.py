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


def main() -> None:
    """Run the command line."""
    arguments = _parser().parse_args()
    try:
        head = load_head(arguments.head or nominal_head_path())
        solver = CrSolver(head, arguments.light_height)
        if arguments.cr is not None:
            solution = solver.inverse(arguments.cr, Branch[arguments.branch.upper()])
        else:
            solution = solver.forward(arguments.motor_counts)
        if arguments.json:
            arguments.json.write_text(json.dumps(as_json(solution), indent=2) + '\n')
        if arguments.plot:
            from ps_head_driver.cli.cr_plot import plot
            plot(head, solver, solution, arguments.plot)
    except PsError as error:
        sys.exit(f'ps_cr: {error.code.name}: {error.message}')
    except OSError as error:
        sys.exit(f'ps_cr: {error.filename}: {error.strerror}')
    low, high = solution.reachable
    print(f'motor counts   {solution.motor_counts}\n'
          f'tilt           {math.degrees(solution.tilt):.3f} deg\n'
          f'CR             {solution.convergence_radius * 1e3:.3f} mm '
          f'({solution.branch.name.lower()}, reachable {low * 1e3:.2f} to {high * 1e3:.2f} mm)\n'
          f'light height   {solution.light_height * 1e3:.3f} mm\n'
          f'sensitivity    {solution.dcr_dm * 1e6:.3f} um per count\n'
          f'circle fit     residual {solution.residual * 1e6:.3f} um, centre '
          f'({solution.center[0] * 1e3:.3f}, {solution.center[1] * 1e3:.3f}) mm')


if __name__ == '__main__':
    main()
