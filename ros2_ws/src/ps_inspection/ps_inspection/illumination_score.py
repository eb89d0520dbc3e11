"""How good the normals of one illumination are, judged from pictures alone.

Every stack of a search shows the same surface, and all its pictures together say more about it
than the four of one setting: with eight and more lights, shadows and highlights stand out. So

    error of a setting = its noise  (+)  how far its four-light normals are from the consensus

in blocks of pixels. The noise comes from the pictures, too: four lights leave one combination of
their values that is zero for every matt surface (I_E + I_W - I_N - I_S for an even ring), and what
remains of it between neighbouring pixels is noise. Light adds linearly, so that the same consensus
also predicts noise and attached shadows of settings that nobody has taken a picture of; gloss and
cast shadows can only add to that.
"""
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ps_head_driver.camera_model import plane_points, scaled_camera
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.light_model import light_vectors
from ps_head_driver.stack import Light, Stack
from ps_reconstruction.near_field import FULL_SCALE, check, photometric_problem
from ps_reconstruction.problem import expand, intensities

LONGER_SIDE = 100         # blocks
NOISE_PIXELS = 20_000     # drawn to measure the noise
SATURATED, SHADOWED = 0.98, 0.1    # of full scale; of the brightest of the four lights
GLOSS_WIDTH = 0.3         # tangent of the half-vector's angle at which gloss has lost 3/4
GLOSS_SHARE = 0.3         # of the diffuse light at its peak, as expected before any picture
OUTLIER = 3.0             # deviations at which a value counts half
ROUNDS = 12


@dataclass(frozen=True)
class Region:
    """Part of the picture that counts, in pixels; a width or height of 0 means all."""

    x: int = 0
    y: int = 0
    width: int = 0
    height: int = 0

    def slices(self, shape: tuple[int, int]) -> tuple[slice, slice]:
        """Rows and columns.

        :raises PsError: INSPECTION_BAD_REQUEST if it is not in the picture or tiny.
        """
        if self.width == 0 or self.height == 0:
            return slice(0, shape[0]), slice(0, shape[1])
        if (min(self.x, self.y) < 0 or min(self.width, self.height) < 16
                or self.x + self.width > shape[1] or self.y + self.height > shape[0]):
            raise PsError(ErrorCode.INSPECTION_BAD_REQUEST,
                          f'roi: {self.width} x {self.height} at ({self.x}, {self.y}) must be 16 '
                          f'pixels or more and inside the picture of {shape[1]} x {shape[0]}')
        return slice(self.y, self.y + self.height), slice(self.x, self.x + self.width)


@dataclass
class Blocks:
    """One stack of four lights, reduced to B blocks of pixels.

    :param values: (B, 4) mean normalised intensities.
    :param vectors: (B, 4, 3) light vectors.
    :param view: (B, 3) unit vectors to the camera.
    :param points: (B, 3) on the plane, m.
    :param saturated: (B, 4) share of saturated pixels.
    :param brightness: of the light vectors, in units of a panel's radiance.
    :param noise: sigma of a pixel's value over the root of that value (shot noise).
    :param pixels: of one block.
    """

    values: NDArray
    vectors: NDArray
    view: NDArray
    points: NDArray
    saturated: NDArray
    brightness: float
    noise: float
    pixels: int

    @property
    def shadowed(self) -> NDArray:
        """Values in shadow, (B, 4) bool: far below the brightest of their block."""
        relative = self.values / self.vectors[..., 2]
        return np.asarray(relative < SHADOWED * relative.max(axis=-1, keepdims=True))

    @property
    def inverse(self) -> NDArray:
        """Least squares: (B, 3, 4), scaled normal from values."""
        return np.linalg.pinv(self.vectors)


def brightness(lights: Sequence[Light], stack: Stack) -> float:
    """Mean length of the light vectors in the middle of the plane, panel radiance 1."""
    centre = np.array([0.0, 0.0, stack.plane.offset / stack.plane.normal[2]])
    return float(np.mean([np.linalg.norm(light_vectors(light, centre)) for light in lights]))


