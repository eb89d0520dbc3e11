"""The dark field's section of the calibration report: pictures, shadows, residuals, numbers."""
from collections.abc import Sequence
import math
from typing import Any

import numpy as np

from ps_calibration import report_figures as figures
from ps_calibration.calibrate import Calibration
from ps_calibration.dark_field import DarkPanel
from ps_calibration.plate_light import free_light, light_of
from ps_calibration.report_parts import figure, single_pictures
from ps_calibration.ring_target import RingTarget
from ps_calibration.uncertainty import dark_figures
from ps_head_driver.head_model import DIRECTIONS, HeadModel
from ps_head_driver.stack import Mode, Stack

_PITCH = 5e-4            # m, of the lines of the fit
_SOURCES = {'shadows': 'shadows and fall-off', 'plate': 'fall-off over the plate alone',
            'nominal': 'not calibrated'}
# scale of the parameters in the table, digits
_UNITS = ((1e3, 2),) * 3 + ((180 / math.pi, 2),) * 2


def dark_field_section(result: Calibration, stacks: Sequence[Stack], head: HeadModel,
                       target: RingTarget) -> dict[str, Any]:
    """What the template shows of it.

    :param head: as designed.
    """
    dark, fit = result.dark, result.fit
    section: dict[str, Any] = {'verdict': dark.verdict, 'reason': dark.reason, 'pictures': [],
                               'shadows': [], 'residuals': [], 'lights': [], 'corrections': []}
    if fit is None or dark.light is None:
        return section
    section['tilt'] = f'{math.degrees(dark.tilt):.1f}'
    section['pictures'] = single_pictures(stacks[dark.position], Mode.DARK_FIELD)
    x, y = (np.arange(low, high, _PITCH) for low, high in zip(
        dark.light.points.min(axis=0), dark.light.points.max(axis=0), strict=True))
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    under = target.distance(*grid.T) == 0
    known = dark_figures(dark, fit.pose, head, result.camera)
    for i, (name, pose, panel) in enumerate(zip(DIRECTIONS, dark.poses(head), dark.panels,
                                                strict=True)):
        light = known[i].direction
        section['lights'].append([
            name, _SOURCES[panel.source], *(f'{1e3 * c:.2f}' for c in pose.center),
            f'{math.degrees(math.asin(light[2])):.3f}',
            f'{math.degrees(math.remainder(math.atan2(light[1], light[0]), math.tau)):.3f}',
            _number(math.degrees(known[i].direction_deviation), 4),
            f'{pose.intensity:.4f}' + (f' ± {pose.intensity * panel.deviation[5]:.4f}'
                                       if panel.calibrated else ''),
            _number(panel.edge_px, 3)])
        section['corrections'].append([name, *_corrections(panel)])
        if not panel.calibrated:
            continue
        here = fit.pose.panel_to_target(pose)
        seen = light_of(here, grid, target) / free_light(here, grid)
        seen[under] = math.nan
        measured = dark.light.values[i] / free_light(here, dark.light.points)
        section['shadows'].append(figure(
            name, figures.grazing_shadow(dark.light.points, measured, x, y,
                                         seen.reshape(len(y), len(x))),
            f'{panel.shaded} places in soft shadow; edges off by {panel.edge_px:.3f} px (RMS)'))
        section['residuals'].append(figure(
            name, figures.residuals(dark.light.pixels, panel.residuals, result.camera, 30.0),
            f'RMS {1e3 * panel.rms:.1f} thousandths, {panel.scatter:.2f} of the noise expected'))
    return section


def _corrections(panel: DarkPanel) -> list[str]:
    """Of the head file, with deviations; what the pictures do not tell stays nominal."""
    if not panel.calibrated:
        return ['nominal'] * len(_UNITS)
    return [f'{unit * value:+.{digits}f} ± {unit * deviation:.{digits}f}' if seen else 'nominal'
            for (unit, digits), value, deviation, seen in zip(
                _UNITS, panel.correction, panel.deviation, panel.seen, strict=False)]


def _number(value: float, digits: int) -> str:
    return f'{value:.{digits}f}' if math.isfinite(value) else '–'
