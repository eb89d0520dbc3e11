"""What an inspection may ask for."""
from typing import Any

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.stack import Mode
from ps_reconstruction.pipeline import OUTPUTS

QUANTITIES = tuple(name for name in OUTPUTS if name not in ('preview', 'roughness'))
AS_IS, GIVEN, SEARCH = 0, 1, 2      # as in Inspect.action


def check_request(request: Any) -> None:
    """Check a goal of the action Inspect.

    :raises PsError: INSPECTION_BAD_REQUEST naming the field.
    """
    wrong = ''
    if request.illumination not in (AS_IS, GIVEN, SEARCH):
        wrong = f'illumination: {request.illumination} is not AS_IS, GIVEN or SEARCH'
    elif request.recipe and request.illumination != AS_IS:
        wrong = 'recipe: states its own lights; use it with illumination AS_IS'
    elif request.ambient_frame and request.illumination == AS_IS:
        wrong = 'ambient_frame: with AS_IS the recipe says it'
    elif request.exposure_time and request.illumination == AS_IS:
        wrong = 'exposure_time: with AS_IS the recipe says it'
    elif request.mode not in (Mode.BRIGHT_FIELD, Mode.DARK_FIELD):
        wrong = f'mode: {request.mode} is not BRIGHT_FIELD (0) or DARK_FIELD (1)'
    elif not 0 <= request.convergence_radius < 10:
        wrong = f'convergence_radius: {request.convergence_radius} m must be 0 or a length'
    elif not 0 <= request.exposure_time <= 10:
        wrong = f'exposure_time: {request.exposure_time} s must be 0 to 10'
    elif set(request.outputs) - set(QUANTITIES):
        wrong = (f'outputs: {", ".join(sorted(set(request.outputs) - set(QUANTITIES)))}: not '
                 f'among {", ".join(QUANTITIES)}')
    if wrong:
        raise PsError(ErrorCode.INSPECTION_BAD_REQUEST, wrong)
