"""Reconstruction to messages: the only module of this package that knows both."""
import math
from typing import Any

from sensor_msgs.msg import CameraInfo, Image

from ps_head_driver.conversions import image_to_message
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.frames import plane_to_optical
from ps_head_driver.stack import Geometry
from ps_interfaces import msg as ps
from ps_reconstruction.pipeline import Reconstruction

# quantity: topic of its images
IMAGE_TOPICS = {
    'slope': 'slope/image', 'normal': 'normal/image', 'albedo': 'albedo/image',
    'height': 'height/image', 'curvature': 'curvature/image', 'shape': 'shape/image',
    'confidence': 'confidence/image', 'reason': 'reason/image', 'preview': 'normal/preview'}


def quantity_to_message(result: Reconstruction, quantity: str, header: Any) -> Image:
    """Image of one quantity of IMAGE_TOPICS, under the stack's header.

    Normals are turned into the optical frame; slopes stay (p, q) in ps_head_plane axes.
    """
    values = getattr(result, quantity)
    if quantity == 'normal':
        values = plane_to_optical(values)
    return image_to_message(values, header)


def camera_info_of(stack: ps.PhotometricStack) -> CameraInfo:
    """Intrinsics of every output: those of the stack, under its header."""
    info: CameraInfo = stack.camera_info
    info.header = stack.header
    if info.height == 0 and stack.images:
        info.height, info.width = stack.images[0].height, stack.images[0].width
    return info


def info_to_message(
    stack: ps.PhotometricStack, result: Reconstruction | None, error: PsError | None,
    method: str, dropped: int,
) -> ps.ReconstructionInfo:
    """What became of a stack.

    :param result: None if it failed with ``error``.
    """
    message = ps.ReconstructionInfo(
        header=stack.header, stack_id=stack.stack_id, part_id=stack.part_id,
        calibration_id=stack.calibration_id, geometry=stack.geometry, method=method,
        calibrated=stack.geometry == int(Geometry.CALIBRATED), dropped_stacks=dropped,
        success=error is None, error_code=int(error.code if error else ErrorCode.NONE),
        message=error.message if error else 'ok',
        residual_rms=math.nan, roughness_sa=math.nan, roughness_sq=math.nan,
        roughness_sdq=math.nan, roughness_sdr=math.nan)
    if result is not None:
        message.near_field = result.near_field
        message.valid_fraction = result.valid_fraction
        message.residual_rms = result.residual_rms
        for name in ('sa', 'sq', 'sdq', 'sdr'):
            setattr(message, f'roughness_{name}', getattr(result.roughness, name))
        message.durations = [ps.StageDuration(stage=stage, duration=duration)
                             for stage, duration in result.timings.items()]
    return message
