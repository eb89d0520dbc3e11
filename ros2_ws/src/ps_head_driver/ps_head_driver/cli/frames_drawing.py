"""Side view of a head with its frames and the dimensions a robot integrator needs."""
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
import numpy as np
from numpy.typing import NDArray

from ps_head_driver.frames import LINK_FRAME, OPTICAL_FRAME, PLANE_FRAME
from ps_head_driver.head_frames import chain, static_transforms
from ps_head_driver.head_model import DIRECTIONS, HeadModel
from ps_head_driver.kinematics import BrightFieldKinematics, DarkFieldKinematics, PanelPose

_INK, _STEEL, _BRIGHT, _DARK = '#20303c', '#c9d3da', '#e39b12', '#7b5ea7'
_AXES = ('#c8372d', '#2f8f46', '#2a63b8')      # x red, y green, z blue, as in RViz
_MM = 1e3
_SHOWN_TILT = np.radians(35)


def draw(head: HeadModel, path: Path) -> None:
    """Write the drawing as SVG, PNG or PDF, by the file's suffix.

    :raises OSError: naming the file, also for a suffix that is not known.
    """
    figure = Figure(figsize=(7.4, 6.6), layout='constrained')
    ax = figure.subplots()
    bright, dark = BrightFieldKinematics(head), DarkFieldKinematics(head)
    standoff = head.camera.camera_standoff
    to_plane = np.linalg.inv(chain(static_transforms(head)))
    face = to_plane[2, 3]

    _housing(ax, head, standoff, face)
    half = head.camera.width_px / 2 / head.camera.fx * standoff
    ax.fill(np.array([0, -half, half]) * _MM, np.array([standoff, 0, 0]) * _MM, color='#9db4c0',
            alpha=0.3, lw=0)
    tilt = min(_SHOWN_TILT, bright.tilt_limits[1])
    for name in ('E', 'W'):
        for angle, alpha in ((bright.tilt_limits[0], 0.25), (tilt, 1.0)):
            pose = bright.panel_pose(name, angle)
            hinge = bright.ring.hinges[DIRECTIONS.index(name)]
            arm = np.stack([hinge, pose.center])[:, [0, 2]] * _MM
            ax.plot(*arm.T, color=_INK, lw=1.2, alpha=alpha)
            _panel(ax, pose, _BRIGHT, alpha)
        low = dark.panel_pose(name, dark.tilt_limits[1])
        _panel(ax, low, _DARK, 1.0)
    reach = 1.2 * (head.bright_field.hinge.r + head.bright_field.arm.along)
    ax.plot([-reach * _MM, reach * _MM], [0, 0], color=_INK, lw=1)

    _frame(ax, to_plane, LINK_FRAME, (-150, -14))
    for frame, note in ((OPTICAL_FRAME, (-228, -4)), (PLANE_FRAME, (16, -24))):
        _frame(ax, to_plane @ chain(static_transforms(head), frame), frame, note)
    right = reach * 1.1
    _height(ax, right, 0, standoff, f'camera_standoff {standoff * _MM:.0f} mm')
    _height(ax, right, standoff, face, f'{abs(face - standoff) * _MM:.0f} mm')
    _height(ax, -right, 0, head.bright_field.hinge.z,
            f'hinges {head.bright_field.hinge.z * _MM:.0f} mm')
    ax.text(-reach * _MM, -8, 'nominal measurement plane', color=_INK, fontsize=9, va='top')
    ax.text((half + 0.004) * _MM, 48, f'sees {2 * half * _MM:.0f} mm', fontsize=8, color=_INK)
    ax.set(aspect='equal', xlim=np.array([-1.22, 1.22]) * reach * _MM,
           ylim=(-50, max(face, standoff) * _MM + 60))
    ax.axis('off')
    try:
        figure.savefig(path, dpi=130, bbox_inches='tight')
    except ValueError as error:      # matplotlib's word for a suffix it does not know
        raise OSError(22, str(error).split(' (')[0], str(path)) from error


def _housing(ax: Axes, head: HeadModel, standoff: float, face: float) -> None:
    """Camera body between mounting face and camera centre, the tube below it, the flange above."""
    radius = 0.8 * head.bright_field.hinge.r * _MM
    hinge = head.bright_field.hinge.z * _MM
    for low, high, half in ((hinge, standoff * _MM, radius),
                            (standoff * _MM, face * _MM, 0.75 * radius)):
        ax.add_patch(Rectangle((-half, low), 2 * half, high - low, facecolor=_STEEL,
                               edgecolor=_INK, lw=0.8, alpha=0.75))
    ax.add_patch(Rectangle((-1.1 * radius, face * _MM), 2.2 * radius, 12, facecolor='#8a979f',
                           edgecolor=_INK, lw=0.8))
    ax.text(0, face * _MM + 17, "robot's tool flange", ha='center', fontsize=9, color=_INK)
    for side in (1, -1):
        ax.plot([side * radius, side * head.bright_field.hinge.r * _MM], [hinge, hinge],
                color=_INK, lw=1.4)


def _panel(ax: Axes, pose: PanelPose, colour: str, alpha: float) -> None:
    center, axis = pose.center[[0, 2]] * _MM, pose.axis[[0, 2]]
    half = np.array([axis[1], -axis[0]]) * pose.size[1] / 2 * _MM
    ax.plot(*np.stack([center - half, center + half]).T, color=colour, lw=5, alpha=alpha,
            solid_capstyle='butt')
    if alpha == 1.0 and center[1] > 0:
        ax.annotate('', tuple(center + 26 * axis), tuple(center),
                    arrowprops={'arrowstyle': '-|>', 'color': colour, 'lw': 1})


def _frame(ax: Axes, pose: NDArray, name: str, note: tuple[float, float]) -> None:
    """Axes of a frame seen from -y of ps_head_plane: dot towards the viewer, cross away."""
    origin, length = pose[[0, 2], 3] * _MM, 30.0
    for direction, colour, letter in zip(pose[:3, :3].T, _AXES, 'xyz', strict=True):
        seen = direction[[0, 2]]
        if np.linalg.norm(seen) > 0.2:
            tip = origin + length * seen
            ax.annotate('', tuple(tip), tuple(origin), arrowprops={
                'arrowstyle': '-|>', 'color': colour, 'lw': 2.2, 'shrinkA': 0, 'shrinkB': 0})
            x, y = tip + 7 * seen
            ax.text(x, y, letter, color=colour, ha='center', va='center',
                    fontsize=10, weight='bold')
        else:
            ax.plot(*origin, 'o', ms=9, mfc='white', mec=colour, mew=1.8, zorder=5)
            ax.plot(*origin, '.' if direction[1] < 0 else 'x', ms=5, color=colour, zorder=6)
    ax.annotate(name, tuple(origin), note, textcoords='offset points', fontsize=9.5, color=_INK,
                family='monospace', bbox={'fc': 'white', 'ec': 'none', 'alpha': 0.8, 'pad': 1})


def _height(ax: Axes, x: float, low: float, high: float, text: str) -> None:
    x, low, high = x * _MM, low * _MM, high * _MM
    ax.annotate('', (x, low), (x, high), arrowprops={
        'arrowstyle': '<|-|>', 'color': _INK, 'lw': 0.9, 'shrinkA': 0, 'shrinkB': 0})
    ax.text(x + 4, (low + high) / 2, text, rotation=90, va='center', fontsize=8.5, color=_INK)
    ax.plot([min(0, x), max(0, x)], [high, high], color=_INK, lw=0.5, ls=':', zorder=0)
