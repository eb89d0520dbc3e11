"""Rendered calibrations with known truth: random heads, targets out of place, noisy pictures."""
from dataclasses import dataclass
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ps_calibration.ring_fit import corrected
from ps_calibration.ring_target import RingTarget
from ps_head_driver.camera_model import plane_points
from ps_head_driver.fake.renderer import OFF, Sensor, make_renderer
from ps_head_driver.fake.ring_renderer import Placement, RingRenderer, RingSolid, placement
from ps_head_driver.head_model import HeadModel
from ps_head_driver.kinematics import (
    BrightFieldKinematics,
    DarkFieldKinematics,
    as_light,
    lights_at,
)
from ps_head_driver.light_model import light_vectors
from ps_head_driver.stack import Light, Panel, Plane, Stack, Truth, angular_error_deg

_LENS = (-0.05, 0.0, 0.0, 0.0, 0.0)     # a pixel or so in the corners of the picture
_SENSOR = Sensor(ambient=0.02, vignetting=0.1)

_DARK_FIELD = 8                         # draws the dark field apart, the rest stays as it is
DF_TILT = 1.3                           # rad, where the servo stands after power-up


@dataclass(frozen=True)
class Bench:
    """A head as it really is, and a target as it really lies."""

    head: HeadModel
    where: Placement


def solid_of(target: RingTarget, **changes: Any) -> RingSolid:
    """The target as a body for the renderer; ``changes`` make it differ from its file."""
    dots = target.fiducials
    solid: dict[str, Any] = {
        'radii': (target.inner_radius, target.outer_radius), 'height': target.height,
        'arc': target.arc, 'slits': target.slits.azimuths, 'slit_width': target.slits.width,
        'plate': target.base.size, 'dots': np.array(dots.centres), 'dot_radius': dots.radius,
        'reflectance': (target.wall_reflectance, target.base.reflectance, dots.reflectance)}
    return RingSolid(**{**solid, **changes})


def random_bench(nominal: HeadModel, seed: int) -> Bench:
    """Within the tolerances of manufacture and of careful hands.

    Panels off by 3 mm, 2 degrees and 5 %, the plane tilted by 1 degree, the target off-centre by
    2 mm and turned by 5 degrees, all at most; a lens with distortion.
    """
    random = np.random.default_rng(seed)
    panels = panels_off(random)
    dark = panels_off(np.random.default_rng([seed, _DARK_FIELD]))
    camera = nominal.camera.model_copy(update={'distortion': _LENS})
    x, y, tilt_x, tilt_y = random.uniform(-1, 1, 4) * [0.002, 0.002, 0.0175, 0.0175]
    where = placement(x, y, random.uniform(-0.0005, 0.0005),
                      math.radians(random.uniform(-5, 5)), tilt_x, tilt_y)
    head = corrected(nominal.model_copy(update={'camera': camera}), panels)
    return Bench(corrected(head, dark, 'dark_field'), where)


def panels_off(random: np.random.Generator) -> NDArray:
    """Corrections of four panels within the tolerances of manufacture, as of a RingFit."""
    return np.concatenate([
        random.uniform(-0.003, 0.003, (4, 3)), np.radians(random.uniform(-2, 2, (4, 2))),
        np.log(random.uniform(0.95, 1.05, (4, 1)))], axis=1)


def render_stack(bench: Bench, nominal: HeadModel, solid: RingSolid, m_counts: int,
                 scale: float = 1.0, seed: int = 1, tilt: float | None = None,
                 dark_field: bool = False, sensor: Sensor = _SENSOR) -> Stack:
    """The six pictures of one motor position, labelled with the nominal lights.

    :param m_counts: of the encoder.
    :param scale: of the pictures.
    :param tilt: that the panels really have, rad; None: that of the nominal crank.
    :param dark_field: four more pictures, under the panels of the dark field.
    """
    renderer = RingRenderer(solid, bench.where, bench.head, sensor, scale, seed)
    if tilt is None:
        tilt = float(BrightFieldKinematics(nominal).tilt(m_counts))
    all_lights = lights_at(nominal, m_counts, DF_TILT)
    lights = [*all_lights[:4],
              Light(panel=Panel.ALL, motor_counts=m_counts, exposure_scale=0.25, name='ALL'),
              Light(panel=Panel.NONE, motor_counts=m_counts, name='NONE')]
    images = renderer.capture(tilt, 0.8)
    if dark_field:
        lights += all_lights[4:]
        images += [renderer.render(tilt, DF_TILT, OFF, list(levels), 0.8 * sensor.exposure,
                                   frame=len(images) + i) for i, levels in enumerate(np.eye(4))]
    return Stack(images=images, lights=lights, camera=renderer.camera)


