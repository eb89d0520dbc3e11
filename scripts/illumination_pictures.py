"""Make the pictures of docs/illumination.md: bright field beside dark field on rendered scenes.

Usage: python scripts/illumination_pictures.py
"""
from pathlib import Path

import cv2
import matplotlib
import numpy as np
from numpy.typing import NDArray

matplotlib.use('Agg')
import matplotlib.pyplot as plt

from ps_head_driver.convergence_radius import inverse
from ps_head_driver.fake.renderer import OFF, make_renderer
from ps_head_driver.head_model import load_head, nominal_head_path
from ps_head_driver.kinematics import lights_at
from ps_head_driver.stack import Mode, Stack, angular_error_deg
from ps_reconstruction.pipeline import reconstruct

FOLDER = Path(__file__).resolve().parents[1] / 'docs' / 'images'
# scene: title, exaggeration of the relief in the view of the normals
SCENES = {
    'copper': ('Laminated copper: blisters and rolling marks under a glossy film', 8.0),
    'scratches': ('Scratch plate: grooves of 5, 10 and 20 um on a satin plate', 8.0),
    'weld': ('Weld bead: 1.2 mm high, with flanks of 30 degrees', 1.0),
}
DARK_FIELD_TILT, CONVERGENCE_RADIUS = 1.3, 0.03


def draw(scene: str, title: str, gain: float) -> None:
    """One figure: a row for each ring; one picture, normals, shape, error."""
    head = load_head(nominal_head_path())
    renderer = make_renderer(scene, head, scale=0.5)
    truth = renderer.truth().normal
    solution = inverse(head, CONVERGENCE_RADIUS)
    lights = lights_at(head, solution.motor_counts, DARK_FIELD_TILT)
    figure, axes = plt.subplots(2, 4, figsize=(12, 5.2), layout='constrained')
    figure.suptitle(title, fontsize=13)
    for row, mode in enumerate((Mode.BRIGHT_FIELD, Mode.DARK_FIELD)):
        images = []
        for i, one in enumerate(np.eye(4).tolist()):
            bright, dark = (one, OFF) if mode == Mode.BRIGHT_FIELD else (OFF, one)
            images.append(renderer.render(solution.tilt, DARK_FIELD_TILT, bright, dark,
                                          frame=4 * mode + i))
        own = lights[4 * mode:4 * mode + 4]
        result = reconstruct(Stack(images, own, renderer.camera), outputs={'normal', 'shape'})
        error = angular_error_deg(result.normal, truth)
        name = 'dark field' if mode else f'bright field, CR {CONVERGENCE_RADIUS * 1e3:.0f} mm'
        lit = np.clip(images[0] * (230.0 / np.percentile(images[0], 99.8)), 0, 255)
        shown = {
            'picture, light from E': (lit.astype(np.uint8), 'gray', None),
            f'normals (x, y times {gain:g})': (normal_view(result.normal, gain), None, None),
            'shape': (result.shape, 'gray', None),
            f'error: mean {np.nanmean(error):.2f} deg': (
                cv2.blur(np.nan_to_num(error), (5, 5)), 'inferno', (0, 8))}
        for axis, (label, (picture, colours, limits)) in zip(axes[row], shown.items(),
                                                             strict=True):
            low, high = limits or (0, 255)
            drawn = axis.imshow(picture, cmap=colours, vmin=low, vmax=high)
            axis.set_title(label, fontsize=10)
            axis.set_xticks([], [])
            axis.set_yticks([], [])
            if axis is axes[row][0]:
                axis.set_ylabel(name, fontsize=11)
            if limits:
                figure.colorbar(drawn, ax=axis, shrink=0.75, label='degrees')
    FOLDER.mkdir(exist_ok=True)
    figure.savefig(FOLDER / f'bf_df_{scene}.jpg', dpi=85, pil_kwargs={'quality': 82})
    plt.close(figure)


def normal_view(normal: NDArray, gain: float) -> NDArray:
    """Normals as colours, relief exaggerated: red to the right, green up."""
    slope = np.nan_to_num(normal[..., :2]) * gain
    exaggerated = np.dstack([slope, np.nan_to_num(normal[..., 2:], nan=1.0)])
    exaggerated /= np.linalg.norm(exaggerated, axis=-1, keepdims=True)
    return ((exaggerated + 1) * 127.5).astype(np.uint8)


def main() -> None:
    """Make all figures."""
    for scene, (title, gain) in SCENES.items():
        draw(scene, title, gain)


if __name__ == '__main__':
    main()
