"""The calibration of one head: what it holds, its file, and how it corrects the nominal head.

A file is YAML with a format name, a version and a hash over its content: a file that was edited,
cut off or made by something
else is refused with the reason. It is written to a temporary name and renamed, so a crash never
leaves half a file.
"""
from collections.abc import Iterable
from datetime import UTC, datetime
import hashlib
import json
import os
from pathlib import Path
import tempfile
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator
import yaml

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.head_model import (
    DIRECTIONS,
    Approach,
    BrightField,
    CameraGeometry,
    Direction,
    HeadModel,
    PanelTolerance,
    parse_yaml,
    read_yaml,
)
from ps_head_driver.stack import Light, panel_name

FORMAT = 'ps_head_calibration'
VERSION = 2
# version 1 had no motor; its files are read as those of a motor as designed
READABLE = (1, 2)

Verdict = Literal['OK', 'POOR', 'FAILED']
PanelName = Literal['BF_E', 'BF_N', 'BF_W', 'BF_S', 'DF_E', 'DF_N', 'DF_W', 'DF_S']


class _Section(BaseModel):
    model_config = ConfigDict(extra='forbid', frozen=True, allow_inf_nan=False)


class PanelCorrection(_Section):
    """Correction of one panel against the nominal head, in its (radial, tangential, z) axes."""

    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)      # m
    tilt_offset: float = 0.0                                 # rad
    twist: float = 0.0                                       # rad
    intensity: Annotated[float, Field(gt=0)] = 1.0           # relative
    shadow_residual_px: float | None = None


class MotorCorrection(_Section):
    """How the crank-slider as made differs from the nominal one.

    Holds for positions that are approached upwards, as head_driver does by default; see
    :func:`apply` for the others.
    """

    offset_counts: float = 0.0                           # to add to the counts at m0_counts
    scale: Annotated[float, Field(gt=0.5, lt=2)] = 1.0   # true travel of the slider over nominal
    crank_offset: float = 0.0                            # to add to the crank's offset, rad

    def corrected(self, field: BrightField) -> BrightField:
        """The bright field with the crank-slider as made."""
        slider = field.slider
        per_metre = slider.counts_per_metre / self.scale
        return field.model_copy(update={
            'slider': slider.model_copy(update={
                'counts_per_metre': per_metre, 'z_at_m0':
                    slider.z_at_m0 + slider.direction * self.offset_counts / per_metre}),
            'crank': field.crank.model_copy(
                update={'offset': field.crank.offset + self.crank_offset})})


class DarkFieldPanel(_Section):
    """What told where a dark-field panel is, and how well it is known.

    :param source: shadows of the target, plate (the fall-off over it alone), or nominal: it was
        not calibrated and has no entry in ``panels``.
    :param deviation: standard deviations of shift (radial, tangential, z; m), tilt_offset and
        twist (rad) and intensity (relative); None for what stays as in the head file.
    """

    source: Literal['shadows', 'plate', 'nominal'] = 'nominal'
    deviation: tuple[float | None, ...] = (None,) * 6


class DarkFieldRecord(_Section):
    """How the dark field's part of a calibration came about; NONE: it was not asked for."""

    verdict: Literal['NONE', 'OK', 'POOR', 'FAILED'] = 'NONE'
    reason: str = ''
    tilt: float | None = None                            # of the servo, rad
    panels: dict[Direction, DarkFieldPanel] = Field(default_factory=dict)


class HeadCalibration(_Section):
    """Result of a ring calibration; units and frames as in ps_interfaces/HeadCalibration."""

    calibration_id: Annotated[str, Field(min_length=1)]
    created: datetime
    head_serial: str
    camera: CameraGeometry
    plane_normal: tuple[float, float, float] = (0.0, 0.0, 1.0)
    plane_offset: float = 0.0
    panels: dict[PanelName, PanelCorrection] = Field(default_factory=dict)
    backlash_counts: Annotated[int, Field(ge=0)] = 0
    motor: MotorCorrection = MotorCorrection()
    dark_field: DarkFieldRecord = DarkFieldRecord()
    z_scale: Annotated[float, Field(gt=0)] = 1.0
    verdict: Verdict
    verdict_reason: str = ''
    target_name: str = ''
    software_version: str = ''

    @model_validator(mode='after')
    def _unit_normal(self) -> 'HeadCalibration':
        length = sum(c * c for c in self.plane_normal) ** 0.5
        if abs(length - 1) > 1e-3 or self.plane_normal[2] <= 0:
            raise ValueError('plane_normal must be a unit vector with a positive z')
        return self

    def covers(self, lights: Iterable[Light]) -> bool:
        """Whether every panel that is one of these lights alone has been calibrated."""
        return all(panel_name(light.mode, light.panel) in self.panels
                   for light in lights if light.is_equation)