def render_part(bench: Bench, nominal: HeadModel, scene: str, m_counts: int,
                scale: float = 1.0, seed: int = 1) -> tuple[Stack, Truth]:
    """Pictures of a part under E, N, W, S, labelled with the nominal lights, and its truth.

    :param scene: see fake.scenes; its ground is the nominal plane.
    """
    renderer = make_renderer(scene, bench.head, Sensor(vignetting=0.1), scale, seed)
    tilt = float(BrightFieldKinematics(nominal).tilt(m_counts))
    images = [renderer.render(tilt, 0.0, list(levels), exposure=0.8 * renderer.sensor.exposure,
                              frame=i) for i, levels in enumerate(np.eye(4))]
    lights = lights_at(nominal, m_counts, nominal.dark_field.tilt_range[0])[:4]
    return Stack(images=images, lights=lights, camera=renderer.camera), renderer.truth()


def with_images(stack: Stack, images: list[NDArray]) -> Stack:
    """The same stack with other pictures."""
    return Stack(images=images, lights=stack.lights, camera=stack.camera)


@dataclass(frozen=True)
class Errors:
    """What a calibration got wrong.

    :param direction_deg: (4,) of the light vectors at the middle of the picture.
    :param intensity: (4,) relative, means of the four equal.
    :param level_deg: of the plane's normal.
    """

    direction_deg: NDArray
    intensity: NDArray
    level_deg: float


def errors_of(calibrated: HeadModel, plane: Plane, bench: Bench, tilt: float) -> Errors:
    """Compare a calibrated head and plane with the truth.

    :param tilt: of the bright-field panels, rad.
    """
    camera = bench.head.camera
    truth = Plane(normal=tuple(bench.where.rotation[:, 2]),
                  offset=float(bench.where.rotation[:, 2] @ bench.where.position))
    point = plane_points(camera, [camera.cx, camera.cy], truth)
    vectors, intensities = [], []
    for head in (calibrated, bench.head):
        ring = BrightFieldKinematics(head).ring
        poses = ring.poses(tilt)
        vectors.append(np.stack([light_vectors(as_light(pose), point) for pose in poses]))
        gains = np.array([pose.intensity for pose in poses])
        intensities.append(gains / gains.mean())
    level = angular_error_deg(np.array(plane.normal), np.array(truth.normal))
    return Errors(angular_error_deg(*vectors), intensities[0] / intensities[1] - 1, float(level))


@dataclass(frozen=True)
class DarkErrors:
    """What is wrong with the dark-field panels of a head.

    :param direction_deg: (4,) of the light vectors at the middle of the true plane.
    :param strength: (4,) of their lengths, relative, with a mean of 1 over the bright field's
        intensities; light, not intensity: that trades off against the distance of the panel.
    """

    direction_deg: NDArray
    strength: NDArray


def dark_errors(calibrated: HeadModel, bench: Bench) -> DarkErrors:
    """Compare the dark field of a calibrated head with the truth."""
    camera, normal = bench.head.camera, bench.where.rotation[:, 2]
    truth = Plane(normal=tuple(normal), offset=float(normal @ bench.where.position))
    point, vectors = plane_points(camera, [camera.cx, camera.cy], truth), []
    for head in (calibrated, bench.head):
        ring = DarkFieldKinematics(head).ring
        usual = np.mean([panel.intensity for panel in head.bright_field.panels.values()])
        vectors.append(np.stack([light_vectors(as_light(pose), point) / usual
                                 for pose in ring.poses(DF_TILT)]))
    lengths = np.linalg.norm(vectors, axis=-1)
    return DarkErrors(angular_error_deg(*vectors), lengths[0] / lengths[1] - 1)
