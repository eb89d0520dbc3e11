"""Camera back ends by name."""
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ps_head_driver.cameras.base import Camera
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.head_model import HeadModel, load_head

CAMERAS = ('fake', 'folder', 'topic', 'genicam')


@dataclass(frozen=True)
class CameraSettings:
    """What a back end may need.

    :param node: the rclpy node, for back ends that use topics.
    :param parameters: of camera_sequencer.
    """

    node: Any
    head: HeadModel
    parameters: Mapping[str, Any]


def make_camera(name: str, settings: CameraSettings) -> Camera:
    """Make the back end of that name; it is not opened yet.

    :raises PsError: SEQUENCER_BAD_REQUEST for an unknown name or settings it cannot work with.
    """
    parameters = settings.parameters
    # each back end is imported only when asked for: a plant with a real camera needs no renderer
    if name == 'fake':
        from ps_head_driver.cameras.fake import FakeCamera
        from ps_head_driver.fake.trigger_socket import default_path
        true_head = parameters['true_head_file']
        return FakeCamera(
            head=load_head(true_head) if true_head else settings.head, scene=parameters['scene'],
            trigger_socket=parameters['trigger_socket']
            or default_path(settings.node.get_namespace()),
            scale=parameters['scale'], bit_depth=parameters['bit_depth'],
            noise=parameters['noise'], seed=parameters['seed'])
    if name == 'folder':
        from ps_head_driver.cameras.folder import FolderCamera
        if not parameters['input_folder']:
            raise PsError(ErrorCode.SEQUENCER_BAD_REQUEST,
                          'parameter input_folder: empty; camera folder needs pictures to play')
        return FolderCamera(parameters['input_folder'], slant=parameters['slant'])
    if name == 'topic':
        from ps_head_driver.cameras.topic import TopicCamera
        return TopicCamera(settings.node, parameters['image_topic'],
                           settings.head.camera.camera_standoff,
                           parameters['significant_bits'])
    if name == 'genicam':
        from ps_head_driver.cameras.genicam import GenicamCamera
        return GenicamCamera(parameters['camera_id'], parameters['trigger_line'],
                             parameters['pixel_format'])
    raise PsError(ErrorCode.SEQUENCER_BAD_REQUEST,
                  f'parameter camera: {name!r} is not one of {", ".join(CAMERAS)}')
