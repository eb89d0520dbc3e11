"""The calibration report: one HTML file with all that a calibration saw, found and is good for.

It has the paper's Fig. 2 (ring pictures, separated shadows, height of the ring) and Fig. 4 (a part
before and after the calibration) for this head, and the numbers behind them.
"""
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
import hashlib
import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from ps_calibration import report_figures as figures
from ps_calibration.before_after import Comparison
from ps_calibration.calibrate import Calibration, head_calibration
from ps_calibration.dark_field_report import dark_field_section
from ps_calibration.motor_calibration import MotorCalibration, motor_of
from ps_calibration.repeatability import Repeatability, repeatability, repeats
from ps_calibration.report_parts import figure, single_pictures
from ps_calibration.ring_height import height_map, wall_height
from ps_calibration.ring_pictures import light_only
from ps_calibration.ring_target import RingTarget
from ps_calibration.shadow_maps import edge_profile, shadow_maps
from ps_calibration.uncertainty import light_figures
from ps_head_driver.calibration_file import HeadCalibration, new_calibration_id
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.head_model import DIRECTIONS, Approach, HeadModel
from ps_head_driver.stack import Mode, Stack
from ps_reconstruction.html_report import page

_MEANING = {
    'OK': 'The pictures fit the target, and the result can be used.',
    'POOR': 'The result is better than none, but something is not as it should be.',
    'FAILED': 'There is no result. Mend what is named and take the pictures again.'}


@dataclass(frozen=True)
class Evidence:
    """What a report is made of.

    :param stacks: the pictures, one stack per motor position, and
    :param names: what to call them.
    :param calibration: as written to the file; None after a failure.
    :param created: of the pictures or, without a calibration, of the attempt.
    :param motor: if it was calibrated.
    :param repeated: scatter over repeated pictures, if there are any.
    :param parts: reconstructed before and after.
    """

    result: Calibration
    stacks: Sequence[Stack]
    names: Sequence[str]
    target: RingTarget
    head: HeadModel
    created: datetime
    calibration: HeadCalibration | None = None
    motor: MotorCalibration | None = None
    repeated: Sequence[Repeatability] = ()
    parts: Sequence[Comparison] = ()
    serial: str = ''

    @property
    def name(self) -> str:
        """For files: the calibration's id, or that it failed and when."""
        if self.calibration is not None:
            return self.calibration.calibration_id
        return f'failed-{new_calibration_id(self.serial, self.created)}'


def gather(result: Calibration, stacks: Sequence[Stack], names: Sequence[str], target: RingTarget,
           head: HeadModel, serial: str = '',
           approaches: Sequence[Approach | None] = ()) -> Evidence:
    """Make the calibration's file; calibrate the motor and measure the repeatability, too, where
    there are pictures for it.

    :param head: as designed.
    :param approaches: last direction of the motor before each stack; up if not known.
    :returns: without a calibration after a failure.
    """
    if result.fit is None or result.verdict == 'FAILED':
        return Evidence(result, stacks, names, target, head, datetime.now(UTC), serial=serial)
    calibration = head_calibration(result, head, target, serial)
    motor = motor_of(result, stacks, head, approaches)
    if motor is not None:
        known = motor.backlash_counts > 0
        calibration = calibration.model_copy(update={
            'motor': motor.correction,
            'backlash_counts': round(motor.backlash_counts) if known else 0})
    repeated = [found for group in repeats(stacks, approaches)
                if (found := repeatability(group, target, head)) is not None]
    return Evidence(result, stacks, names, target, head, calibration.created, calibration, motor,
                    repeated, serial=serial)


def write_report(text: str, path: Path) -> None:
    """Write a report, all of it or nothing.

    :raises PsError: CALIBRATION_WRITE_FAILED naming the file.
    """
    part = path.with_name(f'.{path.name}.part')
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_text(text, encoding='utf-8')
        os.replace(part, path)
    except OSError as error:
        raise PsError(ErrorCode.CALIBRATION_WRITE_FAILED,
                      f'{path}: {error.strerror or error}') from error


def report(evidence: Evidence) -> str:
    """The page, to be written or sent."""
    result = evidence.result
    sections: dict[str, Any] = {
        'pictures': [], 'shadows': [], 'residuals': [], 'ring': [], 'parts': [], 'lights': [],
        'corrections': [], 'dark': None, 'tables': [_provenance(evidence)], 'shown': ''}
    if evidence.stacks:
        shown = _most_doubtful(result)
        sections['shown'] = evidence.names[shown] if len(evidence.stacks) > 1 else ''
        sections['pictures'] = single_pictures(evidence.stacks[shown], Mode.BRIGHT_FIELD)
        if result.fit is not None:
            sections |= _shadows(evidence, shown)
            sections['ring'] = _ring(evidence, shown)
            sections['lights'] = _lights(evidence)
            sections['corrections'] = _corrections(evidence)
            sections['dark'] = dark_field_section(result, evidence.stacks, evidence.head,
                                                  evidence.target)
            sections['parts'] = [_part(part) for part in evidence.parts]
            sections['tables'] = [_quality(evidence), *_repeats(evidence), *_motor(evidence),
                                  _provenance(evidence)]
    return page('ps_calibration', 'calibration.html', verdict=result.verdict,
                meaning=_MEANING[result.verdict], reason=result.reason,
                subtitle=_subtitle(evidence), **sections)


