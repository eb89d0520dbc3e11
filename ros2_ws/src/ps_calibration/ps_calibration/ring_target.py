"""The half-ring target as data (paper, section 2.3), read from one YAML file.

Target frame: x right, y up, z out of the base plate, origin at the centre of the ring. Metres and
radians.
"""
import math
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.head_model import parse_yaml, read_yaml

Length = Annotated[float, Field(gt=0)]
Reflectance = Annotated[float, Field(ge=0, le=1)]

# dots this alike under a turn or a mirror (m) could be mistaken for each other
_DISTINCT = 0.001


class _Section(BaseModel):
    model_config = ConfigDict(extra='forbid', frozen=True, allow_inf_nan=False)


class Slits(_Section):
    """Parallel-sided radial slits through the full height of the wall."""

    azimuths: tuple[float, ...]
    width: Length


class Base(_Section):
    """Base plate, centred on the ring."""

    size: tuple[Length, Length]
    reflectance: Reflectance
    thickness: Length = 0.003        # for manufacture only


class Fiducials(_Section):
    """Printed dots on the base."""

    radius: Length
    reflectance: Reflectance
    centres: Annotated[tuple[tuple[float, float], ...], Field(min_length=5)]


class RingTarget(_Section):
    """A half ring standing on a base plate with printed dots."""

    name: Annotated[str, Field(min_length=1)]
    inner_radius: Length
    outer_radius: Length
    height: Length
    arc: tuple[float, float]
    slits: Slits
    wall_reflectance: Reflectance
    base: Base
    fiducials: Fiducials

    @model_validator(mode='after')
    def _consistent(self) -> 'RingTarget':
        if self.inner_radius >= self.outer_radius:
            raise ValueError('inner_radius must be smaller than outer_radius')
        if not 0 < self.arc[1] - self.arc[0] <= math.pi + 1e-6:
            raise ValueError('arc must be [from, to] and span at most half a turn')
        if self.slits.width >= self.inner_radius:
            raise ValueError('slits.width must be smaller than inner_radius')
        for azimuth in self.slits.azimuths:
            if not self.arc[0] < azimuth < self.arc[1]:
                raise ValueError(f'slits.azimuths: {azimuth} lies outside the arc')
        if self.fiducials.reflectance > 0.5 * self.base.reflectance:
            raise ValueError('fiducials.reflectance must be at most half of the base reflectance')
        half = np.array(self.base.size) / 2 - self.fiducials.radius
        for centre in self.fiducials.centres:
            if np.any(np.abs(centre) > half):
                raise ValueError(f'fiducials.centres: {list(centre)} does not fit on the base')
            if self.distance(*np.array(centre)) < self.fiducials.radius:
                raise ValueError(f'fiducials.centres: {list(centre)} lies under the wall')
        if self._ambiguous():
            raise ValueError('fiducials.centres: the pattern looks the same turned or mirrored')
        return self

    def _ambiguous(self) -> bool:
        dots = np.array(self.fiducials.centres)
        dots = dots - dots.mean(axis=0)
        for mirrored in (dots, dots * [1, -1]):
            for anchor in mirrored:
                for other in dots:
                    turn = math.atan2(other[1], other[0]) - math.atan2(anchor[1], anchor[0])
                    if mirrored is dots and abs(math.remainder(turn, 2 * math.pi)) < 1e-3:
                        continue
                    c, s = math.cos(turn), math.sin(turn)
                    moved = mirrored @ np.array([[c, s], [-s, c]])
                    gaps = np.linalg.norm(moved[:, None] - dots, axis=2).min(axis=1)
                    if gaps.max() < _DISTINCT:
                        return True
        return False

    @property
    def dots(self) -> NDArray:
        """Centres of the fiducials in the target frame, (F, 3) float64."""
        centres = np.array(self.fiducials.centres)
        return np.concatenate([centres, np.zeros((len(centres), 1))], axis=1)

    @property
    def footprint(self) -> NDArray:
        """The wall seen from above, as numbers for compiled code.

        :returns: (4 + S, 2) float64: inner and outer radius; half the slits' width and 0; unit
            vectors along the two ends of the arc; unit vectors along the S slits.
        """
        azimuths = np.array([*self.arc, *self.slits.azimuths])
        return np.concatenate([
            [[self.inner_radius, self.outer_radius], [self.slits.width / 2, 0.0]],
            np.stack([np.cos(azimuths), np.sin(azimuths)], axis=1)])

    def distance(self, x: NDArray, y: NDArray) -> NDArray:
        """Distance from the ring without its slits, m; 0 under it; same shape as x."""
        (inner, outer), _, start, end = self.footprint[:4]
        radius = np.hypot(x, y)
        within = (start[0] * y >= start[1] * x) & (x * end[1] >= y * end[0])
        faces = []
        for along_x, along_y in (start, end):
            along = np.clip(x * along_x + y * along_y, inner, outer)
            faces.append(np.hypot(x - along * along_x, y - along * along_y))
        return np.where(within, np.maximum(np.maximum(inner - radius, radius - outer), 0),
                        np.minimum(*faces))


def load_target(path: str | Path) -> RingTarget:
    """Read a target file.

    :raises PsError: CALIBRATION_BAD_REQUEST naming file and field if it cannot be read or is not
        valid.
    """
    code = ErrorCode.CALIBRATION_BAD_REQUEST
    target: RingTarget = parse_yaml(RingTarget, read_yaml(path, code), str(path), code)
    return target


def default_target_path() -> Path:
    """Path of the ring_target.yaml shipped with this package, installed or in the source tree."""
    package = Path(__file__).resolve().parent
    for folder in (package.parent / 'config', *(
            parent / 'share' / 'ps_calibration' / 'config' for parent in package.parents)):
        if (folder / 'ring_target.yaml').is_file():
            return folder / 'ring_target.yaml'
    raise PsError(ErrorCode.CALIBRATION_BAD_REQUEST,
                  'ring_target.yaml is not installed with ps_calibration')
