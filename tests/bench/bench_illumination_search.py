"""Illumination search on rendered scenes: regret against an exhaustive sweep, probes, time.

Regret: mean angular error of the normals at the setting found, over that at the best of all
settings, minus one; both by least squares on pictures of their own. Time: of the search alone,
without rendering and captures. `bright` may choose among the bright field's CRs only.
"""
import time

import numpy as np
from rich.console import Console
from rich.table import Table

from ps_head_driver import convergence_radius
from ps_head_driver.fake.renderer import Renderer, make_renderer
from ps_head_driver.head_model import load_head, nominal_head_path
from ps_head_driver.kinematics import lights_at
from ps_head_driver.stack import Mode, Stack, angular_error_deg
from ps_inspection.illumination_search import IlluminationSearch, Setting
from ps_reconstruction.pipeline import reconstruct

HEAD = load_head(nominal_head_path())
DARK_FIELD_TILT = 1.3
POSITIONS = 9
SCALE = 0.25
# those the search was asked to be good at, then steeper ones that are hard for the dark field
ISSUE = ('plate', 'boss', 'glossy_plate', 'copper', 'scratches', 'weld', 'orange_peel')
STEEP = ('boss:height=0.004,slope=0.7', 'dome:height=0.006')


def settings(positions: int = POSITIONS) -> list[Setting]:
    """Bright field at motor positions from CR 200 to 12 mm, and the dark field."""
    first, last = (convergence_radius.inverse(HEAD, cr).motor_counts for cr in (0.2, 0.012))
    found = []
    for counts in np.linspace(first, last, positions).round().astype(int):
        solution = convergence_radius.forward(HEAD, int(counts))
        found.append(Setting(
            Mode.BRIGHT_FIELD, solution.convergence_radius, solution.tilt,
            tuple(lights_at(HEAD, int(counts), DARK_FIELD_TILT)[:4])))
    dark = tuple(lights_at(HEAD, 0, DARK_FIELD_TILT)[4:])
    return [*found, Setting(Mode.DARK_FIELD, float('nan'), DARK_FIELD_TILT, dark)]


def take(renderer: Renderer, setting: Setting, number: int) -> Stack:
    """What the head would take at a setting; the number draws the noise."""
    images = []
    for i, one in enumerate(np.eye(4)):
        levels = (one, np.zeros(4)) if setting.mode == Mode.BRIGHT_FIELD else (np.zeros(4), one)
        tilt = setting.tilt if setting.mode == Mode.BRIGHT_FIELD else 0.0
        images.append(renderer.render(tilt, DARK_FIELD_TILT, *levels, frame=4 * number + i))
    return Stack(images, list(setting.lights), renderer.camera)


def measure(scene: str, choices: list[Setting]) -> list[dict]:
    """Two rows for a scene: both rings, bright field only."""
    renderer = make_renderer(scene, HEAD, scale=SCALE)
    truth = renderer.truth().normal
    errors = {}
    for number, setting in enumerate(choices):
        normal = reconstruct(take(renderer, setting, 1000 + number), outputs={'normal'}).normal
        errors[id(setting)] = float(np.nanmean(angular_error_deg(normal, truth)))
    rows = []
    for name, allowed in (('both', choices), ('bright', [
            setting for setting in choices if setting.mode == Mode.BRIGHT_FIELD])):
        search, busy = IlluminationSearch(allowed), 0.0
        while True:
            start = time.perf_counter()
            setting = search.next()
            busy += time.perf_counter() - start
            if setting is None:
                break
            stack = take(renderer, setting, len(search.probes))
            start = time.perf_counter()
            search.add(setting, stack)
            busy += time.perf_counter() - start
        best = min(allowed, key=lambda setting: errors[id(setting)])
        rows.append({
            'scene': scene, 'rings': name, 'found': search.best, 'best': best,
            'error': errors[id(search.best)], 'least': errors[id(best)],
            'expected': float(np.degrees(min(search.errors))),
            'regret': errors[id(search.best)] / errors[id(best)] - 1,
            'probes': len(search.probes), 'time': busy})
    return rows


def main() -> None:
    """Print one table and its summary."""
    choices = settings()
    table = Table('scene', 'rings', 'found', 'best', 'error found', 'best error', 'expected',
                  'regret', 'probes', 'time, s', title='illumination search; errors in degrees')
    console, rows = Console(width=150), []
    for scene in (*ISSUE, *STEEP):
        console.print(f'{scene} ...', style='dim')
        rows += measure(scene, choices)
    for row in rows:
        table.add_row(row['scene'], row['rings'], _name(row['found']), _name(row['best']),
                      f'{row["error"]:.3f}', f'{row["least"]:.3f}', f'{row["expected"]:.3f}',
                      f'{row["regret"]:.1%}', str(row['probes']), f'{row["time"]:.2f}')
    console.print(table)
    for rings in ('both', 'bright'):
        for title, scenes in (('scenes of the issue', ISSUE), ('steep scenes', STEEP)):
            some = [row for row in rows if row['rings'] == rings and row['scene'] in scenes]
            regret = [row['regret'] for row in some]
            console.print(
                f'{rings:6} {title}: regret median {np.median(regret):.1%}, worst '
                f'{max(regret):.1%}; probes median {np.median([r["probes"] for r in some]):g}, '
                f'most {max(r["probes"] for r in some)}; time median '
                f'{np.median([r["time"] for r in some]):.2f} s')


def _name(setting: Setting) -> str:
    return 'DF' if setting.mode == Mode.DARK_FIELD else \
        f'BF {setting.convergence_radius * 1e3:.0f} mm'


if __name__ == '__main__':
    main()
