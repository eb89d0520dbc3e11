"""The head as data: panels, crank-slider and camera, read from one YAML file (head.yaml).

Metres and radians unless the name says otherwise; config/head.yaml explains every key.
"""
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
import yaml

from ps_head_driver.errors import ErrorCode, PsError

Direction = Literal['E', 'N', 'W', 'S']
DIRECTIONS: tuple[Direction, ...] = ('E', 'N', 'W', 'S')
Approach = Literal['up', 'down']                  # last direction of the motor
APPROACHES: tuple[Approach, ...] = ('up', 'down')

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Size = tuple[Positive, Positive]
Interval = tuple[float, float]


class _Section(BaseModel):
    model_config = ConfigDict(extra='forbid', frozen=True, allow_inf_nan=False)


class CameraGeometry(_Section):
    """Pinhole with plumb_bob distortion (k1 k2 p1 p2 k3), looking along -z of ps_head_plane."""

    width_px: Annotated[int, Field(gt=0)]
    height_px: Annotated[int, Field(gt=0)]
    fx: Positive
    fy: Positive
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0, 0, 0, 0, 0)
    camera_standoff: Positive


class Mount(_Section):
    """Pose of ps_head_camera_link in ps_head_link, the mounting face: as ``origin`` in URDF."""

    xyz: tuple[float, float, float] = (0.0, 0.0, 0.0)        # m
    rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)        # rad, about the fixed x, y, z


class Hinge(_Section):
    """Hinge or pivot of the panels in the plane of their azimuth."""

    r: NonNegative
    z: float


class Arm(_Section):
    """Panel centre = hinge + along * e(tilt) + out * axis(tilt)."""

    along: float
    out: float


class Crank(_Section):
    """Pin = hinge + radius * (cos(tilt + offset), -sin(tilt + offset))."""

    radius: Positive
    offset: float


class Slider(_Section):
    """Slider z = z_at_m0 + direction * (m - m0_counts) / counts_per_metre."""

    r: NonNegative
    z_at_m0: float
    counts_per_metre: Positive
    m0_counts: int
    direction: Literal[-1, 1]
    limits_counts: tuple[int, int]


class PanelTolerance(_Section):
    """Offsets of one panel from nominal, in its own (radial, tangential, z) axes."""

    azimuth: float
    tilt_offset: float = 0.0
    twist: float = 0.0
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    intensity: Positive = 1.0


def _nominal_ring() -> dict[Direction, PanelTolerance]:
    quarter_turn = 1.5707963267948966
    return {name: PanelTolerance(azimuth=i * quarter_turn) for i, name in enumerate(DIRECTIONS)}


class BrightField(_Section):
    """Four panels hinged on the camera tube, tilted by the crank-slider (paper, section 2.1)."""

    panel_size: Size
    lobe_exponent: NonNegative
    hinge: Hinge
    arm: Arm
    tilt_range: Interval
    crank: Crank
    rod_length: Positive
    slider: Slider
    panels: dict[Direction, PanelTolerance] = Field(default_factory=_nominal_ring)

    @model_validator(mode='after')
    def _complete(self) -> 'BrightField':
        _check_ring(self.panels, self.tilt_range)
        low, high = self.slider.limits_counts
        if low >= high:
            raise ValueError('slider.limits_counts must be [low, high] with low < high')
        return self


class DarkField(_Section):
    """Four panels close to the measurement plane, tilted by a servo."""

    panel_size: Size
    lobe_exponent: NonNegative
    pivot: Hinge
    tilt_range: Interval
    panels: dict[Direction, PanelTolerance] = Field(default_factory=_nominal_ring)

    @model_validator(mode='after')
    def _complete(self) -> 'DarkField':
        _check_ring(self.panels, self.tilt_range)
        return self


def _check_ring(panels: dict[Direction, PanelTolerance], tilt_range: Interval) -> None:
    missing = [name for name in DIRECTIONS if name not in panels]
    if missing:
        raise ValueError(f'panels: {", ".join(missing)} missing')
    if tilt_range[0] >= tilt_range[1]:
        raise ValueError('tilt_range must be [low, high] with low < high')


class HeadModel(_Section):
    """Geometry of one head. Immutable: calibration makes a corrected copy."""

    name: str
    mount: Mount = Mount()
    camera: CameraGeometry
    bright_field: BrightField
    dark_field: DarkField
    backlash_counts: Annotated[int, Field(ge=0)] = 0


def parse_yaml(model: type[BaseModel], data: Any, source: str, code: ErrorCode) -> Any:
    """Validate data against a pydantic model, or raise a PsError naming file and field."""
    if not isinstance(data, dict):
        raise PsError(code, f'{source}: expected a mapping of keys, found {type(data).__name__}')
    try:
        return model.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        field = '.'.join(str(part) for part in first['loc']) or '(whole file)'
        more = f' (and {error.error_count() - 1} more)' if error.error_count() > 1 else ''
        raise PsError(code, f'{source}: {field}: {first["msg"]}{more}') from error


def read_yaml(path: str | Path, code: ErrorCode) -> Any:
    """Read one YAML file, or raise PsError naming it."""
    try:
        with open(path, encoding='utf-8') as file:
            return yaml.safe_load(file)
    except OSError as error:
        raise PsError(code, f'{path}: {error.strerror or error}') from error
    except (yaml.YAMLError, UnicodeDecodeError, ValueError) as error:
        reason = ' '.join(str(error).split())
        raise PsError(code, f'{path}: not a YAML file: {reason}') from error


def load_head(path: str | Path) -> HeadModel:
    """Read a head file.

    :raises PsError: HEAD_BAD_REQUEST naming file and field if it cannot be read or is not valid.
    """
    code = ErrorCode.HEAD_BAD_REQUEST
    head: HeadModel = parse_yaml(HeadModel, read_yaml(path, code), str(path), code)
    return head


def nominal_head_path() -> Path:
    """Path of the head.yaml shipped with this package, installed or in the source tree."""
    package = Path(__file__).resolve().parent
    for folder in (package.parent / 'config', *(
            parent / 'share' / 'ps_head_driver' / 'config' for parent in package.parents)):
        if (folder / 'head.yaml').is_file():
            return folder / 'head.yaml'
    raise PsError(ErrorCode.HEAD_BAD_REQUEST, 'head.yaml is not installed with ps_head_driver')
