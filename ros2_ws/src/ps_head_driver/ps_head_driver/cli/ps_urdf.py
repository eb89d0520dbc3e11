"""ps_urdf: URDF or xacro of a head, from its head file."""
import argparse
import json
from pathlib import Path
import sys

from ps_head_driver.calibration_file import apply, read_calibration
from ps_head_driver.errors import PsError
from ps_head_driver.head_frames import static_transforms
from ps_head_driver.head_model import load_head, nominal_head_path
from ps_head_driver.urdf import head_urdf, head_xacro


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='ps_urdf', formatter_class=argparse.RawDescriptionHelpFormatter,
        description='Robot description of a head. A name that ends in .xacro gets a macro to '
                    'include in the description of a cell, any other plain URDF.',
        epilog='example: ps_urdf --head my_head.yaml --out my_head.urdf\n'
               '         ps_urdf --head my_head.yaml --out my_head.urdf.xacro')
    parser.add_argument('--head', type=Path, metavar='YAML', help='head file (default: nominal)')
    parser.add_argument('--calibration', type=Path, metavar='YAML',
                        help='calibration file: frames and panels as calibrated')
    parser.add_argument('--out', type=Path, metavar='FILE',
                        help='URDF or, by its suffix, xacro (default: standard output)')
    parser.add_argument('--drawing', type=Path, metavar='FILE',
                        help='side view with the frames (.svg, .png, .pdf)')
    parser.add_argument('--json', type=Path, metavar='FILE',
                        help='the static transforms, machine-readable')
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    given = _parser().parse_args(arguments)
    head_file = given.head or nominal_head_path()
    try:
        head = load_head(head_file)
        source = head_file.name
        if given.calibration:
            head = apply(head, read_calibration(given.calibration))
            source += f' and {given.calibration.name}'
        is_xacro = given.out is not None and given.out.suffix == '.xacro'
        text = (head_xacro if is_xacro else head_urdf)(head, source)
        if given.out:
            given.out.write_text(text, encoding='utf-8')
        elif not (given.json or given.drawing):
            sys.stdout.write(text)
        if given.drawing:
            from ps_head_driver.cli.frames_drawing import draw  # slow to import
            draw(head, given.drawing)
        if given.json:
            given.json.write_text(json.dumps({'transforms': [
                {'parent': each.parent, 'child': each.child, 'xyz_m': each.xyz,
                 'rpy_rad': each.rpy, 'quaternion_xyzw': each.quaternion()}
                for each in static_transforms(head)]}, indent=2) + '\n')
    except PsError as error:
        print(f'ps_urdf: {error.code.name}: {error.message}', file=sys.stderr)
        return 1
    except OSError as error:
        print(f'ps_urdf: {error.filename}: {error.strerror}', file=sys.stderr)
        return 1
    return 0


if __name__ == '__main__':
    sys.exit(main())
