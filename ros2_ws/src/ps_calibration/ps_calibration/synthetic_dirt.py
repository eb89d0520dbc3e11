"""Dirt, glints and a shiny wall on rendered pictures of the half ring: what a shop floor adds.

Frames are those of synthetic.render_stack; the one with all panels gets its quarter of everything,
so that only the fit can notice.
"""
from collections.abc import Sequence
import math

import cv2
import numpy as np
from numpy.typing import NDArray

from ps_calibration.ring_target import RingTarget
from ps_calibration.synthetic import Bench, with_images
from ps_head_driver.camera_model import plane_points
from ps_head_driver.stack import Plane, Stack

_SINGLES, _ALL = range(4), 4
_SPECK_SIZES = (5e-5, 3e-4)          # radii of specks and glints, m
_REACH = 5e-4                        # of light that the wall throws onto the plate, m


def specks(stack: Stack, count: int, seed: int = 1, darkness: float = 0.7) -> Stack:
    """Dust that lies still on plate, wall and dots.

    :param count: of specks, each up to 0.6 mm across.
    :param darkness: part of the light that it takes.
    """
    left = 1 - darkness * _spots(stack, count, np.random.default_rng(seed))
    return _pictures(stack, [image * left for image in stack.images])


def glints(stack: Stack, count: int, seed: int = 1, strength: float = 1.0) -> Stack:
    """Scratches and grains that shine under one panel, elsewhere under each.

    :param count: per panel.
    :param strength: over what a bright plate sends back.
    """
    random = np.random.default_rng(seed)
    return _with_light(stack, [
        strength * _bright(stack.images[i]) * _spots(stack, count, random) for i in _SINGLES])


def shiny_wall(stack: Stack, bench: Bench, target: RingTarget, part: float) -> Stack:
    """The sides of the wall that face a panel throw some of its light onto the plate beside them.

    :param part: of the light on the plate that comes on top, at the foot of the wall.
    """
    rows, columns = stack.shape
    pixels = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
    normal = bench.where.rotation[:, 2]
    assert stack.camera is not None
    there = plane_points(stack.camera, pixels.astype(np.float64), Plane(
        tuple(normal), float(normal @ bench.where.position)))
    x, y = ((there - bench.where.position) @ bench.where.rotation)[:, :2].T
    radius, azimuth = np.hypot(x, y), np.arctan2(y, x)
    beside = (azimuth >= target.arc[0]) & (azimuth <= target.arc[1])
    added = []
    for i in _SINGLES:
        facing = np.cos(azimuth - i * math.pi / 2)       # E, N, W, S
        outside, inside = radius - target.outer_radius, target.inner_radius - radius
        light = (np.where(outside > 0, facing.clip(0) * np.exp(-outside.clip(0) / _REACH), 0)
                 + np.where(inside > 0, (-facing).clip(0) * np.exp(-inside.clip(0) / _REACH), 0))
        added.append(part * _bright(stack.images[i]) * (light * beside).reshape(stack.shape))
    return _with_light(stack, added)


def _spots(stack: Stack, count: int, random: np.random.Generator) -> NDArray:
    """Where spots are, 0 to 1, (H, W)."""
    assert stack.camera is not None
    rows, columns = stack.shape
    per_metre = stack.camera.fx / stack.camera.camera_standoff
    mask = np.zeros(stack.shape, np.uint8)
    for radius in random.uniform(*_SPECK_SIZES, count) * per_metre:
        # in sixteenths of a pixel
        centre = [round(16 * random.uniform(0, size)) for size in (columns, rows)]
        cv2.circle(mask, centre, round(16 * radius), 255, cv2.FILLED, cv2.LINE_AA, 4)
    return mask / 255


def _bright(image: NDArray) -> float:
    """Grey value of a well-lit part of the plate."""
    return float(np.quantile(image, 0.8))


def _with_light(stack: Stack, added: Sequence[NDArray]) -> Stack:
    images = [image.astype(np.float64) for image in stack.images]
    for i in _SINGLES:
        images[i] += added[i]
        images[_ALL] += added[i] / 4
    return _pictures(stack, images)


def _pictures(stack: Stack, images: Sequence[NDArray]) -> Stack:
    kind = stack.images[0].dtype
    return with_images(stack, [
        np.clip(np.rint(image), 0, np.iinfo(kind).max).astype(kind) for image in images])