def _subtitle(evidence: Evidence) -> str:
    head = f'head {evidence.serial}' if evidence.serial else f'head {evidence.head.name}'
    return f'{head}, target {evidence.target.name}, {evidence.created:%Y-%m-%d %H:%M} UTC'


def _most_doubtful(result: Calibration) -> int:
    """Motor position with the largest residuals: the one to look at."""
    if result.fit is None:
        return 0
    return int(np.argmax([float(np.max(edges)) for edges in result.fit.edge_px]))


def _shadows(evidence: Evidence, position: int) -> dict[str, list[dict[str, str]]]:
    fit, camera = evidence.result.fit, evidence.result.camera
    assert fit is not None
    singles = light_only(evidence.stacks[position])[:4]
    place = (singles, fit, position, evidence.head, evidence.target, camera)
    maps = shadow_maps(*place)
    shares, left = evidence.result.shares[position], fit.residuals[position]
    return {
        'shadows': [figure(
            name, figures.shadow(i, maps, edge_profile(i, *place)),
            f'edges off by {fit.edge_px[position][i]:.3f} px (RMS)')
            for i, name in enumerate(DIRECTIONS)],
        'residuals': [figure(
            name, figures.residuals(shares.pixels, left[i], camera),
            f'RMS {1e3 * float(np.sqrt(np.mean(left[i]**2))):.2f} thousandths')
            for i, name in enumerate(DIRECTIONS)]}


def _ring(evidence: Evidence, position: int) -> list[dict[str, str]]:
    result, target, head = evidence.result, evidence.target, evidence.head
    assert result.fit is not None
    heights = wall_height(result.fit, head, target, result.camera, result.shares)
    spread = float(np.nanstd(heights.height))
    found = [figure(
        'Height of the wall from its shadows', figures.wall(heights, target),
        f'known {1e3 * target.height:.3f} mm, fitted as a whole '
        f'{1e3 * target.height / result.z_scale:.3f} mm; along the arc it varies by '
        f'{1e6 * spread:.0f} µm (standard deviation; bars: two of the noise)')]
    if evidence.calibration is not None:
        stack = evidence.stacks[position]
        before = height_map(stack, result.fit, head, target, None)
        after = height_map(stack, result.fit, head, target, evidence.calibration)
        found.append(figure(
            'Reconstructed height, normalised', figures.ring_height(after),
            f"the plate is flat to {100 * after.flatness:.2f} % of the wall's height "
            f'({1e6 * after.flatness * target.height:.0f} µm RMS; before the calibration '
            f'{1e6 * before.flatness * target.height:.0f} µm). The wall comes out at '
            f'{100 * after.wall:.0f} %: an upright wall shows no slope, so this is a picture, '
            'not a measurement'))
    return found


def _part(part: Comparison) -> dict[str, Any]:
    before, after = part.before['ls'], part.after['ls']
    relief = part.truth if part.truth is not None else after.height
    low, high = (float(v) for v in np.nanpercentile(relief - np.nanmedian(relief), [0.5, 99.9]))
    margin = max(0.1 * (high - low), 2 * after.bow, 2e-6)
    outcomes = [table[method] for method in ('ls', 'stv') for table in (part.before, part.after)]
    rows: list[list[str]] = []
    for name, unit, values in (
            ('height off, apart from a tilt, RMS', ' µm', [1e6 * o.bow for o in outcomes]),
            ('mean normal, off', '°', [o.lean_deg for o in outcomes]),
            ('normals off the true ones, mean', '°', [o.bias_deg for o in outcomes]),
            ('the same, 99th percentile', '°', [o.worst_deg for o in outcomes]),
            ('height scale, error', ' %', [100 * (o.height_scale - 1) for o in outcomes])):
        if all(map(math.isfinite, values)):
            digits = 1 if unit == ' µm' else 2 if unit == ' %' else 3
            rows.append([name, *(f'{value:.{digits}f}{unit}' for value in values)])
    views = [figure(name, figures.part_height(
        outcome.height - np.nanmedian(outcome.height), low - margin, high + margin), caption)
        for name, outcome, caption in (
            ('Before', before, 'least squares with the lights as designed'),
            ('After', after, 'least squares with the lights as calibrated'),
            ('After, STV', part.after['stv'], 'robust against gloss'))]
    views.append(figure('Cross-section', figures.cross_section(part),
                        'along the middle row of the picture'))
    return {'name': part.name, 'rows': rows, 'views': views}


