"""Messages to plain data and back: the only module of this package that knows both."""
from array import array
from collections.abc import Callable
import math
from typing import Any, TypeVar

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, PoseStamped, Quaternion, TransformStamped, Vector3
import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, Image

from ps_head_driver.calibration_file import (
    HeadCalibration,
    MotorCorrection,
    PanelCorrection,
    Verdict,
    apply,
)
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.frames import OPTICAL_FRAME, PLANE_FRAME
from ps_head_driver.head_frames import Transform, static_transforms
from ps_head_driver.head_model import CameraGeometry, HeadModel
from ps_head_driver.pixel_formats import demosaic
from ps_head_driver.stack import (
    Geometry,
    Light,
    Mode,
    Panel,
    Plane,
    Pose,
    Stack,
    Vector,
    with_exposure_scale,
)
from ps_interfaces import msg as ps

T = TypeVar('T')

# encoding: (dtype, channels)
ENCODINGS: dict[str, tuple[str, int]] = {
    'mono8': ('u1', 1), 'mono16': ('u2', 1), 'rgb8': ('u1', 3), 'rgb16': ('u2', 3),
    'bgr8': ('u1', 3), 'bgr16': ('u2', 3), '8UC1': ('u1', 1), '16UC1': ('u2', 1),
    '32FC1': ('f4', 1), '32FC2': ('f4', 2), '32FC3': ('f4', 3),
    **{f'bayer_{order}{bits}': (f'u{bits // 8}', 1)
       for order in ('rggb', 'bggr', 'gbrg', 'grbg') for bits in (8, 16)},
}


# ---------------------------------------------------------------------------- images

def image_to_message(image: NDArray, header: Any = None, encoding: str = '') -> Image:
    """Array to Image.

    :param image: (H, W) or (H, W, C); uint8, uint16 or float32; three channels of integers are
        RGB.
    :param encoding: overrides the one that follows from dtype and channels.
    """
    channels = 1 if image.ndim == 2 else image.shape[2]
    if not encoding:
        for candidate in ('mono8', 'mono16', 'rgb8', 'rgb16', '32FC1', '32FC2', '32FC3'):
            if ENCODINGS[candidate] == (image.dtype.str[1:], channels):
                encoding = candidate
                break
        else:
            raise ValueError(f'no image encoding for {image.dtype} with {channels} channels')
    message = Image(height=image.shape[0], width=image.shape[1], encoding=encoding,
                    step=image.shape[1] * channels * image.itemsize)
    if header is not None:
        message.header = header
    # array.frombytes is one memory copy; assigning an ndarray or list converts element by element
    data = array('B')
    data.frombytes(np.ascontiguousarray(image).data.cast('B'))
    message.data = data
    return message


def message_to_image(message: Image) -> NDArray:
    """Image to array: (H, W) or (H, W, C); RGB order; a view of the message where the layout
    allows it.

    :raises PsError: SEQUENCER_BAD_IMAGE for an encoding or size that cannot be used.
    """
    if message.encoding not in ENCODINGS:
        raise PsError(ErrorCode.SEQUENCER_BAD_IMAGE,
                      f'image encoding {message.encoding!r} is not supported; use one of '
                      + ', '.join(ENCODINGS))
    dtype_name, channels = ENCODINGS[message.encoding]
    dtype = np.dtype(('>' if message.is_bigendian else '<') + dtype_name)
    row = message.width * channels * dtype.itemsize
    if message.step < row or len(message.data) < message.step * message.height:
        raise PsError(ErrorCode.SEQUENCER_BAD_IMAGE,
                      f'image of {message.width} x {message.height} {message.encoding} has '
                      f'{len(message.data)} bytes in steps of {message.step}')
    rows = np.frombuffer(message.data, np.uint8, message.step * message.height)
    rows = rows.reshape(message.height, message.step)[:, :row]
    image = np.ascontiguousarray(rows).view(dtype).reshape(message.height, message.width, channels)
    if message.is_bigendian and dtype.itemsize > 1:
        image = image.astype(dtype.newbyteorder('<'))
    if channels == 1:
        image = image[..., 0]
    if message.encoding.startswith('bgr'):
        return image[..., ::-1]
    if message.encoding.startswith('bayer'):
        return demosaic(image, message.encoding[6:10])
    return image