def apply(head: HeadModel, calibration: HeadCalibration | None,
          approach: Approach = 'up') -> HeadModel:
    """The head as calibrated: panels and crank-slider corrected, camera and backlash replaced.

    :param calibration: None leaves the head as it is (nominal geometry).
    :param approach: last direction of the motor. After a motion down, the slider stands as if it
        had ``backlash_counts`` more; a calibration that has measured no backlash has 0.
    """
    if calibration is None:
        return head

    def corrected(prefix: str, ring: dict[Any, PanelTolerance]) -> dict[Any, PanelTolerance]:
        result = {}
        for name in DIRECTIONS:
            old = ring[name]
            fix = calibration.panels.get(f'{prefix}_{name}', PanelCorrection())  # type: ignore
            result[name] = old.model_copy(update={
                'shift': tuple(a + b for a, b in zip(old.shift, fix.shift, strict=True)),
                'tilt_offset': old.tilt_offset + fix.tilt_offset,
                'twist': old.twist + fix.twist,
                'intensity': old.intensity * fix.intensity})
        return result

    motor = calibration.motor
    if approach == 'down':
        motor = motor.model_copy(
            update={'offset_counts': motor.offset_counts + calibration.backlash_counts})
    bright, dark = motor.corrected(head.bright_field), head.dark_field
    return head.model_copy(update={
        'camera': calibration.camera,
        'bright_field': bright.model_copy(update={'panels': corrected('BF', bright.panels)}),
        'dark_field': dark.model_copy(update={'panels': corrected('DF', dark.panels)}),
        'backlash_counts': calibration.backlash_counts or head.backlash_counts})


def content_hash(content: dict[str, Any]) -> str:
    """SHA-256 of the content of a calibration file without its ``hash`` entry."""
    rest = {key: value for key, value in content.items() if key != 'hash'}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def new_calibration_id(head_serial: str, created: datetime) -> str:
    """Identifier that sorts by time: '<serial>-<UTC time>'."""
    return f'{head_serial or "head"}-{created.astimezone(UTC):%Y%m%dT%H%M%SZ}'


def write_calibration(calibration: HeadCalibration, path: str | Path) -> None:
    """Write a calibration file atomically.

    :raises PsError: CALIBRATION_WRITE_FAILED naming the file.
    """
    content = {'format': FORMAT, 'version': VERSION, **calibration.model_dump(mode='json')}
    content['hash'] = content_hash(content)
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(
                'w', dir=path.parent, prefix=f'.{path.name}.', delete=False) as file:
            try:
                yaml.safe_dump(content, file, sort_keys=False)
                file.flush()
                os.fsync(file.fileno())
                os.chmod(file.name, 0o644)
                os.replace(file.name, path)
            except BaseException:
                os.unlink(file.name)
                raise
    except OSError as error:
        raise PsError(ErrorCode.CALIBRATION_WRITE_FAILED,
                      f'{path}: {error.strerror or error}') from error


def read_calibration(path: str | Path) -> HeadCalibration:
    """Read and check a calibration file.

    :raises PsError: CALIBRATION_FILE_NOT_FOUND, _FILE_INVALID or _FILE_VERSION with file, field
        and reason.
    """
    if not Path(path).is_file():
        raise PsError(ErrorCode.CALIBRATION_FILE_NOT_FOUND, f'{path}: no such file')
    invalid = ErrorCode.CALIBRATION_FILE_INVALID
    content = read_yaml(path, invalid)
    if not isinstance(content, dict) or content.get('format') != FORMAT:
        raise PsError(invalid, f'{path}: not a calibration file (format: {FORMAT} is missing)')
    version = content.pop('version', None)
    if version not in READABLE:
        raise PsError(ErrorCode.CALIBRATION_FILE_VERSION,
                      f'{path}: version {version} cannot be read by this software (it reads '
                      f'{" and ".join(map(str, READABLE))}); calibrate again')
    stored = content.pop('hash', None)
    if stored != content_hash({**content, 'version': version}):
        raise PsError(invalid, f'{path}: hash does not match, the file was edited or damaged; '
                               'calibrate again or restore it')
    content.pop('format')
    calibration: HeadCalibration = parse_yaml(HeadCalibration, content, str(path), invalid)
    return calibration
