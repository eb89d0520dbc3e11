"""Fake camera: time per frame at 1280x1024, first and repeated; error of the panel sampling."""
import time

import numpy as np
from rich.console import Console
from rich.table import Table

from ps_head_driver.fake.renderer import Sensor, emitters, make_renderer
from ps_head_driver.fake.scenes import SCENES
from ps_head_driver.fake.surface_renderer import MATT
from ps_head_driver.head_model import DIRECTIONS, load_head, nominal_head_path
from ps_head_driver.kinematics import BrightFieldKinematics, DarkFieldKinematics
from ps_head_driver.stack import angular_error_deg

TILT, DF_TILT = np.radians(30), 1.3
OFF = (0.0,) * 4
DENSE = (120, 60)


def _timed(action, *arguments, **named):  # type: ignore[no-untyped-def]
    """Result, wall time and processor time of one call, s."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = action(*arguments, **named)
    return result, time.perf_counter() - wall, time.process_time() - cpu


def _frame_times() -> Table:
    table = Table(title='Frames of 1280x1024; wall time (processor time of all cores), s')
    for title in ('scene', 'open', 'bright field, first', 'dark field, first', 'repeated'):
        table.add_column(title)
    head = load_head(nominal_head_path())
    make_renderer('plate', head, scale=0.05).warm_up()
    for scene in SCENES:
        renderer, *opening = _timed(make_renderer, scene, head, Sensor())
        levels = np.eye(4)
        bright = [_timed(renderer.render, TILT, DF_TILT, levels[i])[1:] for i in range(4)]
        dark = [_timed(renderer.render, TILT, DF_TILT, OFF, levels[i])[1:] for i in range(4)]
        again = [_timed(renderer.render, TILT, DF_TILT, levels[i % 4], frame=i)[1:]
                 for i in range(8)]
        cells = [opening, *(np.mean(times, axis=0) for times in (bright, dark, again))]
        table.add_row(scene, *(f'{wall:.3f} ({cpu:.3f})' for wall, cpu in cells))
    return table


def _sampling_error() -> Table:
    table = Table(title=f'{MATT[0]} x {MATT[1]} emitters a panel against {DENSE[0]} x {DENSE[1]}, '
                  '50 x 40 mm field')
    for title in ('ring', 'tilt, degrees', 'light direction, worst, degrees', 'irradiance, worst'):
        table.add_column(title)
    head = load_head(nominal_head_path())
    field = [np.array([x, y, 0.0]) for x in (-0.025, 0.0, 0.025) for y in (-0.02, 0.0, 0.02)]
    for name, ring, tilts in (('bright field', BrightFieldKinematics(head), (0, 15, 30, 40)),
                              ('dark field', DarkFieldKinematics(head), (65, 75, 85))):
        for tilt in tilts:
            angles, losses = [], []
            for direction in DIRECTIONS:
                pose = ring.panel_pose(direction, np.radians(tilt))  # type: ignore[arg-type]
                for point in field:
                    vectors = []
                    for count, gauss in ((MATT, True), (DENSE, False)):
                        samples, _ = emitters(pose, count, gauss)
                        d = samples[:3].T - point
                        r = np.linalg.norm(d, axis=1, keepdims=True)
                        cosine = np.maximum(-(d @ pose.axis)[:, None] / r, 0)
                        vectors.append(np.sum(cosine * d / r ** 3 * samples[3, :, None], axis=0))
                    angles.append(angular_error_deg(*vectors))
                    losses.append(abs(vectors[0][2] / vectors[1][2] - 1))
            table.add_row(name, str(tilt), f'{max(angles):.5f}', f'{max(losses):.1e}')
    return table


def main() -> None:
    """Print both tables."""
    console = Console()
    console.print(_frame_times())
    console.print(_sampling_error())


if __name__ == '__main__':
    main()
