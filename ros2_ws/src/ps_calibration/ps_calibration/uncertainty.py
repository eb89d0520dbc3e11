"""How well the light is known: the fit's covariance, carried over to what a user asks for."""
from collections.abc import Callable
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from ps_calibration.dark_field import DarkField
from ps_calibration.ring_fit import RingFit
from ps_calibration.ring_problem import PER_PANEL, Field, corrected
from ps_calibration.target_pose import TargetPose
from ps_head_driver.camera_model import plane_points
from ps_head_driver.head_model import CameraGeometry, HeadModel
from ps_head_driver.kinematics import PanelRing, as_light
from ps_head_driver.light_model import light_vectors

# finite differences: metres, radians and logarithms alike are of the order of 1e-3
_STEP = 1e-6


@dataclass(frozen=True)
class LightFigures:
    """The light of E, N, W, S where the optical axis meets the plane.

    Deviations are those of noise alone; errors of the model come on top.

    :param direction: (4, 3) unit vectors towards the light.
    :param direction_deviation: (4,) rad, in the worst direction.
    :param intensity: (4,) relative, their mean is 1.
    :param intensity_deviation: (4,).
    :param level_deviation: of the plane's normal, rad.
    """

    direction: NDArray
    direction_deviation: NDArray
    intensity: NDArray
    intensity_deviation: NDArray
    level_deviation: float


def light_figures(fit: RingFit, head: HeadModel, camera: CameraGeometry,
                  position: int = 0) -> LightFigures:
    """Directions and intensities of a fit with their standard deviations.

    :param head: as designed; the fit's corrections come on top.
    :param position: which of the fit's motor positions.
    """
    x = np.concatenate([fit.panels.ravel(), fit.pose.numbers])
    tilt = fit.tilts[position]

    def directions(x: NDArray) -> NDArray:
        return light_directions(corrected(head, x[:4 * PER_PANEL].reshape(4, PER_PANEL)),
                                TargetPose(x[4 * PER_PANEL:]), camera, tilt)

    def intensities(x: NDArray) -> NDArray:
        own = np.array([panel.intensity for panel in corrected(
            head, x[:4 * PER_PANEL].reshape(4, PER_PANEL)).bright_field.panels.values()])
        return own / own.mean()

    rates = _rates(directions, x)                                        # (4, 3, P)
    spread = rates @ fit.covariance @ rates.transpose(0, 2, 1)
    gains = _rates(intensities, x)
    tilts = fit.covariance[-2:, -2:]
    return LightFigures(
        directions(x), np.sqrt(np.linalg.eigvalsh(spread)[:, -1]), intensities(x),
        np.sqrt(np.einsum('ip,pq,iq->i', gains, fit.covariance, gains)),
        float(np.sqrt(np.linalg.eigvalsh(tilts)[-1])))


@dataclass(frozen=True)
class PanelFigures:
    """The light of one dark-field panel where the optical axis meets the plane.

    :param direction: (3,) unit vector towards the light.
    :param direction_deviation: rad, in the worst direction; noise alone. NaN if it failed.
    """

    direction: NDArray
    direction_deviation: float


def dark_figures(dark: DarkField, pose: TargetPose, head: HeadModel,
                 camera: CameraGeometry) -> list[PanelFigures]:
    """Directions of the dark field's light, E, N, W, S.

    :param pose: of the target.
    :param head: as designed.
    """
    def direction(i: int, x: NDArray) -> NDArray:
        rows = np.zeros((4, PER_PANEL))
        rows[i] = x
        found = corrected(head, rows, 'dark_field')
        return light_directions(found, pose, camera, dark.tilt, 'dark_field')[i]

    figures = []
    for i, panel in enumerate(dark.panels):
        rates = _rates(lambda x, i=i: direction(i, x), panel.correction)   # type: ignore[misc]
        deviation = (math.sqrt(np.linalg.eigvalsh(rates @ panel.covariance @ rates.T)[-1])
                     if panel.calibrated else math.nan)
        figures.append(PanelFigures(direction(i, panel.correction), deviation))
    return figures


def light_directions(head: HeadModel, pose: TargetPose, camera: CameraGeometry,
                     tilt: float, field: Field = 'bright_field') -> NDArray:
    """Unit vectors towards the light of E, N, W, S at the middle of the plane, (4, 3)."""
    point = plane_points(camera, [camera.cx, camera.cy], pose.plane)
    ring = PanelRing(getattr(head, field))
    vectors = np.stack([light_vectors(as_light(panel), point) for panel in ring.poses(tilt)])
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _rates(function: Callable[[NDArray], NDArray], x: NDArray) -> NDArray:
    """Derivatives, (*shape of the function, P)."""
    return np.stack([(function(x + step) - function(x - step)) / (2 * _STEP)
                     for step in _STEP * np.eye(x.size)], axis=-1)
