"""Pictures of a depth map under distant lights, with shadows, gloss and light from neighbours.

Shares nothing with the solver: microfacet reflectance (Cook-Torrance with GGX, Oren-Nayar), cast
shadows by marching over the depth map, one bounce of diffuse light by Monte Carlo.
"""
from dataclasses import dataclass
from pathlib import Path

import numba
import numpy as np
from numpy.typing import NDArray

BOUNCES = 24           # directions per pixel in which light from neighbours is looked for
NOISE = 0.002          # standard deviation, of full scale
LEVEL = 0.7            # of full scale, reached by the brightest per cent


@dataclass(frozen=True)
class Material:
    """How a surface reflects.

    :param diffuse: albedo of the body.
    :param alpha: GGX roughness of the gloss.
    :param f0: reflectance of the gloss at normal incidence; 0 is matt.
    :param grain: Oren-Nayar roughness of the body, rad; 0 is Lambert's law.
    :param bounce: whether diffuse light from neighbours counts.
    """

    diffuse: float
    alpha: float = 0.3
    f0: float = 0.0
    grain: float = 0.0
    bounce: bool = False


MATERIALS = {
    'matt': Material(0.7), 'glossy': Material(0.5, 0.2, 0.05),
    'metal-like': Material(0.0, 0.35, 0.8), 'satin': Material(0.4, 0.4, 0.08),
    'smooth metal': Material(0.03, 0.2, 0.8),
    'black gloss': Material(0.06, 0.15, 0.05), 'clay': Material(0.6, grain=0.6),
    'white, light bounces': Material(0.9, bounce=True)}
MIXED = {      # two materials in patches; matt with a texture of albedo 0.15 to 0.9
    'matt and metal': ('matt', 'metal-like'), 'matt and gloss': ('matt', 'glossy'),
    'textured': ('matt', 'matt')}


@dataclass(frozen=True)
class Shape:
    """Visible pixels of a depth map, P of them, and what they see of the lights.

    :param mask: (h, w) bool, P of them True.
    :param normal, view: (P, 3), n_plane and unit vectors to the camera.
    :param seen: (P, T) bool, not in a cast shadow.
    :param neighbours: (P, BOUNCES) pixel that a diffuse ray meets; -1 or P for none.
    """

    name: str
    mask: NDArray
    normal: NDArray
    view: NDArray
    directions: NDArray
    seen: NDArray
    neighbours: NDArray

    @classmethod
    def load(cls, file: Path, directions: NDArray, stride: int = 1) -> 'Shape':
        """Read a file of shared/data/diligent_depth and trace its shadows.

        :param directions: (T, 3) unit vectors to the lights.
        :param stride: 2 takes every other pixel of every other row, to be quick.
        """
        with np.load(file) as arrays:
            normal, camera = arrays['normal'].astype(float), arrays['K']
            depth, mask = arrays['depth_mm'].astype(float), arrays['mask'].astype(bool)
        mask &= np.isfinite(depth) & (np.linalg.norm(normal, axis=-1) > 0.5)
        taken = np.zeros_like(mask)
        taken[::stride, ::stride] = mask[::stride, ::stride]
        v, u = np.nonzero(taken)
        z = depth[taken]
        point = np.stack([(u - camera[0, 2]) / camera[0, 0] * z,
                          -(v - camera[1, 2]) / camera[1, 1] * z, -z], axis=-1)
        n = normal[taken]
        view = -point / np.linalg.norm(point, axis=1, keepdims=True)
        index = np.where(mask, len(z), -1)
        index[taken] = np.arange(len(z))
        if stride > 1:      # the others stand for the one that is taken
            rows, columns = (np.arange(length) // stride * stride for length in mask.shape)
            index = np.where(mask, index[rows][:, columns], -1)
        rays = np.repeat(directions[None], len(z), axis=0)
        seen = _march(point, rays, depth, index, camera) < 0
        rng = np.random.default_rng(0)
        ray = rng.normal(size=(len(z), BOUNCES, 3))
        ray = n[:, None] * 1.0001 + ray / np.linalg.norm(ray, axis=-1, keepdims=True)
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)           # cosine distribution
        return cls(file.stem, mask[::stride, ::stride], n, view, directions, seen,
                   _march(point, ray, depth, index, camera))

    def window(self) -> tuple[slice, slice]:
        """The part of the picture that holds the object."""
        rows, columns = np.nonzero(self.mask)
        return (slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1))

    def render(self, material: str) -> NDArray[np.float64]:
        """Intensities (P, T), noisy, full scale 1: of MATERIALS or MIXED."""
        if material in MIXED:
            one, two = (self._shade(MATERIALS[name]) for name in MIXED[material])
            v, u = np.nonzero(self.mask)
            patch = (np.sin(u / 17) + np.sin(v / 13 + u / 29) > 0)[:, None]
            texture = np.random.default_rng(1).uniform(0.5, 1, (len(v), 1))
            if material == 'textured':
                two = two * 0.3
            value = np.where(patch, one / np.percentile(one, 99), two / np.percentile(
                two, 99 if material != 'textured' else 100)) * texture
        else:
            value = self._shade(MATERIALS[material])
        value = value * LEVEL / np.percentile(value, 99)
        value += NOISE * np.random.default_rng(0).normal(size=value.shape)
        return np.asarray(np.clip(value, 0, 1))

    def _shade(self, material: Material) -> NDArray:
        n_l = self.normal @ self.directions.T
        n_v = np.clip(np.sum(self.normal * self.view, axis=1), 0.02, 1)[:, None]
        half = self.directions + self.view[:, None]
        half /= np.linalg.norm(half, axis=-1, keepdims=True)
        value = np.full(n_l.shape, material.diffuse / np.pi)
        if material.grain:
            value *= _oren_nayar(n_l, n_v, self.directions, self.view, self.normal, material.grain)
        if material.f0:
            n_h = np.clip(np.einsum('pi,pti->pt', self.normal, half), 0, 1)
            value = value + _ggx(n_l, n_h, n_v, np.einsum('ti,pti->pt', self.directions, half),
                                 material.alpha, material.f0)
        value = value * np.maximum(n_l, 0) * self.seen
        if material.bounce:
            sources = np.concatenate([value, np.zeros((1, value.shape[1]))])     # -1: nothing
            value = value + material.diffuse * sources[self.neighbours].mean(axis=1)
        return value


