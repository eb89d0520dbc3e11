"""The fake camera's pictures: what a head with its true geometry makes of a scene.

For each pixel the ray through the lens meets something; for each panel the radiance of that point
is summed over emitters on the panel, with attached and cast shadows (surface_renderer.py for
surfaces, ring_renderer.py for the calibration target). Radiance is linear in the panels' levels
and kept, so that a repeated frame costs only scaling and noise.

Left out: light that goes from surface to surface, the blur of the lens, colour.
"""
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ps_head_driver.camera_model import scaled_camera
from ps_head_driver.head_model import DIRECTIONS, HeadModel
from ps_head_driver.kinematics import BrightFieldKinematics, DarkFieldKinematics, PanelPose
from ps_head_driver.stack import Truth

OFF = (0.0, 0.0, 0.0, 0.0)

# Radiance at the centre of a matt plate of albedo 0.8 under one panel of the nominal head, tilted
# by 30 degrees, in units of the panel's radiance: it fixes the camera's sensitivity. The edge of
# the field that is nearest to the panel is 1.4 times as bright and must not saturate.
_REFERENCE_RADIANCE = 0.014105
_REFERENCE_LEVEL = 0.6


@dataclass(frozen=True)
class Sensor:
    """The camera behind the lens.

    With the defaults a matt plate of albedo 0.8 under one panel at 30 degrees tilt fills 60 % of
    the range at the picture's centre.

    :param bit_depth: 8 or 16.
    :param noise: shot and read noise; quantisation and saturation are always there.
    :param full_well: electrons at full scale and 0 dB.
    :param read_noise: electrons, RMS.
    :param exposure: exposure time at which the levels above hold, s.
    :param vignetting: relative loss of light in the corners of the picture.
    :param ambient: light of the room on a white board at that exposure, relative to full scale.
    """

    bit_depth: int = 8
    noise: bool = True
    full_well: float = 10_000.0
    read_noise: float = 5.0
    exposure: float = 0.004
    vignetting: float = 0.0
    ambient: float = 0.0

    def __post_init__(self) -> None:
        if self.bit_depth not in (8, 16):
            raise ValueError(f'bit_depth must be 8 or 16, not {self.bit_depth}')

    @property
    def maximum(self) -> int:
        """Largest grey value."""
        return (1 << self.bit_depth) - 1

    def expose(self, level: NDArray, gain_db: float, random: np.random.Generator) -> NDArray:
        """Turn light into grey values.

        :param level: (H, W) float32 light, 1 = full scale at 0 dB.
        :param gain_db: amplification after the light was counted.
        :returns: (H, W) uint8 or uint16.
        """
        gain = 10.0 ** (gain_db / 20.0)
        grey = level * np.float32(gain * self.maximum)
        if self.noise:
            # shot noise as a Gaussian of the same variance: indistinguishable above some 20
            # electrons, and below that read noise rules
            sigma = np.sqrt(level * np.float32(1 / self.full_well)
                            + np.float32((self.read_noise / self.full_well) ** 2))
            noise = random.standard_normal(level.shape, np.float32)
            noise *= sigma
            noise *= np.float32(gain * self.maximum)
            grey += noise
        np.rint(grey, out=grey)
        np.clip(grey, 0, self.maximum, out=grey)
        return grey.astype(np.uint8 if self.bit_depth == 8 else np.uint16)


def emitters(pose: PanelPose, count: tuple[int, int], gauss: bool) -> tuple[NDArray, NDArray]:
    """Sample a panel.

    :param count: emitters along width and height.
    :param gauss: at the nodes of Gauss-Legendre quadrature, the most exact where the integrand is
        smooth; otherwise at the centres of equal parts.
    :returns: (4, E) positions and areas, and the panel as shading.shade wants them (6, 3).
    """
    rules = [np.polynomial.legendre.leggauss(n) if gauss
             else ((2 * np.arange(n) + 1) / n - 1, np.full(n, 2 / n)) for n in count]
    (u, across), (v, along) = rules
    width, height = pose.size
    up = np.cross(pose.axis, pose.right)
    samples = np.empty((*count, 4))
    samples[..., :3] = (pose.center + width / 2 * u[:, None, None] * pose.right
                        + height / 2 * v[:, None] * up)
    samples[..., 3] = np.outer(across, along) * width * height / 4
    azimuth = math.atan2(pose.center[1], pose.center[0])
    forward = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    sideways = np.array([-forward[1], forward[0], 0.0])
    part = np.array([width / count[0], height / count[1], 0.0])
    return (np.ascontiguousarray(samples.reshape(-1, 4).T),
            np.stack([pose.axis, pose.right, up, part, sideways, forward]))


def corners(pose: PanelPose) -> NDArray:
    """Corners of a panel, (4, 3)."""
    up = np.cross(pose.axis, pose.right)
    width, height = pose.size
    return np.array([pose.center + a * width / 2 * pose.right + b * height / 2 * up
                     for a in (-1, 1) for b in (-1, 1)])


