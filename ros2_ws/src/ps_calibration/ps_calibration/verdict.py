"""When to believe a fit, and what to tell who has to mend what is wrong."""
import math

import numpy as np
from numpy.typing import NDArray

from ps_calibration.ring_fit import RingFit
from ps_calibration.ring_target import RingTarget
from ps_head_driver.head_model import DIRECTIONS

_FAILED_RMS, _POOR_RMS = 0.02, 0.006     # of the shares of light
_UNLIKELY = 1.7          # corrections, relative to the tolerances they were given
_Z_SCALE = 0.03, 0.06    # of the wall's height: doubtful, and certainly another target
_Z_DOUBT = 0.006         # of it: lights would be off by 0.2 degrees
_Z_NOISE = 4             # standard deviations of the height, below which nothing is said
_TURN = 0.3              # degrees of the lights for 1 % of the wall's height
_NO_WALL = 0.4           # of the wall's height, below which there is none
_BLOCKED = 0.6           # of a slit
_SOFT = 3.0              # of the pictures, see RingFit.softness: it should be about 1
_LIMIT = np.array([0.006, 0.006, 0.006, 0.07, 0.07, 0.25])


def out_of_place(panel: NDArray) -> bool:
    """Whether corrections, the first of _LIMIT, are beyond what any mounting explains."""
    return bool(np.any(abs(panel) > _LIMIT[:len(panel)] * _UNLIKELY))


def _rms(fit: RingFit) -> float:
    return max(float(np.sqrt(np.mean(r**2))) for r in fit.residuals)


def judge(fit: RingFit, free: RingFit, target: RingTarget, blocked: NDArray) -> tuple[str, str]:
    """The most specific reason that the fits give.

    :param free: the fit with a free height of the wall.
    :param blocked: of each slit, see blocked_slits.
    """
    rms, height = _rms(fit), free.height / target.height
    if height < _NO_WALL:
        return 'FAILED', ('no shadows of the wall are seen; is the half ring missing from its '
                          'plate, or a lower one?')
    if blocked.max() > _BLOCKED and rms < _FAILED_RMS:
        azimuth = math.degrees(target.slits.azimuths[int(blocked.argmax())])
        return 'FAILED', (f'the slit at {azimuth:.0f} degrees lets no light through; clean it, or '
                          'check the target file')
    if abs(height - 1) > _Z_SCALE[0] and _rms(free) < max(0.8 * rms, _POOR_RMS):
        certain = rms > _FAILED_RMS or abs(height - 1) > _Z_SCALE[1]
        return ('FAILED' if certain else 'POOR'), (
            f'{_other_height(free, height)}; is it the right target and file, and is the plate '
            'matt?')
    if rms > _FAILED_RMS:
        return 'FAILED', (f'the shadows do not fit this target (residual {rms:.3f}); is it '
                          'another ring than the target file says, or damaged?')
    beyond = [out_of_place(panel) for panel in fit.panels]
    if any(beyond):
        name = DIRECTIONS[beyond.index(True)]
        return 'FAILED', (f'panel {name} would be far out of its place; is it another ring than '
                          'the target file says? if not, check the mounting of the panel')
    if rms > _POOR_RMS:
        return 'POOR', (f'the shadows fit badly (residual {rms:.3f}); clean the target, keep '
                        'other light away, and check that it is the one of the target file')
    if fit.softness > _SOFT:
        return 'POOR', ('the pictures are blurred; focus the camera and see that nothing '
                        'vibrates')
    if abs(height - 1) > max(_Z_DOUBT, _Z_NOISE * free.height_deviation / target.height):
        return 'POOR', (f'{_other_height(free, height)}; measure the wall (a rounded upper edge '
                        'counts as missing height), correct the file and see that the plate is '
                        f'matt: the lights may be off by {_TURN * abs(height - 1) * 100:.1f} '
                        'degrees')
    return 'OK', ''


def _other_height(free: RingFit, height: float) -> str:
    return (f'the wall seems to be {100 * abs(height - 1):.1f} % '
            f'{"higher" if height > 1 else "lower"} than the target file says (fitted '
            f'{1e3 * free.height:.3f} mm)')
