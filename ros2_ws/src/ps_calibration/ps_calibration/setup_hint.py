"""How far a target lies from where it should: what to tell who sets it up."""
from dataclasses import dataclass
import math

from ps_calibration.detection import find_dots
from ps_calibration.ring_pictures import light_only
from ps_calibration.ring_target import RingTarget
from ps_calibration.target_pose import fit_pose
from ps_head_driver.head_model import CameraGeometry
from ps_head_driver.stack import Stack

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


def setup_hint(stack: Stack, target: RingTarget, camera: CameraGeometry) -> SetupHint:
    """Where the target is, from the picture with all panels on.

    :param stack: frames E, N, W, S, ALL and NONE.
    :param camera: for pictures of this size.
    :raises PsError: CALIBRATION_CAPTURE_FAILED for pictures that cannot be used, or
        CALIBRATION_TARGET_NOT_FOUND, with what to do; CALIBRATION_BAD_REQUEST if a frame is
        missing.
    """
    *_, picture = light_only(stack)
    pose = fit_pose(find_dots(picture, target, camera), target, camera)
    x, y, _, turn, tilt_x, tilt_y = (float(number) for number in pose.numbers)
    return SetupHint((-x, -y), -turn, (tilt_x, tilt_y))
