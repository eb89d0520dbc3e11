"""Roughness specimens Ra 0.8 to 12.5 µm: measured against true Sa, and which can be told apart."""
import os

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from ps_head_driver.fake.renderer import make_renderer
from ps_head_driver.head_model import load_head, nominal_head_path
from ps_head_driver.kinematics import BrightFieldKinematics, lights_at
from ps_head_driver.stack import Stack
from ps_reconstruction.integration import gradients
from ps_reconstruction.near_field import stack_rays
from ps_reconstruction.pipeline import Options, reconstruct
from ps_reconstruction.surface import SIGMA_PER_CUTOFF, Roughness, roughness

RA = (0.8e-6, 1.6e-6, 3.2e-6, 6.3e-6, 12.5e-6)      # m
SEEDS = (1, 2, 3, 4) if os.environ.get('PS_BENCH_ALL') else (1, 2)
MOTOR_COUNTS = 20000
HEAD = load_head(nominal_head_path())
OPTIONS = Options()                                   # the node's defaults, filters included
FINISHES = {'matt': 'specular=0'}
if os.environ.get('PS_BENCH_ALL'):
    FINISHES['satin'] = 'specular=0.2,gloss=0.4'


def quadrants(values: NDArray) -> list[NDArray]:
    """The four quarters of a picture: as many places on the specimen."""
    rows, columns = (n // 2 for n in values.shape[:2])
    return [np.ascontiguousarray(values[a:a + rows, b:b + columns])
            for a in (0, rows) for b in (0, columns)]


def true_sa(height: NDArray, pitch: float) -> float:
    """Sa of the true heights after the same L-filter, margins left out."""
    sigma = SIGMA_PER_CUTOFF * OPTIONS.l_filter / pitch
    margin = int(OPTIONS.l_filter / pitch / 2)
    wave = np.asarray(cv2.GaussianBlur(height.astype(np.float64), (0, 0), sigma))
    fine = (height - wave)[margin:-margin, margin:-margin]
    return float(np.abs(fine - fine.mean()).mean())


def measure(scene: str) -> tuple[list[Roughness], list[float]]:
    """Roughness measured at four places of one noisy capture, and the truth there."""
    renderer = make_renderer(scene, HEAD)
    tilt = float(BrightFieldKinematics(HEAD).tilt(MOTOR_COUNTS))
    stack = Stack([renderer.render(tilt, 1.3, np.eye(4)[i], frame=i) for i in range(4)],
                  lights_at(HEAD, MOTOR_COUNTS, 1.3)[:4], renderer.camera)
    result = reconstruct(stack, OPTIONS, {'normal'})
    du, dv = gradients(result.normal, stack_rays(stack))
    height = renderer.truth().height
    assert height is not None
    assert stack.camera is not None
    metres = -result.pixel_pitch * stack.camera.fx      # of a unit of the integral, ln(depth)
    found = [roughness(*parts, result.pixel_pitch, metres, OPTIONS.s_filter, OPTIONS.l_filter)
             for parts in zip(*map(quadrants, (result.normal, du, dv)), strict=True)]
    return found, [true_sa(part, result.pixel_pitch) for part in quadrants(height)]


def main() -> None:
    """Print one table."""
    table = Table('finish', 'Ra of the specimen, µm', 'true Sa', 'measured Sa', 'deviation',
                  'Sq', 'Sdq', 'Sdr, %', 'from the one before',
                  title=f'1280x1024, 39 µm per pixel, LS, one capture of each of {len(SEEDS)} '
                        'specimens, 4 places each: mean ± standard deviation')
    for finish, arguments in FINISHES.items():
        before: NDArray | None = None
        for ra in (0.0, *RA):
            scenes = [f'roughness:ra={ra or 1e-9},seed={seed},{arguments}' for seed in SEEDS]
            measured = [measure(scene) for scene in scenes]
            found = [r for results, _ in measured for r in results]
            truth = float(np.mean([value for _, values in measured for value in values]))
            sa = np.array([r.sa for r in found])
            gap = '' if before is None else (
                f'{(sa.mean() - before.mean()) / np.hypot(sa.std(), before.std()):.0f} s.d.')
            before = sa
            table.add_row(
                finish, f'{ra * 1e6:.1f}' if ra else 'none', f'{truth * 1e6:.2f}',
                f'{sa.mean() * 1e6:.2f} ± {sa.std() * 1e6:.2f}',
                f'{sa.mean() / truth - 1:+.0%}' if ra else '',
                f'{np.mean([r.sq for r in found]) * 1e6:.2f}',
                f'{np.mean([r.sdq for r in found]):.3f}',
                f'{np.mean([r.sdr for r in found]) * 100:.2f}', gap)
    table.caption = (f'true Sa: of the rendered heights after the same L-filter, Gaussian, '
                     f'{OPTIONS.l_filter * 1e3:g} mm; no S-filter (the pixel is one). '
                     'none: what noise alone gives')
    Console(width=120).print(table)


if __name__ == '__main__':
    main()
