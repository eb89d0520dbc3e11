"""Recipes: the lights of one capture, and the file that names them."""
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.head_model import parse_yaml, read_yaml

ModeName = Literal['BRIGHT_FIELD', 'DARK_FIELD', 'BOTH']
PanelName = Literal['E', 'N', 'W', 'S', 'ALL', 'NONE']
MOST_FRAMES = 96


class Step(BaseModel):
    """One light of a recipe."""

    model_config = ConfigDict(extra='forbid', frozen=True, allow_inf_nan=False)

    mode: ModeName = 'BRIGHT_FIELD'
    panel: PanelName
    convergence_radius: Annotated[float, Field(ge=0)] = 0.0     # m; 0: stay where the head is
    exposure: Annotated[float, Field(ge=0, le=10)] = 0.0        # s; 0: the recipe's
    gain: Annotated[float, Field(ge=0, le=48)] = 0.0            # dB; 0: the node's
    intensity: Annotated[float, Field(ge=0, le=1)] = 1.0        # relative


class Recipe(BaseModel):
    """What one capture consists of."""

    model_config = ConfigDict(extra='forbid', frozen=True, allow_inf_nan=False)

    steps: Annotated[list[Step], Field(min_length=1, max_length=32)]
    exposure: Annotated[float, Field(ge=0, le=10)] = 0.0        # s; 0: the node's default
    ambient: bool = False                                       # one more frame, all panels off
    # factors of the exposure: every light is taken once with each, and its frames are merged
    bracket: Annotated[list[Annotated[float, Field(gt=0, le=1000)]], Field(max_length=8)] = []

    @model_validator(mode='after')
    def _consistent(self) -> 'Recipe':
        if self.ambient and len({(self.exposure_of(s, 1.0), s.gain) for s in self.steps}) > 1:
            raise ValueError('ambient: all steps need the same exposure and gain, because the '
                             'ambient frame is subtracted from each')
        if len(set(self.bracket)) < len(self.bracket):
            raise ValueError(f'bracket: {self.bracket} holds a factor twice')
        frames = (len(self.steps) + self.ambient) * max(len(self.bracket), 1)
        if frames > MOST_FRAMES:
            raise ValueError(f'bracket: {frames} frames in all; at most {MOST_FRAMES} are taken')
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