def _lights(evidence: Evidence) -> list[dict[str, Any]]:
    """One table per motor position."""
    result, fit = evidence.result, evidence.result.fit
    assert fit is not None
    tables = []
    for position, panels in enumerate(result.panels(evidence.head)):
        known = light_figures(fit, evidence.head, result.camera, position)
        rows = []
        for i, (name, panel) in enumerate(zip(DIRECTIONS, panels, strict=True)):
            x, y, z = known.direction[i]
            rows.append([
                name, *(f'{1e3 * c:.2f}' for c in panel.center),
                f'{math.degrees(math.asin(z)):.3f}',
                f'{math.degrees(math.remainder(math.atan2(y, x), 2 * math.pi)):.3f}',
                f'{math.degrees(known.direction_deviation[i]):.4f}',
                f'{known.intensity[i]:.4f} ± {known.intensity_deviation[i]:.4f}',
                f'{fit.edge_px[position][i]:.3f}'])
        tables.append({'name': f'{evidence.names[position]}, panels tilted by '
                               f'{math.degrees(fit.tilts[position]):.3f}°', 'rows': rows})
    return tables


def _corrections(evidence: Evidence) -> list[list[str]]:
    """Of each panel against the head file, with deviations."""
    fit = evidence.result.fit
    assert fit is not None
    return [[name, *(f'{1e3 * p[k]:+.2f} ± {1e3 * s[k]:.2f}' for k in range(3)),
             *(f'{math.degrees(p[k]):+.2f} ± {math.degrees(s[k]):.2f}' for k in (3, 4))]
            for name, p, s in zip(DIRECTIONS, fit.panels, fit.deviation, strict=True)]


def _quality(evidence: Evidence) -> dict[str, Any]:
    result, fit = evidence.result, evidence.result.fit
    assert fit is not None
    known = light_figures(fit, evidence.head, result.camera)
    normal = fit.pose.plane.normal
    x, y, _, turn = fit.pose.numbers[:4]
    return {'caption': 'Fit', 'rows': [
        ('residual of the light, RMS',
         f'{1e3 * max(float(np.sqrt(np.mean(r**2))) for r in fit.residuals):.2f} / 1000'),
        ('residual of the shadow edges, worst',
         f'{max(float(np.max(edges)) for edges in fit.edge_px):.3f} px'),
        ('condition of the fit', f'{fit.condition:.3g}'),
        ('scatter, relative to the noise', f'{fit.scatter:.2f}'),
        ('known over fitted height of the wall (z_scale)',
         f'{result.z_scale:.4f} ± {result.z_scale_deviation:.4f}'),
        ('light thrown by the wall, over what its reflectance says', f'{fit.glow:.2f}'),
        ('plane, tilt against the camera',
         f'{math.degrees(math.acos(min(normal[2], 1.0))):.3f}° ± '
         f'{math.degrees(known.level_deviation):.4f}°'),
        ('plane, height on the axis',
         f'{1e3 * fit.pose.plane.offset / normal[2]:+.3f} mm'),
        ('ring off the axis', f'{1e3 * x:+.2f}, {1e3 * y:+.2f} mm'),
        ('ring turned', f'{math.degrees(turn):+.2f}°'),
        ('computing time', f'{sum(result.timings_s.values()):.1f} s')]}


def _repeats(evidence: Evidence) -> list[dict[str, Any]]:
    return [{'caption': f'Repeatability, measured over {group.count} repeats', 'rows': [
        ('light direction, standard deviation, worst panel',
         f'{math.degrees(float(group.direction.max())):.4f}°'),
        ('relative intensity, worst panel', f'{100 * float(group.intensity.max()):.3f} %'),
        ('level of the plane', f'{math.degrees(group.level):.4f}°'),
        ('height scale', f'{100 * group.z_scale:.3f} %')]} for group in evidence.repeated]


def _motor(evidence: Evidence) -> list[dict[str, Any]]:
    motor = evidence.motor
    if motor is None:
        return []
    play = ('not known, both directions are needed' if math.isnan(motor.backlash_counts)
            else f'{motor.backlash_counts:.0f} counts')
    return [{'caption': 'Motor', 'rows': [
        ('offset', f'{motor.offset_counts:+.0f} counts'),
        ('travel, true over nominal', f'{motor.scale:.5f}'),
        ('crank, phase', f'{math.degrees(motor.crank_offset):+.3f}°'),
        ('backlash', play),
        ('repeatability', f'{motor.repeatability_counts:.0f} counts')]}]


def _provenance(evidence: Evidence) -> dict[str, Any]:
    made = evidence.calibration
    described = hashlib.sha256(evidence.target.model_dump_json().encode()).hexdigest()
    rows = [('calibration', made.calibration_id if made else 'none'),
            ('head', evidence.serial or 'serial number not given'),
            ('head file', evidence.head.name),
            ('target', f'{evidence.target.name} ({described[:12]})'),
            ('made', f'{evidence.created:%Y-%m-%d %H:%M:%S} UTC'),
            ('software', made.software_version if made else ''),
            ('pictures', ', '.join(evidence.names))]
    return {'caption': 'Provenance', 'rows': [(name, value) for name, value in rows if value]}
