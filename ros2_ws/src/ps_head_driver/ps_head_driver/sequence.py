"""The trigger sequence: from a recipe to strobe programs, and from frames and strobes to a stack.

A frame is given to a light by counters and device times, never by the order of arrival. A stack
is assembled whole and right, or not at all.
"""
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

from ps_head_driver.cameras.base import Frame
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.recipes import Recipe, Step
from ps_head_driver.stack import Light, Mode, Panel

# ---------------------------------------------------------------------------- plan

@dataclass(frozen=True)
class Shot:
    """One triggered frame to take.

    :param light: place of its light in the stack; the frames of a bracket share it.
    :param exposure: s.
    :param gain: dB.
    """

    light: int
    mode: Mode
    panel: Panel
    intensity: float
    exposure: float
    gain: float


@dataclass(frozen=True)
class Program:
    """Shots that the board takes in one go: one position of the panels, one camera setting."""

    convergence_radius: float     # m; 0: stay where the head is
    shots: tuple[Shot, ...]


def plan(recipe: Recipe, default_exposure: float, default_gain: float = 0.0) -> list[Program]:
    """Split a recipe into strobe programs.

    A new program begins where CR changes, and where exposure or gain do: a camera cannot change
    them between two triggers of a running program. An ambient frame comes last.

    :param default_exposure: for steps and recipes that state none, s.
    :param default_gain: for steps that state none, dB.
    """
    steps = list(recipe.steps)
    if recipe.ambient:
        steps.append(steps[-1].model_copy(
            update={'mode': 'BRIGHT_FIELD', 'panel': 'NONE', 'intensity': 0.0}))

    def shot(light: int, step: Step, factor: float) -> Shot:
        return Shot(light, Mode[step.mode], Panel[step.panel], step.intensity,
                    factor * recipe.exposure_of(step, default_exposure),
                    step.gain or default_gain)

    programs = []
    for radius, here in groupby(enumerate(steps), key=lambda item: item[1].convergence_radius):
        group = list(here)
        shots = [shot(*item, factor) for factor in sorted(recipe.bracket or [1.0])
                 for item in group]
        for _, same in groupby(shots, key=lambda one: (one.exposure, one.gain)):
            programs.append(Program(radius, tuple(same)))
            radius = 0.0      # the next ones find the head there
    return programs


# ---------------------------------------------------------------------------- match

def match(frames: Sequence[Frame], lights: Sequence[Light], tolerance: float) -> list[Frame]:
    """Give every strobe its frame.

    Counters of camera and board must advance together; where the camera reports device times, the
    times between frames must equal the times between strobes.

    :param frames: as they arrived, any order.
    :param lights: of one strobe program, in the order of the program.
    :param tolerance: of the times between frames, s.
    :returns: one frame per light, in the order of the lights.
    :raises PsError: SEQUENCER_FRAME_MISSING or _FRAME_MISMATCH, with the trigger concerned.
    """
    ordered = sorted(frames, key=lambda frame: frame.frame_counter)
    counters = [frame.frame_counter for frame in ordered]
    if len(set(counters)) < len(counters):
        twice = next(c for c in counters if counters.count(c) > 1)
        raise PsError(ErrorCode.SEQUENCER_FRAME_MISMATCH, f'frame {twice} arrived twice')
    if len(ordered) < len(lights):
        raise PsError(ErrorCode.SEQUENCER_FRAME_MISSING,
                      f'{len(lights)} triggers, but {len(ordered)} frames came'
                      + _first_gap(ordered, lights))
    if len(ordered) > len(lights):
        raise PsError(ErrorCode.SEQUENCER_FRAME_MISMATCH,
                      f'{len(lights)} triggers, but {len(ordered)} frames came')
    for i, (frame, light) in enumerate(zip(ordered, lights, strict=True)):
        if frame.frame_counter - counters[0] != light.strobe_counter - lights[0].strobe_counter:
            raise PsError(ErrorCode.SEQUENCER_FRAME_MISMATCH,
                          f'frame {frame.frame_counter} stands where strobe '
                          f'{light.strobe_counter} was: a frame was lost in between')
        if frame.trigger_counter is not None and frame.trigger_counter != light.strobe_counter:
            raise PsError(ErrorCode.SEQUENCER_FRAME_MISMATCH,
                          f'frame {frame.frame_counter} belongs to trigger '
                          f'{frame.trigger_counter}, not to {light.strobe_counter}')
        first = ordered[0]
        if frame.device_time_ns is not None and first.device_time_ns is not None:
            camera = (frame.device_time_ns - first.device_time_ns) * 1e-9
            board = (light.device_time_ns - lights[0].device_time_ns) * 1e-9
            if abs(camera - board) > tolerance:
                raise PsError(ErrorCode.SEQUENCER_FRAME_MISMATCH,
                              f'frame {i + 1} came {camera * 1e3:.2f} ms after the first, its '
                              f'strobe {board * 1e3:.2f} ms: the frame belongs to another strobe')
    return ordered


def _first_gap(frames: Sequence[Frame], lights: Sequence[Light]) -> str:
    known = {frame.trigger_counter for frame in frames if frame.trigger_counter is not None}
    lost = [light.name for light in lights if known and light.strobe_counter not in known]
    return f'; missing: {", ".join(lost)}' if lost else ''


def check_images(frames: Sequence[Frame]) -> None:
    """Refuse frames that cannot form one stack.

    :raises PsError: SEQUENCER_BAD_IMAGE if shapes or types differ.
    """
    first = frames[0].image
    for i, frame in enumerate(frames):
        if frame.image.shape != first.shape or frame.image.dtype != first.dtype:
            raise PsError(ErrorCode.SEQUENCER_BAD_IMAGE,
                          f'frame {i + 1} is {frame.image.shape} {frame.image.dtype}, the first '
                          f'is {first.shape} {first.dtype}')
