"""Motion between frames: light alone is none, shifts are found, too little is said to be so."""
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from ps_head_driver import frame_motion
from ps_head_driver.fake.renderer import make_renderer
from ps_head_driver.head_model import load_head, nominal_head_path
from ps_head_driver.stack import Light, Mode, Panel

RING = [Light(panel=Panel(i)) for i in range(4)]
BOTH = [*RING, *(Light(panel=Panel(i), mode=Mode.DARK_FIELD) for i in range(4))]
MARGIN = 48
DATA = Path(os.environ.get('PS_DATA', Path(__file__).resolve().parents[5] / 'shared' / 'data'))
METAL_DISC = DATA / 'metal_disc'


class Scene:
    """Pictures of a scene under each panel, matt and glossy light on its true normals."""

    def __init__(self, name: str) -> None:
        renderer = make_renderer(name, load_head(nominal_head_path()), scale=0.5)
        normal = renderer.truth().normal.astype(float)
        self._images = []
        for i in range(8):
            slant, azimuth = np.radians(40 if i < 4 else 70), np.pi / 2 * (i % 4)
            light = np.array([np.sin(slant) * np.cos(azimuth), np.sin(slant) * np.sin(azimuth),
                              np.cos(slant)])
            half = light + np.array([0.0, 0.0, 1.0])
            half /= np.linalg.norm(half)
            matt = renderer.albedo * np.clip(normal @ light, 0, None)
            gloss = 0.5 * np.clip(normal @ half, 0, None)**60
            self._images.append(0.8 * matt + gloss)

    def frames(self, positions, seed=1):
        """Noisy 8-bit frames, each moved to its position (x, y), px."""
        rng = np.random.default_rng(seed)
        frames = []
        for image, (x, y) in zip(self._images, positions, strict=False):
            rows, columns = image.shape
            level = image[MARGIN + y:rows - MARGIN + y, MARGIN + x:columns - MARGIN + x].copy()
            level += rng.normal(0, np.sqrt(level / 10_000 + 2.5e-7))
            frames.append(np.clip(np.rint(level * 255), 0, 255).astype(np.uint8))
        return frames


@pytest.fixture(scope='module', params=['disc', 'roughness'])
def scene(request) -> Scene:
    return Scene(request.param)


@pytest.mark.parametrize('lights', [RING, BOTH], ids=['ring', 'both'])
def test_light_alone_is_no_motion(scene: Scene, lights):
    assert frame_motion.measure(scene.frames([(0, 0)] * len(lights)), lights) < 0.7


@pytest.mark.parametrize('step', [(1, 0), (0, -1), (2, 1), (-9, 4)])
def test_drift_is_measured(scene: Scene, step):
    drift = [(i * step[0], i * step[1]) for i in range(4)]
    wanted = 3 * np.hypot(*step)
    assert frame_motion.measure(scene.frames(drift), RING) == pytest.approx(
        wanted, abs=0.7 + 0.02 * wanted)


@pytest.mark.parametrize('moved', range(4))
def test_one_frame_that_was_somewhere_else_is_found(scene: Scene, moved):
    positions = [(3, 0) if i == moved else (0, 0) for i in range(4)]
    assert frame_motion.measure(scene.frames(positions), RING) == pytest.approx(3.0, abs=0.8)


def test_a_large_jump_is_found(scene: Scene):
    positions = [(0, 0), (0, 0), (45, -30), (45, -30)]
    assert frame_motion.measure(scene.frames(positions), RING) > 20


def test_exposure_and_colour_do_not_matter(scene: Scene):
    frames = scene.frames([(0, 0), (2, 0), (4, 0), (6, 0)])
    frames = [np.stack([(frame * factor).astype(np.uint8)] * 3, axis=2)
              for frame, factor in zip(frames, (1.0, 0.5, 0.8, 0.3), strict=True)]
    assert frame_motion.measure(frames, RING) == pytest.approx(6.0, abs=0.8)


def test_too_little_to_tell():
    plate = Scene('plate')
    assert np.isnan(frame_motion.measure(plate.frames([(0, 0)] * 4), RING))
    assert np.isnan(frame_motion.measure(plate.frames([(5 * i, 0) for i in range(4)]), RING))
    assert np.isnan(frame_motion.measure([np.zeros((24, 32), np.uint8)] * 4, RING))


def test_edges_that_wander_with_the_light_are_no_motion():
    # as deep shadows do: everything that is seen lies 4 px toward the light
    random = np.random.default_rng(3).random((400, 400))
    toward = {Panel.E: (4, 0), Panel.N: (0, -4), Panel.W: (-4, 0), Panel.S: (0, 4)}
    frames = [np.roll(random, toward[light.panel][::-1], (0, 1)) * 255 for light in RING]
    frames = [frame.astype(np.uint8) for frame in frames]
    assert frame_motion.measure(frames, RING) < 0.5
    moved = [np.roll(frame, 3 * i, 1) for i, frame in enumerate(frames)]
    assert frame_motion.measure(moved, RING) > 5


@pytest.mark.skipif(not METAL_DISC.is_dir(), reason=f'no {METAL_DISC}; set PS_DATA')
def test_real_pictures_under_four_lights():
    images = [cv2.imread(str(METAL_DISC / f'part_{ending}.jpg'), cv2.IMREAD_REDUCED_GRAYSCALE_4)
              for ending in ('090', '180', '270', '000')]
    assert frame_motion.measure(images, RING) < 0.7
    rows, columns = images[0].shape
    moved = [image[20:rows - 20, 20 + i:columns - 20 + i] for i, image in enumerate(images)]
    assert frame_motion.measure(moved, RING) == pytest.approx(3.0, abs=0.7)
