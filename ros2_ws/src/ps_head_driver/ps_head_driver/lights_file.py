"""lights.yaml of a stack folder: what it states of each picture and its light."""
import math
import os
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from ps_head_driver.errors import ErrorCode
from ps_head_driver.head_model import Approach, parse_yaml, read_yaml

Vector = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
# rounding of hand-written vectors that is still taken for unit length or a right angle
VECTOR_TOLERANCE = 1e-2


def _check_unit(name: str, vector: Vector) -> None:
    if abs(math.hypot(*vector) - 1) > VECTOR_TOLERANCE:
        raise ValueError(f'{name}: not a unit vector')


class _Section(BaseModel):
    model_config = ConfigDict(extra='forbid', frozen=True, allow_inf_nan=False)


class CameraSection(_Section):
    """Intrinsics; the size in pixels is that of the pictures."""

    fx: Positive
    fy: Positive
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    camera_standoff: Positive


class PlaneSection(_Section):
    """Measurement plane: normal . x = offset."""

    normal: Vector = (0.0, 0.0, 1.0)
    offset: float = 0.0

    @model_validator(mode='after')
    def _is_unit(self) -> 'PlaneSection':
        _check_unit('normal', self.normal)
        return self


class FrameSection(_Section):
    """One picture and its light. A distant light needs an axis only, and any panel will do."""

    file: str
    panel: Literal['E', 'N', 'W', 'S', 'ALL', 'NONE']
    mode: Literal['BRIGHT_FIELD', 'DARK_FIELD', 'BOTH'] = 'BRIGHT_FIELD'
    name: str = ''
    position: Vector | None = None
    axis: Vector | None = None
    right: Vector = (1.0, 0.0, 0.0)
    size: tuple[NonNegative, NonNegative] = (0.0, 0.0)
    lobe_exponent: NonNegative = 1.0
    intensity: Positive | Vector = 1.0
    exposure_scale: Positive = 1.0
    distant: bool = False
    tilt: float = 0.0
    motor_counts: int | None = None

    @property
    def is_ambient(self) -> bool:
        """Whether this is the ambient picture; other pictures without light stay frames."""
        return self.panel == 'NONE' and not self.distant and Path(self.file).stem == 'ambient'

    @model_validator(mode='after')
    def _is_complete(self) -> 'FrameSection':
        single = self.panel not in ('ALL', 'NONE') and self.mode != 'BOTH'
        if self.axis is None and (single or self.distant):
            raise ValueError('axis: a single-panel or distant frame needs it')
        if self.position is None and single and not self.distant:
            raise ValueError('position: a near light needs it')
        if self.axis is not None:
            _check_unit('axis', self.axis)
        _check_unit('right', self.right)
        if isinstance(self.intensity, tuple) and min(self.intensity) <= 0:
            raise ValueError('intensity: must be positive in each channel')
        # a point or a distant light has no width that could lie askew
        if self.axis is not None and single and not self.distant and min(self.size) > 0:
            cosine = sum(a * b for a, b in zip(self.axis, self.right, strict=True))
            if abs(cosine) > VECTOR_TOLERANCE:
                raise ValueError('right: not at a right angle to axis')
        return self


class LightsFile(_Section):
    """Content of lights.yaml; ps_head_plane, metres and radians."""

    camera: CameraSection | None = None
    motor_counts: int | None = None
    approach: Approach | None = None
    plane: PlaneSection = PlaneSection()
    geometry: Literal['NOMINAL', 'CALIBRATED', 'ASSUMED'] = 'NOMINAL'
    stack_id: str = ''
    session_id: str = ''
    part_id: str = ''
    calibration_id: str = ''
    flat_id: str = ''
    convergence_radius: float | None = None
    light_height: float | None = None
    frames: Annotated[list[FrameSection], Field(min_length=1)]

    @model_validator(mode='after')
    def _each_file_once(self) -> 'LightsFile':
        twice = first_repeated([frame.file for frame in self.frames])
        if twice is not None:
            raise ValueError(f'frames: {twice!r} is listed twice')
        return self


def first_repeated(names: list[str]) -> str | None:
    """First name that means the same file as one before it, however it is written."""
    seen: set[str] = set()
    for name in names:
        path = os.path.normpath(name)
        if path in seen:
            return name
        seen.add(path)
    return None


def read_lights(folder: str | Path) -> LightsFile:
    """Read and check lights.yaml of a folder.

    :raises PsError: RECONSTRUCTION_BAD_STACK naming file and field.
    """
    path = Path(folder) / 'lights.yaml'
    code = ErrorCode.RECONSTRUCTION_BAD_STACK
    lights: LightsFile = parse_yaml(LightsFile, read_yaml(path, code), str(path), code)
    return lights
