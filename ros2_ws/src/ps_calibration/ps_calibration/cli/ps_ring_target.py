"""ps_ring_target: drawing, printable dots and a solid of a calibration target, from its file."""
import argparse
import json
from pathlib import Path
import sys

from ps_calibration.ring_drawing import dot_sheet, drawing
from ps_calibration.ring_mesh import target_mesh, volume, write_stl
from ps_calibration.ring_target import default_target_path, load_target
from ps_head_driver.errors import PsError


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='ps_ring_target', formatter_class=argparse.RawDescriptionHelpFormatter,
        description='Check the file of a half-ring target and make what is needed to build one.',
        epilog='example: ps_ring_target --drawing ring.svg --stl ring.stl --dots dots.svg')
    parser.add_argument('target', nargs='?', type=Path, metavar='YAML',
                        help='target file (default: the half ring shipped with this package)')
    parser.add_argument('--drawing', type=Path, metavar='SVG', help='dimensioned drawing, A4')
    parser.add_argument('--stl', type=Path, metavar='STL', help='base and wall, in millimetres')
    parser.add_argument('--dots', type=Path, metavar='SVG', help='sheet of dots, to print at 1:1')
    parser.add_argument('--json', type=Path, metavar='FILE', help='machine-readable result')
    return parser


def main() -> None:
    """Run the command line."""
    arguments = _parser().parse_args()
    try:
        target = load_target(arguments.target or default_target_path())
        mesh = target_mesh(target)
        for path, make in ((arguments.drawing, drawing), (arguments.dots, dot_sheet)):
            if path:
                path.write_text(make(target), encoding='utf-8')
        if arguments.stl:
            write_stl(mesh, arguments.stl, target.name)
        if arguments.json:
            corners = mesh.reshape(-1, 3)
            arguments.json.write_text(json.dumps({
                'name': target.name, 'triangles': len(mesh), 'volume_m3': volume(mesh),
                'size_m': (corners.max(axis=0) - corners.min(axis=0)).tolist()}, indent=2) + '\n')
    except PsError as error:
        sys.exit(f'ps_ring_target: {error.code.name}: {error.message}')
    except OSError as error:
        sys.exit(f'ps_ring_target: {error.filename}: {error.strerror}')
    print(f'{target.name}: the file is valid; {volume(mesh) * 1e6:.2f} cm3')


if __name__ == '__main__':
    main()