def _ggx(n_l: NDArray, n_h: NDArray, n_v: NDArray, l_h: NDArray, alpha: float, f0: float
         ) -> NDArray:
    """Cook-Torrance reflectance: GGX distribution, Smith's shadowing, Schlick's Fresnel."""
    square = alpha * alpha
    distribution = square / (np.pi * (n_h ** 2 * (square - 1) + 1) ** 2)

    def shadowing(cosine: NDArray) -> NDArray:
        return 2 * cosine / (cosine + np.sqrt(square + (1 - square) * cosine ** 2))

    fresnel = f0 + (1 - f0) * (1 - l_h) ** 5
    lit = np.maximum(n_l, 1e-3)
    result: NDArray = distribution * shadowing(lit) * shadowing(n_v) * fresnel / (4 * lit * n_v)
    return result


def _oren_nayar(n_l: NDArray, n_v: NDArray, light: NDArray, view: NDArray, normal: NDArray,
                sigma: float) -> NDArray:
    """Factor on Lambert's law of a rough body (Oren and Nayar 1994, first order)."""
    a = 1 - 0.5 * sigma ** 2 / (sigma ** 2 + 0.33)
    b = 0.45 * sigma ** 2 / (sigma ** 2 + 0.09)
    lit = np.clip(n_l, 1e-3, 1)
    flat_v = view - n_v * normal
    flat_l = light[None] - n_l[..., None] * normal[:, None]
    cosine = np.einsum('pi,pti->pt', flat_v, flat_l) / np.maximum(
        np.linalg.norm(flat_v, axis=1)[:, None] * np.linalg.norm(flat_l, axis=2), 1e-9)
    sines = np.sqrt(1 - lit ** 2) * np.sqrt(1 - n_v ** 2)
    result: NDArray = a + b * np.maximum(cosine, 0) * sines / np.maximum(lit, n_v)
    return result


@numba.njit(cache=True)
def _march(point, rays, depth, index, camera):    # type: ignore[no-untyped-def]
    """Pixel of the depth map that each ray meets first, or -1.

    :param point: (P, 3) mm, z = -depth; rays: (P, K, 3) unit vectors.
    :param index: (h, w) number of the pixel's point, -1 outside the object.
    """
    rows, columns = depth.shape
    fx, fy, cx, cy = camera[0, 0], camera[1, 1], camera[0, 2], camera[1, 2]
    met = np.full(rays.shape[:2], -1)
    for p in range(len(point)):
        pitch = -point[p, 2] / fx
        for k in range(rays.shape[1]):
            step = 3.0
            while step < 600:
                x, y, z = point[p] + pitch * step * rays[p, k]
                row, column = round(cy - fy * y / -z), round(cx + fx * x / -z)
                if not (0 <= row < rows and 0 <= column < columns):
                    break
                if index[row, column] >= 0 and -depth[row, column] > z + pitch * (
                        0.3 + 0.002 * step):
                    met[p, k] = index[row, column]
                    break
                step = step * 1.03 + 0.5
    return met