def reduce_stack(stack: Stack, region: Region = Region()) -> Blocks:
    """Blocks of a stack of four single panels.

    :raises PsError: RECONSTRUCTION_* for a stack that cannot be reconstructed either,
        INSPECTION_BAD_REQUEST for a region outside the picture.
    """
    stack = check(stack)
    if len(stack.images) != 4 or stack.camera is None:
        raise PsError(ErrorCode.RECONSTRUCTION_BAD_STACK,
                      'a probe needs four frames of single panels and a camera with intrinsics')
    rows, columns = region.slices(stack.shape)
    size = max(1, -(-max(rows.stop - rows.start, columns.stop - columns.start) // LONGER_SIDE))
    full = FULL_SCALE[str(stack.images[0].dtype)]
    grey = [image if image.ndim == 2 else image.max(axis=2) for image in stack.images]
    small = (-(-stack.shape[1] // size), -(-stack.shape[0] // size))

    def shrink(image: NDArray) -> NDArray:
        return np.asarray(cv2.resize(np.asarray(image, np.float32), small,
                                     interpolation=cv2.INTER_AREA))

    camera = scaled_camera(stack.camera, *small)
    reduced = replace(
        stack, images=[shrink(image) / np.float32(full) for image in stack.images],
        ambient=None if stack.ambient is None else shrink(stack.ambient) / np.float32(full),
        mask=None, camera=camera)
    problem = photometric_problem(reduced)
    assert problem.view is not None
    inside = np.zeros(small[::-1], bool)
    inside[rows.start // size:-(-rows.stop // size), columns.start // size:
           -(-columns.stop // size)] = True
    if stack.mask is not None:
        inside &= shrink(stack.mask) > 0.999
    values = intensities(problem)[inside]
    vectors = expand(problem.lights, problem.step, problem.shape)[inside]
    blocks = Blocks(
        values, vectors, expand(problem.view, problem.step, problem.shape)[inside],
        plane_points(camera, np.argwhere(inside)[:, ::-1], stack.plane),
        np.stack([shrink(image >= SATURATED * full)[inside] for image in grey], axis=-1),
        brightness(stack.lights, stack), 0.0, size * size)
    # from raw counts to normalised values
    raw = np.stack([image if image.ndim == 2 else image.mean(axis=2)
                    for image in reduced.images], axis=-1)[inside]
    blocks.noise = _noise(grey, full, rows, columns, size, inside, blocks,
                          values / np.maximum(raw, 1e-6))
    return blocks


def _noise(frames: Sequence[NDArray], full: float, rows: slice, columns: slice, size: int,
           inside: NDArray, blocks: Blocks, gain: NDArray) -> float:
    """Noise of a pixel, see Blocks, from what neighbours differ in the redundant combination."""
    number = np.full(inside.shape, -1)
    number[inside] = np.arange(np.count_nonzero(inside))
    random = np.random.default_rng(0)
    y = random.integers(rows.start, rows.stop, NOISE_PIXELS)
    x = random.integers(columns.start, columns.stop - 1, NOISE_PIXELS)
    block = number[y // size, x // size]
    y, x, block = y[block >= 0], x[block >= 0], block[block >= 0]
    here, beside = (np.stack([frame[y, x + k] for frame in frames], axis=-1) / full * gain[block]
                    for k in (0, 1))
    # the left null vector of the 4 x 3 light matrix
    redundant = np.linalg.svd(blocks.vectors[block])[0][..., 3]
    difference = np.sum(redundant * (here - beside), axis=-1)
    expected = np.sum(redundant ** 2 * np.maximum(here + beside, 1e-4), axis=-1)
    # median of chi-square with one degree of freedom; robust against edges of gloss and shadow
    return float(np.sqrt(np.median(difference ** 2 / expected) / 0.4549))


@dataclass(frozen=True)
class Consensus:
    """What several stacks of one surface say together.

    :param normals: (B, 3) albedo times normal, in units of the first probe's light.
    :param gains: brightness of each probe in these units; rings need not be calibrated against
        each other.
    """

    normals: NDArray
    gains: list[float]


def consensus(probes: Sequence[Blocks]) -> Consensus:
    """Scaled normals that explain all pictures best, shadows and highlights left out."""
    own = [_times(probe.inverse, probe.values) for probe in probes]
    length = [np.linalg.norm(g, axis=-1) for g in own]
    gains = [float(np.median(other / np.maximum(length[0], 1e-9))) for other in length]
    values = np.concatenate([probe.values / gain
                             for probe, gain in zip(probes, gains, strict=True)], axis=1)
    vectors = np.concatenate([probe.vectors for probe in probes], axis=1)
    norm = np.linalg.norm(vectors, axis=-1)
    prior = GLOSS_SHARE * np.concatenate([_gloss(probe) for probe in probes], axis=1)
    noise = np.concatenate([
        np.broadcast_to(probe.noise / np.sqrt(probe.pixels * gain), probe.values.shape)
        for probe, gain in zip(probes, gains, strict=True)], axis=1)
    clipped = np.concatenate([probe.saturated for probe in probes], axis=1)
    dark = np.concatenate([probe.shadowed for probe in probes], axis=1)
    weight = np.where(dark | (clipped > 0.01), 1e-6, 1.0)
    g = own[0]
    for _ in range(ROUNDS):
        level = np.linalg.norm(g, axis=-1, keepdims=True) * norm
        sigma = np.sqrt(noise ** 2 * np.maximum(values, 1e-4) + (prior * level) ** 2
                        + (0.003 * level) ** 2) / np.maximum(level, 1e-9)
        excess = (values - _times(vectors, g)) / np.maximum(level, 1e-9)
        w = weight / sigma ** 2 / (1 + (excess / (OUTLIER * sigma)) ** 2) / norm ** 2
        weighted = (w[..., None] * vectors).swapaxes(1, 2)
        a = weighted @ vectors
        a += 1e-9 * np.trace(a, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        g = np.linalg.solve(a, _times(weighted, values)[..., None])[..., 0]
    return Consensus(g, gains)


def _gloss(probe: Blocks) -> NDArray:
    """What a highlight on the flat part would have left at each block and light, 1 at its peak."""
    towards = probe.vectors / np.linalg.norm(probe.vectors, axis=-1, keepdims=True)
    half = towards + probe.view[:, None, :]
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    tangent_squared = 1 / np.maximum(half[..., 2], 1e-3) ** 2 - 1
    return np.asarray(1 / (1 + tangent_squared / GLOSS_WIDTH ** 2) ** 2)


def normals_noise(inverse: NDArray, values: NDArray, g: NDArray, noise: float) -> NDArray:
    """RMS angle (B,), rad, that the noise of single pixels turns the normal g by."""
    variance = noise ** 2 * np.maximum(values, 1e-4)
    covariance = (inverse * variance[:, None, :]) @ inverse.swapaxes(1, 2)
    length = np.linalg.norm(g, axis=-1)
    n = g / np.maximum(length, 1e-9)[:, None]
    across = np.trace(covariance, axis1=1, axis2=2) - np.sum(n * _times(covariance, n), axis=-1)
    return np.asarray(np.sqrt(np.maximum(across, 0)) / np.maximum(length, 1e-9))


def _times(matrices: NDArray, vectors: NDArray) -> NDArray:
    """(B, m, n) times (B, n)."""
    return np.asarray((matrices @ vectors[..., None])[..., 0])


def angle(a: NDArray, b: NDArray) -> NDArray:
    """Angle between vectors of any length, (B, 3) each, to (B,), rad."""
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))


def error_of(probe: Blocks, normals: NDArray) -> float:
    """Expected angular error of a probe's own normals, rad, given those of the consensus."""
    inverse = probe.inverse
    own = _times(inverse, probe.values)
    noise = normals_noise(inverse, probe.values, own, probe.noise)
    off = angle(own, normals) ** 2 - noise ** 2 / probe.pixels
    return float(np.mean(np.sqrt(noise ** 2 + np.maximum(off, 0))))


def least_error(vectors: NDArray, g: NDArray, noise: float) -> float:
    """The same for light vectors (B, 4, 3) without pictures: noise and attached shadows only.

    :param g: (B, 3) scaled normals that go with these vectors.
    """
    values = np.maximum(_times(vectors, g), 0)
    inverse = np.linalg.pinv(vectors)
    own = _times(inverse, values)
    return float(np.mean(np.hypot(normals_noise(inverse, values, own, noise), angle(own, g))))