# ---------------------------------------------------------------------------- small things

def vector_to_message(vector: Any) -> Vector3:
    """(3,) to Vector3."""
    x, y, z = map(float, vector)
    return Vector3(x=x, y=y, z=z)


def _tuple(message: Any) -> Vector:
    return (message.x, message.y, message.z)


def time_to_message(stamp_ns: int) -> Time:
    """Nanoseconds since the epoch to Time."""
    return Time(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)


def time_to_ns(time: Time) -> int:
    """Time to nanoseconds since the epoch."""
    return int(time.sec) * 10**9 + int(time.nanosec)


def camera_to_message(camera: CameraGeometry) -> CameraInfo:
    """CameraGeometry to CameraInfo (plumb_bob)."""
    info = CameraInfo(width=camera.width_px, height=camera.height_px, distortion_model='plumb_bob')
    info.header.frame_id = OPTICAL_FRAME
    info.d = list(camera.distortion)
    info.k = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    info.r = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    info.p = [camera.fx, 0.0, camera.cx, 0.0, 0.0, camera.fy, camera.cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    return info


def message_to_camera(info: CameraInfo, standoff: float) -> CameraGeometry | None:
    """CameraInfo to CameraGeometry; None if it holds no calibration (focal length 0, as
    sensor_msgs says).

    :raises PsError: SEQUENCER_BAD_IMAGE if the distortion model is not plumb_bob.
    """
    if info.k[0] <= 0 or info.k[4] <= 0:
        return None
    if info.distortion_model not in ('', 'plumb_bob'):
        raise PsError(ErrorCode.SEQUENCER_BAD_IMAGE,
                      f'camera_info: distortion model {info.distortion_model!r} is not supported; '
                      'use plumb_bob')
    d = (list(info.d) + [0.0] * 5)[:5]
    return _checked(ErrorCode.SEQUENCER_BAD_IMAGE, 'camera_info', lambda: CameraGeometry(
        width_px=info.width, height_px=info.height, fx=info.k[0], fy=info.k[4], cx=info.k[2],
        cy=info.k[5], distortion=(d[0], d[1], d[2], d[3], d[4]), camera_standoff=standoff))


def _checked(code: ErrorCode, what: str, make: Callable[[], T]) -> T:
    """Make a validated object; a message with impossible values becomes one line."""
    try:
        return make()
    except (ValueError, OverflowError) as error:
        raise PsError(code, f'{what}: {" ".join(str(error).split())}') from error


# ---------------------------------------------------------------------------- lights

def light_to_message(light: Light) -> ps.LightState:
    """Light to LightState; per-channel intensities become their mean."""
    intensity = light.intensity
    return ps.LightState(
        name=light.name, mode=int(light.mode), panel=int(light.panel),
        motor_counts=light.motor_counts, tilt=light.tilt, distant=light.distant,
        position=Point(**dict(zip('xyz', map(float, light.position), strict=True))),
        axis=vector_to_message(light.axis), right=vector_to_message(light.right),
        panel_size=np.array(light.size, np.float64), lobe_exponent=light.lobe_exponent,
        intensity=float(np.mean(intensity)), strobe_duration=light.strobe_duration,
        exposure_time=light.exposure_time, gain=light.gain, strobe_counter=light.strobe_counter,
        frame_counter=light.frame_counter, device_time_ns=light.device_time_ns)


def message_to_light(message: ps.LightState) -> Light:
    """LightState to Light; ``exposure_scale`` is set by message_to_stack, which sees all
    frames.
    """
    try:
        mode, panel = Mode(message.mode), Panel(message.panel)
    except ValueError as error:
        raise PsError(ErrorCode.RECONSTRUCTION_BAD_STACK, f'lights: {error}') from error
    return Light(
        name=message.name, mode=mode, panel=panel, motor_counts=message.motor_counts,
        tilt=message.tilt, distant=message.distant, position=_tuple(message.position),
        axis=_tuple(message.axis), right=_tuple(message.right),
        size=(float(message.panel_size[0]), float(message.panel_size[1])),
        lobe_exponent=message.lobe_exponent, intensity=message.intensity,
        strobe_duration=message.strobe_duration, exposure_time=message.exposure_time,
        gain=message.gain, strobe_counter=message.strobe_counter,
        frame_counter=message.frame_counter, device_time_ns=message.device_time_ns)


# ---------------------------------------------------------------------------- the stack

def stack_to_message(stack: Stack) -> ps.PhotometricStack:
    """Stack to PhotometricStack."""
    message = ps.PhotometricStack(
        stack_id=stack.stack_id, session_id=stack.session_id, part_id=stack.part_id,
        calibration_id=stack.calibration_id, flat_id=stack.flat_id, geometry=int(stack.geometry),
        plane_normal=vector_to_message(stack.plane.normal), plane_offset=stack.plane.offset,
        convergence_radius=stack.convergence_radius, light_height=stack.light_height)
    message.header.stamp = time_to_message(stack.stamp_ns)
    message.header.frame_id = OPTICAL_FRAME
    header = message.header
    if stack.camera is not None:
        message.camera_info = camera_to_message(stack.camera)
        message.camera_standoff = stack.camera.camera_standoff
    else:
        message.camera_info.height, message.camera_info.width = stack.shape
    message.camera_info.header = header
    message.images = [image_to_message(image, header) for image in stack.images]
    message.lights = [light_to_message(light) for light in stack.lights]
    message.gain_maps = [image_to_message(gain, header) for gain in stack.gain_maps]
    if stack.ambient is not None:
        message.ambient = image_to_message(stack.ambient, header)
    if stack.mask is not None:
        message.mask = image_to_message(stack.mask.astype(np.uint8) * 255, header)
    message.head_pose = pose_to_message(stack.head_pose)
    return message


def message_to_stack(message: ps.PhotometricStack) -> Stack:
    """PhotometricStack to Stack.

    :raises PsError: RECONSTRUCTION_BAD_STACK or SEQUENCER_BAD_IMAGE naming the field.
    """
    bad = ErrorCode.RECONSTRUCTION_BAD_STACK
    if not message.images:
        raise PsError(bad, 'images: the stack is empty')
    for name, items in (('lights', message.lights), ('gain_maps', message.gain_maps)):
        if len(items) != len(message.images) and (items or name == 'lights'):
            raise PsError(bad, f'{name}: {len(items)} entries for {len(message.images)} images')
    images = [message_to_image(image) for image in message.images]
    for i, image in enumerate(images):
        if image.shape != images[0].shape or image.dtype != images[0].dtype:
            raise PsError(bad, f'images[{i}] is {image.shape} {image.dtype}, images[0] is '
                               f'{images[0].shape} {images[0].dtype}')
    ambient = message_to_image(message.ambient) if message.ambient.height else None
    mask = message_to_image(message.mask) > 0 if message.mask.height else None
    for name, extra in (('ambient', ambient), ('mask', mask)):
        if extra is not None and extra.shape[:2] != images[0].shape[:2]:
            raise PsError(bad, f'{name} is {extra.shape}, images are {images[0].shape}')
    try:
        geometry = Geometry(message.geometry)
    except ValueError as error:
        raise PsError(bad, f'geometry: {error}') from error
    pose = message.head_pose
    lights = [message_to_light(m) for m in message.lights]
    # a gain of thousands of dB
    lights = _checked(bad, 'lights', lambda: with_exposure_scale(lights))
    return Stack(
        images=images, lights=lights,
        camera=message_to_camera(message.camera_info, message.camera_standoff),
        ambient=ambient, mask=mask, gain_maps=[message_to_image(m) for m in message.gain_maps],
        plane=Plane(_tuple(message.plane_normal), message.plane_offset), geometry=geometry,
        stack_id=message.stack_id, session_id=message.session_id, part_id=message.part_id,
        calibration_id=message.calibration_id, flat_id=message.flat_id,
        stamp_ns=time_to_ns(message.header.stamp), head_pose=message_to_pose(pose),
        convergence_radius=message.convergence_radius, light_height=message.light_height)


def pose_to_message(pose: Pose) -> PoseStamped:
    """Pose to PoseStamped."""
    message = PoseStamped()
    message.header.frame_id = pose.frame_id
    message.pose.position = Point(**dict(zip('xyz', map(float, pose.position), strict=True)))
    x, y, z, w = map(float, pose.quaternion)
    message.pose.orientation = Quaternion(x=x, y=y, z=z, w=w)
    return message


def message_to_pose(message: PoseStamped) -> Pose:
    """PoseStamped to Pose."""
    q = message.pose.orientation
    return Pose(message.header.frame_id, _tuple(message.pose.position), (q.x, q.y, q.z, q.w))


# ---------------------------------------------------------------------------- calibration

def transform_to_message(transform: Transform) -> TransformStamped:
    """Transform to TransformStamped, without a stamp: it is valid at all times."""
    message = TransformStamped(child_frame_id=transform.child)
    message.header.frame_id = transform.parent
    message.transform.translation = vector_to_message(transform.xyz)
    x, y, z, w = transform.quaternion()
    message.transform.rotation = Quaternion(x=x, y=y, z=z, w=w)
    return message


def calibration_to_message(
    calibration: HeadCalibration | None, head: HeadModel,
) -> ps.HeadCalibration:
    """HeadCalibration to its message; None becomes the empty one (nominal geometry).

    :param head: as designed; what it says about the mounting face holds for every calibration.
    """
    message = ps.HeadCalibration()
    message.header.frame_id = PLANE_FRAME
    message.plane_normal.z = 1.0
    message.z_scale = message.motor_scale = 1.0
    message.transforms = [
        transform_to_message(each) for each in static_transforms(apply(head, calibration))]
    if calibration is None:
        return message
    message.calibration_id = calibration.calibration_id
    message.created = time_to_message(int(calibration.created.timestamp() * 1e9))
    message.header.stamp = message.created
    message.head_serial = calibration.head_serial
    message.camera_info = camera_to_message(calibration.camera)
    message.camera_standoff = calibration.camera.camera_standoff
    message.plane_normal = vector_to_message(calibration.plane_normal)
    message.plane_offset = calibration.plane_offset
    message.backlash_counts = calibration.backlash_counts
    message.motor_offset_counts = calibration.motor.offset_counts
    message.motor_scale = calibration.motor.scale
    message.crank_offset = calibration.motor.crank_offset
    message.z_scale = calibration.z_scale
    message.verdict = getattr(ps.HeadCalibration, f'VERDICT_{calibration.verdict}')
    message.verdict_reason = calibration.verdict_reason
    message.target_name = calibration.target_name
    message.panels = [
        ps.PanelCalibration(
            name=name, shift=vector_to_message(panel.shift), tilt_offset=panel.tilt_offset,
            twist=panel.twist, intensity=panel.intensity,
            shadow_residual_px=math.nan if panel.shadow_residual_px is None
            else panel.shadow_residual_px)
        for name, panel in calibration.panels.items()]
    return message


def message_to_calibration(message: ps.HeadCalibration) -> HeadCalibration | None:
    """Message to HeadCalibration; None for the empty one."""
    if not message.calibration_id:
        return None
    from datetime import UTC, datetime
    camera = message_to_camera(message.camera_info, message.camera_standoff)
    if camera is None:
        raise PsError(ErrorCode.CALIBRATION_BAD_REQUEST, 'calibration: camera_info is empty')
    verdicts: dict[int, Verdict] = {
        ps.HeadCalibration.VERDICT_OK: 'OK', ps.HeadCalibration.VERDICT_POOR: 'POOR'}
    return _checked(ErrorCode.CALIBRATION_BAD_REQUEST, 'calibration', lambda: HeadCalibration(
        calibration_id=message.calibration_id,
        created=datetime.fromtimestamp(time_to_ns(message.created) / 1e9, UTC),
        head_serial=message.head_serial, camera=camera,
        plane_normal=_tuple(message.plane_normal), plane_offset=message.plane_offset,
        panels={p.name: PanelCorrection(
            shift=_tuple(p.shift), tilt_offset=p.tilt_offset, twist=p.twist, intensity=p.intensity,
            shadow_residual_px=None if math.isnan(p.shadow_residual_px) else p.shadow_residual_px)
            for p in message.panels},
        backlash_counts=message.backlash_counts, z_scale=message.z_scale,
        motor=MotorCorrection(offset_counts=message.motor_offset_counts,
                              scale=message.motor_scale, crank_offset=message.crank_offset),
        verdict=verdicts.get(message.verdict, 'FAILED'), verdict_reason=message.verdict_reason,
        target_name=message.target_name))
