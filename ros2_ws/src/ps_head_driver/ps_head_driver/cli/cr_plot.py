"""Drawing of the head at one motor position, and of CR over the motor's range."""
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

from ps_head_driver.convergence_radius import Branch, CrSolution, CrSolver
from ps_head_driver.head_model import HeadModel
from ps_head_driver.kinematics import BrightFieldKinematics, DarkFieldKinematics

_INK, _LIGHT, _DARK, _AXIS = '#20303c', '#e39b12', '#7b5ea7', '#c8553d'
_BRANCH_COLOURS = {Branch.UNCROSSED: '#1f6f8b', Branch.CROSSED: '#c8553d', Branch.MIXED: '#999999'}


def plot(head: HeadModel, solver: CrSolver, solution: CrSolution, path: Path) -> None:
    """Write the drawing as PNG, SVG or PDF, by the file's suffix."""
    figure = Figure(figsize=(11, 4.8), layout='constrained')
    side, curve = figure.subplots(1, 2, width_ratios=(1.15, 1))
    _draw_side_view(side, head, solver, solution)
    _draw_curve(curve, solver, solution)
    try:
        figure.savefig(path, dpi=130)
    except ValueError as error:      # matplotlib's word for a suffix it does not know
        raise OSError(22, str(error).split(' (')[0], str(path)) from error


def _draw_side_view(ax: Axes, head: HeadModel, solver: CrSolver, solution: CrSolution) -> None:
    mm = 1e3
    bright = BrightFieldKinematics(head)
    dark = DarkFieldKinematics(head)
    plane = solver.plane_z * mm
    standoff = head.camera.camera_standoff * mm
    half_field = head.camera.width_px / 2 / head.camera.fx * (standoff - plane)

    ax.axhline(plane, color=_INK, lw=1.2)
    ax.fill([0, -half_field, half_field], [standoff, plane, plane], color='#9db4c0', alpha=0.25,
            lw=0)
    ax.plot([0], [standoff], marker='v', ms=11, color=_INK)
    ax.annotate('camera', (0, standoff), (9, 2), textcoords='offset points', fontsize=9)

    field, slider = head.bright_field, head.bright_field.slider
    slider_z = slider.z_at_m0 + slider.direction * (
        solution.motor_counts - slider.m0_counts) / slider.counts_per_metre
    angle = solution.tilt + field.crank.offset
    pin = (field.hinge.r + field.crank.radius * np.cos(angle),
           field.hinge.z - field.crank.radius * np.sin(angle))
    for name, side in (('E', 1), ('W', -1)):
        pose = bright.panel_pose(name, solution.tilt)      # type: ignore[arg-type]
        center, direction = pose.center[[0, 2]], pose.axis[[0, 2]]
        face = np.array([direction[1], -direction[0]]) * pose.size[1] / 2
        ends = np.stack([center - face, center + face]) * mm
        ax.plot(*ends.T, color=_LIGHT, lw=5, solid_capstyle='round',
                label='bright-field panel' if side > 0 else None)
        reach = (solver.plane_z - center[1]) / direction[1]
        line = np.stack([center, center + reach * direction]) * mm
        ax.plot(*line.T, color=_AXIS, lw=1, ls='--', label='panel axis' if side > 0 else None)
        links = np.array([[slider.r, slider_z], pin, [field.hinge.r, field.hinge.z]]) * mm
        links[:, 0] *= side
        ax.plot(*links.T, color=_INK, lw=1.4, marker='o', ms=3.5,
                label='rod and crank' if side > 0 else None)
        ax.plot([side * field.hinge.r * mm, center[0] * mm],
                [field.hinge.z * mm, center[1] * mm], color=_INK, lw=1)
        low = dark.panel_pose(name, head.dark_field.tilt_range[1])      # type: ignore[arg-type]
        face = np.array([low.axis[2], -low.axis[0]]) * low.size[1] / 2
        ends = np.stack([low.center[[0, 2]] - face, low.center[[0, 2]] + face]) * mm
        ax.plot(*ends.T, color=_DARK, lw=5, solid_capstyle='round',
                label='dark-field panel' if side > 0 else None)
    radius = solution.convergence_radius / 2 * mm
    ax.annotate('', (-radius, plane - 12), (radius, plane - 12),
                arrowprops={'arrowstyle': '<->', 'color': _AXIS})
    ax.text(0, plane - 17, f'CR {2 * radius:.1f} mm', color=_AXIS, ha='center', va='top')
    ax.set_title(f'{head.name}\nm = {solution.motor_counts}, tilt '
                 f'{np.degrees(solution.tilt):.1f}°, h = {solution.light_height * mm:.1f} mm',
                 fontsize=11)
    ax.set(xlabel='x, mm', ylabel='z, mm', aspect='equal', ylim=(plane - 40, standoff + 20))
    ax.legend(loc='upper center', bbox_to_anchor=(0.5, -0.12), ncols=4, fontsize=8, frameon=False)
    _tidy(ax)


def _draw_curve(ax: Axes, solver: CrSolver, solution: CrSolution) -> None:
    m, cr, branch = solver.sampled
    ceiling = max(3 * solution.convergence_radius, 0.25) * 1e3
    for which, colour in _BRANCH_COLOURS.items():
        if (branch == which).any():
            # where the branches mix the fit may run off towards a straight line
            shown = (branch == which) & ((which != Branch.MIXED) | (cr * 1e3 < ceiling))
            ax.plot(m, np.where(shown, cr, np.nan) * 1e3, color=colour, lw=2,
                    label=which.name.lower())
    ax.plot([solution.motor_counts], [solution.convergence_radius * 1e3], 'o', color=_INK, ms=7)
    ax.axhline(solution.convergence_radius * 1e3, color=_INK, lw=0.8, ls=':')
    ax.set_title('CR over the range of the motor', fontsize=11)
    ax.set(xlabel='motor, counts', ylabel='CR, mm',
           ylim=(0, ceiling))
    ax.legend(frameon=False)
    _tidy(ax)


def _tidy(ax: Axes) -> None:
    ax.grid(alpha=0.25)
    ax.spines[['top', 'right']].set_visible(False)
