"""Rendered pictures that must not pass for a good calibration, and what must be said of them."""
from collections.abc import Callable
from dataclasses import dataclass
import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ps_calibration.ring_target import RingTarget
from ps_calibration.synthetic import Bench, render_stack, solid_of, with_images
from ps_head_driver.fake.renderer import OFF, Sensor, make_renderer
from ps_head_driver.head_model import HeadModel
from ps_head_driver.kinematics import BrightFieldKinematics
from ps_head_driver.stack import Stack

E, N, W, S, ALL, NONE = range(6)        # frames of synthetic.render_stack


@dataclass(frozen=True)
class Rendered:
    """Good pictures, and how they were made.

    :param scale: of the pictures.
    """

    bench: Bench
    nominal: HeadModel
    target: RingTarget
    good: Stack
    scale: float

    def ring(self, **changes: Any) -> Stack:
        """The pictures if the target were another one; changes are those of a RingSolid."""
        return render_stack(self.bench, self.nominal, solid_of(self.target, **changes),
                            self.good.lights[E].motor_counts, self.scale, 3)

    def scene(self, name: str) -> Stack:
        """The pictures if something else lay under the head."""
        renderer = make_renderer(name, self.bench.head, Sensor(ambient=0.02), self.scale, 3)
        tilt = float(BrightFieldKinematics(self.nominal).tilt(self.good.lights[E].motor_counts))
        exposure = renderer.sensor.exposure
        frames = [*((row, 1.0) for row in np.eye(4)), (np.ones(4), 0.25), (np.zeros(4), 1.0)]
        return with_images(self.good, [
            renderer.render(tilt, 1.2, list(levels), OFF, part * exposure, frame=i)
            for i, (levels, part) in enumerate(frames)])

    def changed(self, **frames: Callable[[NDArray], NDArray]) -> Stack:
        """The good pictures with single frames changed."""
        names = ['E', 'N', 'W', 'S', 'ALL', 'NONE']
        return with_images(self.good, [
            frames[name](image) if name in frames else image
            for name, image in zip(names, self.good.images, strict=True)])

    def exchanged(self, *order: int) -> Stack:
        """The good pictures in another order, the labels as they were."""
        return with_images(self.good, [self.good.images[i] for i in order])


@dataclass(frozen=True)
class Fault:
    """One way to get it wrong.

    :param make: the pictures.
    :param words: one of which the reason must have.
    """

    name: str
    make: Callable[[Rendered], Stack]
    words: tuple[str, ...]


def _shifted(pixels: float) -> Callable[[NDArray], NDArray]:
    move = np.array([[1.0, 0.0, pixels], [0.0, 1.0, 0.0]])
    return lambda image: cv2.warpAffine(image, move, image.shape[::-1],
                                        borderMode=cv2.BORDER_REPLICATE)


def _brighter(factor: float) -> Callable[[NDArray], NDArray]:
    return lambda image: np.clip(image * factor, 0, 255).astype(np.uint8)


def _gamma(exponent: float) -> Callable[[NDArray], NDArray]:
    return lambda image: np.rint(255 * (image / 255) ** exponent).astype(np.uint8)


def _lamp(image: NDArray) -> NDArray:
    return np.clip(image.astype(int) + 40, 0, 255).astype(np.uint8)


def _slits(target: RingTarget, *without: int) -> tuple[float, ...]:
    return tuple(azimuth for k, azimuth in enumerate(target.slits.azimuths) if k not in without)


#: Faults of the target, then of the pictures.
FAULTS = (
    Fault('half ring missing on its plate', lambda r: r.ring(height=0.0), ('half ring missing',)),
    Fault('target turned over', lambda r: r.ring(height=0.0, dots=np.array([[0.1, 0.1]])),
          ('not found',)),
    Fault('ring 0.5 mm too small', lambda r: r.ring(
        radii=(r.target.inner_radius - 5e-4, r.target.outer_radius - 5e-4)),
        ('another ring', 'right target')),
    Fault('ring 25 % too high', lambda r: r.ring(height=1.25 * r.target.height),
          ('higher', 'another ring')),
    Fault('ring 10 % too low', lambda r: r.ring(height=0.9 * r.target.height),
          ('lower', 'another ring')),
    Fault('ring with other slits', lambda r: r.ring(
        slits=tuple(azimuth + 0.15 for azimuth in r.target.slits.azimuths)),
        ('another ring', 'slit')),
    Fault('ring with other dots', lambda r: r.ring(dots=np.array(
        [*r.target.fiducials.centres[:5], (-0.012, -0.009)])), ('not in its pattern', 'mirrored')),
    Fault('middle slit blocked', lambda r: r.ring(slits=_slits(r.target, 2)),
          ('slit at 90',)),
    Fault('outer slit blocked', lambda r: r.ring(slits=_slits(r.target, 0)),
          ('slit at 15',)),
    Fault('half of the wall broken off', lambda r: r.ring(
        arc=(r.target.arc[0], math.pi / 2)), ('another ring', 'damaged', 'slit')),
    Fault('a matt plate instead', lambda r: r.scene('plate'), ('not found',)),
    Fault('a machined disc instead', lambda r: r.scene('disc'), ('not found',)),
    Fault('a weld instead', lambda r: r.scene('weld'), ('not found',)),
    Fault('panel N dead', lambda r: r.exchanged(E, NONE, W, S, ALL, NONE),
          ('panel N gives no light',)),
    Fault('panel N at a third', lambda r: r.changed(N=_brighter(0.3)),
          ('not the sum', 'panel N')),
    Fault('panels E and N swapped', lambda r: r.exchanged(N, E, W, S, ALL, NONE),
          ('panel E shows the light of panel N',)),
    Fault('panels E and W swapped', lambda r: r.exchanged(W, N, E, S, ALL, NONE),
          ('panel E shows the light of panel W',)),
    Fault('camera turned by half a turn', lambda r: with_images(
        r.good, [np.ascontiguousarray(image[::-1, ::-1]) for image in r.good.images]),
        ('shows the light', 'not found')),
    Fault('pictures mirrored', lambda r: with_images(
        r.good, [np.ascontiguousarray(image[:, ::-1]) for image in r.good.images]),
        ('mirrored',)),
    Fault('frame E saturated', lambda r: r.changed(E=_brighter(3)), ('frame E is saturated',)),
    Fault('all frames dark', lambda r: with_images(
        r.good, [image // 20 for image in r.good.images]), ('too dark',)),
    Fault('camera with gamma', lambda r: with_images(r.good, [
        _gamma(0.45)(image) for image in r.good.images]),
          ('no gamma', 'not proportional to light')),
    Fault('camera not quite linear', lambda r: with_images(r.good, [
        _gamma(0.96)(image) for image in r.good.images]), ('not proportional to light',)),
    Fault('a lamp switched on in frame S', lambda r: r.changed(S=_lamp), ('not the sum',)),
    Fault('frame S moved by 2 px', lambda r: r.changed(S=_shifted(2.0)), ('frame S', )),
    Fault('frame W moved by 0.5 px', lambda r: r.changed(W=_shifted(0.5)), ('frame W',)),
)