class Renderer(ABC):
    """Pictures and truth of something under one head.

    :param head: the head as it really is.
    :param sensor: the camera behind the lens.
    :param scale: picture size relative to the head's camera.
    :param seed: of the noise; the same seed and frame number give the same picture.
    :param cache_bytes: radiance of panels kept for frames to come.
    """

    def __init__(self, head: HeadModel, sensor: Sensor | None = None, scale: float = 1.0,
                 seed: int = 1, cache_bytes: int = 400_000_000) -> None:
        self.head, self.sensor, self.seed = head, sensor or Sensor(), seed
        self.camera = scaled_camera(head.camera, round(head.camera.width_px * scale),
                                    round(head.camera.height_px * scale))
        self.shape = (self.camera.height_px, self.camera.width_px)
        self._bright, self._dark = BrightFieldKinematics(head), DarkFieldKinematics(head)
        self._cache: OrderedDict[tuple, NDArray] = OrderedDict()
        self._cache_bytes = cache_bytes
        self._vignette = self._vignetting()

    @property
    @abstractmethod
    def albedo(self) -> NDArray:
        """Diffuse reflectance of what each pixel sees, (H, W) float32."""

    @abstractmethod
    def truth(self) -> Truth:
        """True normals (n_plane) and heights where the pixels really look."""

    @abstractmethod
    def _trace(self, pose: PanelPose) -> NDArray:
        """Radiance towards the camera under one panel at full level, (H, W) float32."""

    @abstractmethod
    def warm_up(self) -> None:
        """Compile the kernels now, not with the first picture."""

    def _vignetting(self) -> NDArray | None:
        if not self.sensor.vignetting:
            return None
        height, width = self.shape
        y, x = np.ogrid[-1:1:height * 1j, -1:1:width * 1j]
        return (1 - self.sensor.vignetting * (x * x + y * y) / 2).astype(np.float32)

    def panel_radiance(self, pose: PanelPose) -> NDArray:
        """Radiance of the scene under one panel at full level, without noise.

        :returns: (H, W) float32 in units of the panel's radiance; not to be written to.
        """
        key = (*pose.center, *pose.axis, *pose.right, *pose.size, pose.lobe_exponent,
               pose.intensity)
        if key in self._cache:
            self._cache.move_to_end(key)
            return self._cache[key]
        radiance = self._trace(pose)
        radiance.flags.writeable = False
        self._cache[key] = radiance
        while len(self._cache) > 1 and len(self._cache) * radiance.nbytes > self._cache_bytes:
            self._cache.popitem(last=False)
        return radiance

    def radiance(self, tilt: float, df_tilt: float, bf_levels: Sequence[float],
                 df_levels: Sequence[float] = OFF) -> NDArray:
        """Radiance of the scene under all panels that are on, without noise.

        :param tilt: of the bright-field panels, rad.
        :param df_tilt: of the dark-field panels, rad.
        :param bf_levels: relative output of E, N, W, S, 0 to 1.
        :param df_levels: the same for the dark field.
        :returns: (H, W) float32 in units of a panel's radiance.
        """
        total = np.zeros(self.shape, np.float32)
        for panel_pose, angle, levels in ((self._bright.panel_pose, tilt, bf_levels),
                                          (self._dark.panel_pose, df_tilt, df_levels)):
            for direction, level in zip(DIRECTIONS, levels, strict=True):
                if level > 0:
                    pose = panel_pose(direction, angle)
                    total += np.float32(level) * self.panel_radiance(pose)
        return total

    def render(self, tilt: float, df_tilt: float, bf_levels: Sequence[float],
               df_levels: Sequence[float] = OFF, exposure: float | None = None,
               strobe: float | None = None, gain: float = 0.0, frame: int = 0) -> NDArray:
        """One picture.

        :param tilt, df_tilt, bf_levels, df_levels: see :meth:`radiance`.
        :param exposure: time that the shutter was open, s; the sensor's reference if None.
        :param strobe: time of it that the panels were on, s; all of it if None.
        :param gain: dB.
        :param frame: number of the frame; selects its noise.
        :returns: (H, W) uint8 or uint16.
        """
        sensor = self.sensor
        exposure = sensor.exposure if exposure is None else exposure
        strobe = exposure if strobe is None else min(strobe, exposure)
        level = self.radiance(tilt, df_tilt, bf_levels, df_levels)
        level *= np.float32(_REFERENCE_LEVEL / _REFERENCE_RADIANCE * strobe / sensor.exposure)
        if sensor.ambient:
            level += (np.float32(sensor.ambient * exposure / sensor.exposure)
                      * self.albedo)
        if self._vignette is not None:
            level *= self._vignette
        return sensor.expose(level, gain, np.random.default_rng([self.seed, frame]))


def make_renderer(scene: str, head: HeadModel, sensor: Sensor | None = None, scale: float = 1.0,
                  seed: int = 1, **parameters: Any) -> Renderer:
    """Renderer for a scene by name, large enough for the head's field of view.

    :param scene: one of scenes.SCENES or ring, with arguments if wanted:
        ``boss:height=0.002,albedo=0.5``.
    :param parameters: further arguments of the scene.
    :raises PsError: SEQUENCER_BAD_REQUEST for an unknown scene or argument.
    """
    from ps_head_driver.fake.ring_renderer import make_ring_renderer
    from ps_head_driver.fake.scenes import parse_scene
    from ps_head_driver.fake.surface_renderer import make_surface_renderer
    name, arguments = parse_scene(scene)
    make = make_ring_renderer if name == 'ring' else make_surface_renderer
    return make(name, {**arguments, **parameters}, head, sensor, scale, seed)
