"""Make the pictures of docs/guide_ls_or_stv.md from the fake camera's scenes."""
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ps_head_driver.fake.renderer import Renderer, make_renderer
from ps_head_driver.head_model import load_head, nominal_head_path
from ps_head_driver.kinematics import BrightFieldKinematics, lights_at
from ps_head_driver.stack import Stack
from ps_reconstruction import preview
from ps_reconstruction.benchmark import evaluate
from ps_reconstruction.cli.ps_diligent import figure_of
from ps_reconstruction.pipeline import Options, reconstruct

IMAGES = Path(__file__).resolve().parents[1] / 'docs' / 'images'
HEAD = load_head(nominal_head_path())
MOTOR_COUNTS = 20000
EXPOSURE = 0.003     # s
SCALE = 0.4          # of the camera's pixels


def captured(scene: str) -> tuple[Stack, Renderer]:
    """Four bright-field pictures of a scene."""
    renderer = make_renderer(scene, HEAD, scale=SCALE)
    tilt = float(BrightFieldKinematics(HEAD).tilt(MOTOR_COUNTS))
    images = [renderer.render(tilt, 1.3, list(np.eye(4)[i]), exposure=EXPOSURE,
                              frame=i) for i in range(4)]
    return Stack(images, lights_at(HEAD, MOTOR_COUNTS, 1.3)[:4], renderer.camera), renderer


def tiled(pictures: list[NDArray], columns: int = 2, gap: int = 8) -> NDArray:
    """Pictures of one size side by side on white."""
    height, width = pictures[0].shape[:2]
    rows = -(-len(pictures) // columns)
    sheet = np.full((rows * (height + gap) - gap, columns * (width + gap) - gap, 3), 255, np.uint8)
    for i, picture in enumerate(pictures):
        y, x = (i // columns) * (height + gap), (i % columns) * (width + gap)
        sheet[y:y + height, x:x + width] = picture if picture.ndim == 3 else picture[..., None]
    return sheet


def save(name: str, rgb: NDArray) -> None:
    """Write a JPEG into docs/images."""
    cv2.imwrite(str(IMAGES / name), np.ascontiguousarray(rgb[..., ::-1]),
                [cv2.IMWRITE_JPEG_QUALITY, 85])


def main() -> None:
    """Write ls_and_stv.jpg and surface_outputs.jpg."""
    stack, renderer = captured('weld')
    save('ls_and_stv.jpg', figure_of(*evaluate(stack, renderer.truth(), 'weld bead', 'all'),
                                     stack.images[1]))
    result = reconstruct(stack, Options(method='stv'))
    assert result.preview is not None
    assert result.shape is not None
    assert result.slope is not None
    assert result.height is not None
    size = (stack.shape[1], stack.shape[0])
    save('surface_outputs.jpg', tiled([
        result.preview, preview.slope_preview(result.slope), result.shape,
        preview.height_view(result.height, result.pixel_pitch, size, title='Height')]))


if __name__ == '__main__':
    main()
