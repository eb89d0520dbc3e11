"""The trigger sequence: from a recipe to strobe programs, and from frames and strobes to a stack.

A frame is given to a light by counters and device times, never by the order of arrival. A stack
is assembled whole and right, or not at all.
"""
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from ps_head_driver.cameras.base import Frame
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.head_model import parse_yaml, read_yaml
from ps_head_driver.stack import Light, Mode, Panel

ModeName = Literal['BRIGHT_FIELD', 'DARK_FIELD', 'BOTH']
PanelName = Literal['E', 'N', 'W', 'S', 'ALL', 'NONE']


# ---------------------------------------------------------------------------- recipes

class Step(BaseModel):
    """One light of a recipe."""

    model_config = ConfigDict(extra='forbid', frozen=True, allow_inf_nan=False)

    mode: ModeName = 'BRIGHT_FIELD'
    panel: PanelName
    convergence_radius: Annotated[float, Field(ge=0)] = 0.0     # m; 0: stay where the head is
    exposure: Annotated[float, Field(ge=0, le=10)] = 0.0        # s; 0: the recipe's
    intensity: Annotated[float, Field(ge=0, le=1)] = 1.0        # relative


class Recipe(BaseModel):
    """What one capture consists of."""

    model_config = ConfigDict(extra='forbid', frozen=True, allow_inf_nan=False)

    steps: Annotated[list[Step], Field(min_length=1, max_length=32)]
    exposure: Annotated[float, Field(ge=0, le=10)] = 0.0        # s; 0: the node's default
    ambient: bool = False                                       # one more frame, all panels off

    @model_validator(mode='after')
    def _one_exposure_with_ambient(self) -> 'Recipe':
        if self.ambient and len({self.exposure_of(step, 1.0) for step in self.steps}) > 1:
            raise ValueError('ambient: all steps need the same exposure, because the ambient '
                             'frame is subtracted from each')
        return self

    def exposure_of(self, step: Step, default: float) -> float:
        """Exposure of one step in seconds: its own, else the recipe's, else the default."""
        return step.exposure or self.exposure or default


class Recipes(BaseModel):
    """A recipe file: named recipes and which one is the default."""

    model_config = ConfigDict(extra='forbid', frozen=True)

    default: str
    recipes: dict[str, Recipe]

    @model_validator(mode='after')
    def _default_exists(self) -> 'Recipes':
        if self.default not in self.recipes:
            raise ValueError(f'default: there is no recipe {self.default!r}')
        return self

    def get(self, name: str) -> Recipe:
        """The named recipe, or the default for an empty name.

        :raises PsError: SEQUENCER_UNKNOWN_RECIPE with the names there are.
        """
        recipe = self.recipes.get(name or self.default)
        if recipe is None:
            raise PsError(ErrorCode.SEQUENCER_UNKNOWN_RECIPE,
                          f'recipe {name!r} is not in the recipe file; it has '
                          + ', '.join(sorted(self.recipes)))
        return recipe


def load_recipes(path: str | Path) -> Recipes:
    """Read a recipe file.

    :raises PsError: SEQUENCER_BAD_REQUEST naming file and field.
    """
    code = ErrorCode.SEQUENCER_BAD_REQUEST
    recipes: Recipes = parse_yaml(Recipes, read_yaml(path, code), str(path), code)
    return recipes


# ---------------------------------------------------------------------------- plan

@dataclass(frozen=True)
class Shot:
    """One triggered frame to take."""

    mode: Mode
    panel: Panel
    intensity: float
    exposure: float        # s


@dataclass(frozen=True)
class Segment:
    """Shots at one position of the panels: one strobe program."""

    convergence_radius: float     # m; 0: stay where the head is
    shots: tuple[Shot, ...]


def plan(recipe: Recipe, default_exposure: float) -> list[Segment]:
    """Split a recipe into strobe programs, one for each run of steps at the same CR.

    :param default_exposure: for steps and recipes that state none, s.
    """
    segments = [
        Segment(radius, tuple(
            Shot(Mode[step.mode], Panel[step.panel], step.intensity,
                 recipe.exposure_of(step, default_exposure)) for step in steps))
        for radius, steps in groupby(recipe.steps, key=lambda step: step.convergence_radius)]
    if recipe.ambient:
        last = segments[-1]
        ambient = Shot(Mode.BRIGHT_FIELD, Panel.NONE, 0.0, last.shots[-1].exposure)
        segments[-1] = replace(last, shots=(*last.shots, ambient))
    return segments


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


# ---------------------------------------------------------------------------- flat field

def gain_map(images: Sequence[np.ndarray], ambient: np.ndarray | None, height: int) -> np.ndarray:
    """Mean of several flat-field pictures at reduced resolution.

    :param images: (H, W) or (H, W, 3), of one light.
    :param ambient: all panels off, or None.
    :param height: rows of the result; the width follows.
    :returns: (height, width) float32, in the unit of the pictures, at least 1/1000 of its maximum.
    """
    import cv2
    stacked = np.stack([np.asarray(image, np.float32) for image in images])
    mean = np.asarray(stacked.mean(axis=0), np.float32)
    if ambient is not None:
        mean = mean - ambient.astype(np.float32)
    if mean.ndim == 3:
        mean = np.asarray(mean.mean(axis=2), np.float32)
    height = min(height, mean.shape[0])
    width = max(1, round(mean.shape[1] * height / mean.shape[0]))
    small = cv2.resize(mean, (width, height), interpolation=cv2.INTER_AREA)
    return np.maximum(small, small.max() * 1e-3).astype(np.float32)
