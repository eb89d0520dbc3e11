"""ps_calibrate: ring calibration from folders of pictures, without a graph."""
import argparse
from dataclasses import replace
import json
import math
from pathlib import Path
import sys

import numpy as np

from ps_calibration.before_after import Outcome, compare
from ps_calibration.calibrate import Calibration, calibrate
from ps_calibration.catalogue import list_calibrations
from ps_calibration.dark_field import PARAMETERS as DARK_PARAMETERS
from ps_calibration.report import Evidence, gather, report, write_report
from ps_calibration.ring_target import RingTarget, default_target_path, load_target
from ps_calibration.uncertainty import dark_figures, light_figures
from ps_head_driver.calibration_file import write_calibration
from ps_head_driver.errors import PsError
from ps_head_driver.head_model import DIRECTIONS, HeadModel, load_head, nominal_head_path
from ps_head_driver.stack import Stack
from ps_head_driver.stack_folder import read_lights, read_stack


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='ps_calibrate', formatter_class=argparse.RawDescriptionHelpFormatter,
        description='Calibrate the panels of a head from pictures of the half-ring target. '
                    'Each folder is a stack folder at one motor position with the frames E, N, '
                    'W, S, ALL and NONE; frames of mode DARK_FIELD in one of them '
                    'calibrate the dark-field panels, too.',
        epilog='example: ps_calibrate pictures/m25000 pictures/m30000 --out calibration.yaml '
               '--report report.html')
    parser.add_argument('folders', nargs='*', type=Path, metavar='FOLDER')
    parser.add_argument('--target', type=Path, metavar='YAML', help='target file (default: the '
                        'half ring shipped with this package)')
    parser.add_argument('--head', type=Path, metavar='YAML', help='head file (default: nominal)')
    parser.add_argument('--out', type=Path, metavar='YAML', help='calibration file to write')
    parser.add_argument('--report', type=Path, metavar='HTML', help='report to write, also of a '
                        'calibration that failed')
    parser.add_argument('--check', type=Path, action='append', default=[], metavar='FOLDER',
                        help='pictures of a part, to be reconstructed before and after the '
                             'calibration for the report; can be given several times')
    parser.add_argument('--list', type=Path, metavar='FOLDER', help='only list the calibration '
                        'files of a folder, and why some are refused')
    parser.add_argument('--serial', default='', help='serial number of the head, for the file')
    parser.add_argument('--json', type=Path, metavar='FILE', help='machine-readable result')
    return parser


def _numbers(values: dict[str, float]) -> dict[str, float | None]:
    """Without NaN, which JSON does not know."""
    return {key: value if math.isfinite(value) else None for key, value in values.items()}


def _figures(outcome: Outcome) -> dict[str, float | None]:
    return _numbers({'bow_m': outcome.bow, 'lean_deg': outcome.lean_deg,
                     'bias_deg': outcome.bias_deg, 'worst_deg': outcome.worst_deg,
                     'height_scale': outcome.height_scale})


def as_json(evidence: Evidence, folders: list[Path]) -> dict:
    """The result under the names of the documentation; null for what a failure left unknown."""
    result, head, motor = evidence.result, evidence.head, evidence.motor
    fit, homography = result.fit, result.camera_to_plane()
    listed = []
    for k, panels in enumerate(result.panels(head)):
        assert fit is not None
        mean = float(np.mean([panel.intensity for panel in panels]))
        known = light_figures(fit, head, result.camera, k)
        listed.append({'folder': str(folders[k]), 'lights': [
            {'panel': name, 'position': panel.center.tolist(), 'axis': panel.axis.tolist(),
             'intensity': panel.intensity / mean,
             'direction_deviation_deg': math.degrees(known.direction_deviation[i]),
             'intensity_deviation': float(known.intensity_deviation[i]),
             'shadow_residual_px': float(fit.edge_px[k][i])}
            for i, (name, panel) in enumerate(zip(DIRECTIONS, panels, strict=True))]})
    return {
        'verdict': result.verdict, 'reason': result.reason, 'folders': listed,
        'plane': fit and {'normal': list(fit.pose.plane.normal),
                          'offset': fit.pose.plane.offset},
        'z_scale': result.z_scale if fit else None,
        'z_scale_deviation': result.z_scale_deviation if fit else None,
        'camera_to_plane': None if homography is None else homography.tolist(),
        'dark_field': dark_field_as_json(evidence, folders),
        'condition': fit and fit.condition, 'motor': motor and _numbers(vars(motor)),
        'repeatability': [
            {'count': group.count, 'direction_deg': np.degrees(group.direction).tolist(),
             'intensity': group.intensity.tolist(), 'level_deg': math.degrees(group.level),
             'z_scale': group.z_scale} for group in evidence.repeated],
        'checks': [
            {'part': part.name, **{when: {method: _figures(outcome)
                                          for method, outcome in outcomes.items()}
                                   for when, outcomes in (('before', part.before),
                                                          ('after', part.after))}}
            for part in evidence.parts],
        'timings_s': result.timings_s}


