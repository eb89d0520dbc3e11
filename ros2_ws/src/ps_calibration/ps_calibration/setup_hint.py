"""How far a target lies from where it should: what to tell who sets it up."""
from dataclasses import dataclass
import math

import numpy as np

from ps_calibration.detection import find_dots
from ps_calibration.ring_target import RingTarget
from ps_calibration.target_pose import fit_pose
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.stack import Panel, Stack

# a target this well in place needs no attention
_NEAR, _TURNED = 0.002, math.radians(5)


@dataclass(frozen=True)
class SetupHint:
    """What would centre the target.

    :param shift: move the target by this much along x and y of ps_head_plane, m.
    :param turn: and turn it about z by this much, rad.
    :param tilt: turn the head about x and y by this much, rad.
    """

    shift: tuple[float, float]
    turn: float
    tilt: tuple[float, float]

    @property
    def text(self) -> str:
        """One line for people."""
        tilt = math.degrees(math.hypot(*self.tilt))
        if math.hypot(*self.shift) <= _NEAR and abs(self.turn) <= _TURNED:
            return f'the target is in place; the plane is tilted by {tilt:.1f} degrees'
        x, y = self.shift
        return (f'better: move the target by {x * 1e3:+.1f} mm in x and {y * 1e3:+.1f} mm in y, '
                f'turn it by {math.degrees(self.turn):+.1f} degrees; the plane is tilted by '
                f'{tilt:.1f} degrees')


def setup_hint(stack: Stack, target: RingTarget) -> SetupHint:
    """Where the target is, from the picture with all panels on.

    :param stack: with the frames ALL and NONE, and its camera.
    :raises PsError: CALIBRATION_TARGET_NOT_FOUND; CALIBRATION_BAD_REQUEST without camera or frame.
    """
    frames = {light.panel: image for light, image in zip(stack.lights, stack.images, strict=True)}
    if stack.camera is None or not {Panel.ALL, Panel.NONE} <= set(frames):
        raise PsError(ErrorCode.CALIBRATION_BAD_REQUEST,
                      'the pictures have no camera intrinsics, or ALL or NONE is missing')
    picture = frames[Panel.ALL].astype(np.float32) - frames[Panel.NONE].astype(np.float32) / 4
    pose = fit_pose(find_dots(picture, target, stack.camera), target, stack.camera)
    x, y, _, turn, tilt_x, tilt_y = (float(number) for number in pose.numbers)
    return SetupHint((-x, -y), -turn, (tilt_x, tilt_y))
