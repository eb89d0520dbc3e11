"""The folder camera: pictures by panel, and clear words where a folder lacks one."""
import math
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from ps_head_driver.cameras.folder import FolderCamera
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.stack import Geometry, Light, Mode, Panel, Stack
from ps_head_driver.stack_folder import write_stack

SLANT = math.radians(45)
DATA = Path(os.environ.get('PS_DATA') or Path(__file__).parents[5] / 'shared' / 'data')
FOUR = {'E': '090', 'N': '180', 'W': '270', 'S': '000'}


def bright(*names: str) -> list[tuple[Mode, Panel]]:
    return [(Mode.BRIGHT_FIELD, Panel[name]) for name in names]


@pytest.fixture
def four(tmp_path):
    """Four plain pictures; the grey value tells the panel."""
    for grey, ending in enumerate(FOUR.values(), start=1):
        cv2.imwrite(str(tmp_path / f'part_{ending}.png'), np.full((6, 8), 10 * grey, np.uint8))
        cv2.imwrite(str(tmp_path / f'flat_{ending}.png'), np.full((6, 8), 200, np.uint8))
    with FolderCamera(tmp_path, SLANT) as camera:
        yield camera


@pytest.fixture
def near(tmp_path):
    """Bright and dark field, and an ambient frame."""
    lights = [Light(panel=panel, mode=mode, position=(0.1, 0.0, 0.1), size=(0.06, 0.03),
                    name=f'{mode.name}_{panel.name}')
              for mode in (Mode.BRIGHT_FIELD, Mode.DARK_FIELD) for panel in (Panel.E, Panel.W)]
    images = [np.full((6, 8), 20 + i, np.uint8) for i in range(4)]
    write_stack(Stack(images=images, lights=lights, ambient=np.full((6, 8), 3, np.uint8)),
                tmp_path / 'stack')
    with FolderCamera(tmp_path / 'stack', SLANT) as camera:
        yield camera


def test_each_panel_gets_its_picture_in_the_order_asked_for(four):
    four.arm([0.001, 0.002, 0.003, 0.004], panels=bright('S', 'E', 'W', 'N'), gain=3.0)
    frames = four.collect(4, 0.0)
    assert [int(frame.image.mean()) for frame in frames] == [40, 10, 30, 20]
    assert [frame.exposure_time for frame in frames] == [0.001, 0.002, 0.003, 0.004]
    assert {frame.gain for frame in frames} == {3.0}
    four.arm([0.001], panels=bright('E'))
    again, = four.collect(1, 0.0)
    assert again.frame_counter == frames[-1].frame_counter + 1
    four.disarm()
    assert four.collect(1, 0.0) == []


def test_the_folder_brings_its_own_lights(four):
    stack = four.source_stack
    assert stack.geometry == Geometry.ASSUMED
    assert len(stack.gain_maps) == 4
    east = next(light for light in stack.lights if light.panel == Panel.E)
    np.testing.assert_allclose(east.axis, (-math.sin(SLANT), 0, -math.cos(SLANT)), atol=1e-12)
    assert four.camera_geometry is None
    four.close()
    assert four.source_stack is None


def test_modes_and_ambient(near):
    near.arm([0.004] * 3, panels=[(Mode.DARK_FIELD, Panel.W), (Mode.BRIGHT_FIELD, Panel.W),
                                  (Mode.BRIGHT_FIELD, Panel.NONE)])
    assert [int(frame.image.mean()) for frame in near.collect(3, 0.0)] == [23, 21, 3]
    near.arm([0.004] * 2)       # none asked for: in the order of the folder
    assert [int(frame.image.mean()) for frame in near.collect(2, 0.0)] == [20, 21]


def test_missing_pictures_are_named(four, near):
    with pytest.raises(PsError, match='no picture of panel DARK_FIELD E') as missing:
        four.arm([0.004], panels=[(Mode.DARK_FIELD, Panel.E)])
    assert missing.value.code == ErrorCode.SEQUENCER_BAD_REQUEST
    assert 'BRIGHT_FIELD N' in missing.value.message
    with pytest.raises(PsError, match=r'BRIGHT_FIELD N; .*ambient \(NONE\)'):
        near.arm([0.004], panels=bright('N'))
    with pytest.raises(PsError, match='5 frames asked for, but it has 4'):
        four.arm([0.004] * 5)


def test_folders_that_cannot_be_played(tmp_path):
    with pytest.raises(PsError, match='no such folder'):
        FolderCamera(tmp_path / 'nowhere', SLANT).open()
    for i in range(3):      # the benchmark's layout: directions, but no panels
        cv2.imwrite(str(tmp_path / f'{i}.png'), np.zeros((6, 8), np.uint8))
    (tmp_path / 'filenames.txt').write_text('0.png\n1.png\n2.png\n')
    (tmp_path / 'light_directions.txt').write_text('0 0 1\n0 0.6 0.8\n0.6 0 0.8\n')
    with pytest.raises(PsError, match='none of its pictures belongs to a panel'):
        FolderCamera(tmp_path, SLANT).open()
    with pytest.raises(PsError, match='not open'):
        FolderCamera(tmp_path, SLANT).arm([0.004])


@pytest.mark.skipif(not (DATA / 'metal_disc').is_dir(), reason='no data: metal_disc')
def test_real_pictures():
    with FolderCamera(DATA / 'metal_disc', SLANT) as camera:
        camera.arm([0.004] * 4, panels=bright('E', 'N', 'W', 'S'))
        frames = camera.collect(4, 0.0)
        assert len(camera.source_stack.gain_maps) == 4
    for i, frame in enumerate(frames):
        assert frame.image.shape[:2] == (3684, 4912)
        assert not any(np.array_equal(frame.image, other.image) for other in frames[:i])