def dark_field_as_json(evidence: Evidence, folders: list[Path]) -> dict:
    """The dark-field panels: what was found and how; ``lights`` is empty without pictures."""
    dark, head, fit = evidence.result.dark, evidence.head, evidence.result.fit
    lights = []
    if fit is not None and dark.panels:
        figures = dark_figures(dark, fit.pose, head, evidence.result.camera)
        for name, pose, panel, light in zip(DIRECTIONS, dark.poses(head), dark.panels, figures,
                                            strict=True):
            parameters = {
                key: {'correction': float(value), 'deviation': float(deviation),
                      'known': bool(seen)}
                for key, value, deviation, seen in zip(
                    DARK_PARAMETERS, panel.correction, panel.deviation, panel.seen, strict=True)}
            lights.append({
                'panel': name, 'verdict': panel.verdict, 'reason': panel.reason,
                'source': panel.source, 'position': pose.center.tolist(),
                'axis': pose.axis.tolist(), **_numbers({
                    'intensity': pose.intensity,
                    'direction_deviation_deg': math.degrees(light.direction_deviation),
                    'shadow_residual_px': panel.edge_px}),
                'parameters': parameters if panel.calibrated else None})
    return {'verdict': dark.verdict, 'reason': dark.reason,
            'folder': str(folders[dark.position]) if lights else None,
            'tilt_rad': dark.tilt if lights else None, 'lights': lights}


def _print(evidence: Evidence) -> None:
    result, motor = evidence.result, evidence.motor
    print(f'{result.verdict} {result.reason}'.strip())
    for panels in result.panels(evidence.head):
        for name, panel in zip(DIRECTIONS, panels, strict=True):
            x, y, z = panel.center * 1e3
            print(f'panel {name}  at ({x:.2f}, {y:.2f}, {z:.2f}) mm')
    print(f'dark field  {result.dark.verdict} {result.dark.reason}'.strip())
    for name, pose, found in zip(DIRECTIONS, result.dark.poses(evidence.head), result.dark.panels,
                                 strict=False):
        x, y, z = pose.center * 1e3
        print(f'panel DF_{name}  at ({x:.2f}, {y:.2f}, {z:.2f}) mm, from {found.source}')
    print(f'z scale  {result.z_scale:.4f} ± {result.z_scale_deviation:.4f}')
    if motor:
        print(f'motor    offset {motor.offset_counts:.0f} counts, scale {motor.scale:.5f}, '
              f'backlash {motor.backlash_counts:.0f} counts, '
              f'repeats to {motor.repeatability_counts:.0f} counts')
    for group in evidence.repeated:
        print(f'repeats  {group.count}: light directions to '
              f'{math.degrees(group.direction.max()):.4f} degrees')
    for part in evidence.parts:
        before, after = part.before['ls'], part.after['ls']
        print(f'check    {part.name}: mean normal off by {before.lean_deg:.3f} degrees before, '
              f'{after.lean_deg:.3f} after')


def calibrate_folders(folders: list[Path], target: RingTarget,
                head: HeadModel) -> tuple[list[Stack], Calibration]:
    """Pictures and result; pictures that cannot be read or lack frames are a failure, too."""
    stacks: list[Stack] = []
    try:
        stacks += [read_stack(folder)[0] for folder in folders]
        return stacks, calibrate(stacks, target, head)
    except PsError as error:
        return stacks, Calibration('FAILED', error.message, head.camera)


def _list(folder: Path, json_file: Path | None) -> None:
    entries = list_calibrations(folder)
    for entry in entries:
        print(entry.text)
    if json_file:
        json_file.write_text(json.dumps([
            {'file': str(entry.path), 'refused': entry.reason or None,
             'calibration': entry.calibration and entry.calibration.model_dump(mode='json')}
            for entry in entries], indent=2) + '\n')


def main() -> None:
    """Run the command line."""
    parser = _parser()
    arguments = parser.parse_args()
    if bool(arguments.folders) == bool(arguments.list):
        parser.error('give folders of pictures, or --list with a folder of calibrations')
    try:
        if arguments.list:
            _list(arguments.list, arguments.json)
            return
        head = load_head(arguments.head or nominal_head_path())
        target = load_target(arguments.target or default_target_path())
        stacks, result = calibrate_folders(arguments.folders, target, head)
        evidence = gather(result, stacks, [folder.name for folder in arguments.folders], target,
                          head, arguments.serial, [
            read_lights(folder).approach for folder in arguments.folders[:len(stacks)]])
        if evidence.calibration:
            evidence = replace(evidence, parts=[
                compare(folder.name, *read_stack(folder), head, evidence.calibration)
                for folder in arguments.check])
        if arguments.json:
            arguments.json.write_text(
                json.dumps(as_json(evidence, arguments.folders), indent=2) + '\n')
        if evidence.calibration and arguments.out:
            write_calibration(evidence.calibration, arguments.out)
        if arguments.report:
            write_report(report(evidence), arguments.report)
    except PsError as error:
        sys.exit(f'ps_calibrate: {error.code.name}: {error.message}')
    except OSError as error:
        sys.exit(f'ps_calibrate: {error.filename}: {error.strerror}')
    if result.verdict == 'FAILED':
        sys.exit(f'ps_calibrate: FAILED: {result.reason}')
    _print(evidence)


if __name__ == '__main__':
    main()
