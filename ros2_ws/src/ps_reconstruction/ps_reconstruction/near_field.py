"""From a stack to a photometric problem: light vectors, flat field and scale at the grid nodes.

Near field: each node gets the light vector of every panel at its point of the surface. The
surface is the reference plane plus, after `surface_heights`, the heights found so far.
"""
from dataclasses import replace
from functools import partial

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from ps_head_driver.camera_model import pixel_rays, scaled_camera
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.head_model import CameraGeometry
from ps_head_driver.light_model import light_vectors
from ps_head_driver.stack import Light, Plane, Stack
from ps_reconstruction.bands import for_bands
from ps_reconstruction.integration import Rays, height_from_normals, parallel_rays
from ps_reconstruction.least_squares import solve
from ps_reconstruction.problem import GREY_WEIGHTS, Problem, grid_size
from ps_reconstruction.weighted_integration import integrate

NODES = 40                    # along the longer side: 0.003 degrees off the exact light vectors
COARSE_PIXELS = 320           # longer side of the picture on which height and light alternate
BAD = ErrorCode.RECONSTRUCTION_BAD_STACK
FULL_SCALE = {'uint8': 255.0, 'uint16': 65535.0, 'float32': 1.0}


def node_step(shape: tuple[int, int]) -> int:
    """Node distance in pixels for an image."""
    return max(2, -(-max(shape) // NODES))


def camera_rays(camera: CameraGeometry, shape: tuple[int, int], step: int) -> Rays:
    """Rays of the grid nodes, lens distortion removed."""
    gh, gw = grid_size(shape, step)
    pixels = np.stack(np.meshgrid(np.arange(gw) * step, np.arange(gh) * step), axis=-1)
    nodes = pixel_rays(camera, pixels)[..., :2]
    return Rays(nodes, step, camera.camera_standoff)


def stack_rays(stack: Stack, pixel_pitch: float = 0.0) -> Rays:
    """Rays of a stack; without a camera a parallel projection.

    :param pixel_pitch: m, for stacks without a camera; 0 is unknown, then lengths are in pixels.
    """
    if stack.camera is not None:
        return camera_rays(stack.camera, stack.shape, node_step(stack.shape))
    return parallel_rays(stack.shape, pixel_pitch or 1.0)


def surface_points(rays: Rays, plane: Plane, height: NDArray | float = 0.0) -> NDArray[np.float64]:
    """Points (gh, gw, 3) where the nodes' rays meet the plane, raised by ``height`` (m)."""
    x, y = rays.nodes[..., 0], rays.nodes[..., 1]
    nx, ny, nz = plane.normal
    depth = (nz * rays.standoff - plane.offset - height) / (nz - nx * x - ny * y)
    return np.stack([x * depth, y * depth, rays.standoff - depth], axis=-1)


def check(stack: Stack) -> Stack:
    """The frames that are photometric equations, checked.

    :raises PsError: RECONSTRUCTION_BAD_STACK or RECONSTRUCTION_TOO_FEW_LIGHTS naming the fault.
    """
    if len(stack.lights) != len(stack.images):
        raise PsError(BAD, f'lights: {len(stack.lights)} for {len(stack.images)} images')
    if stack.gain_maps and len(stack.gain_maps) != len(stack.images):
        raise PsError(BAD, f'gain_maps: {len(stack.gain_maps)} for {len(stack.images)} images')
    used = stack.equations()
    if len(used.images) < 3:
        raise PsError(
            ErrorCode.RECONSTRUCTION_TOO_FEW_LIGHTS,
            f'{len(used.images)} of {len(stack.images)} frames are lit by a single panel; '
            'photometric stereo needs at least 3')
    first = used.images[0]
    if first.ndim not in (2, 3) or (first.ndim == 3 and first.shape[2] != 3):
        raise PsError(BAD, f'images: shape {first.shape} is neither mono nor RGB')
    if str(first.dtype) not in FULL_SCALE:
        raise PsError(BAD, f'images: {first.dtype} is not one of {", ".join(FULL_SCALE)}')
    if min(first.shape[:2]) < 2:
        raise PsError(BAD, f'images: {first.shape} is too small')
    for number, image in enumerate(used.images):
        if image.shape != first.shape or image.dtype != first.dtype:
            raise PsError(BAD, f'images[{number}] is {image.shape} {image.dtype}, images[0] is '
                               f'{first.shape} {first.dtype}')
        if image.dtype == np.float32 and not np.isfinite(image).all():
            raise PsError(BAD, f'images[{number}] holds NaN or infinite values')
    for name, extra in (('ambient', used.ambient), ('mask', used.mask)):
        wanted = first.shape if name == 'ambient' else first.shape[:2]
        if extra is not None and extra.shape != wanted:
            raise PsError(BAD, f'{name} is {extra.shape}, images are {first.shape}')
    if used.mask is not None and not used.mask.any():
        raise PsError(BAD, 'mask: no pixel is to be used')
    camera = used.camera
    if camera is not None and (camera.height_px, camera.width_px) != first.shape[:2]:
        raise PsError(BAD, f'camera_info is for {camera.width_px} x {camera.height_px} pixels, '
                           f'images are {first.shape[1]} x {first.shape[0]}')
    for light in used.lights:
        numbers = [*light.position, *light.axis, light.exposure_scale,
                   *np.atleast_1d(light.intensity)]
        if not np.all(np.isfinite(numbers)):
            raise PsError(BAD, f'lights: {light.name or light.panel.name} is not finite')
        if light.exposure_scale <= 0 or np.min(light.intensity) <= 0:
            raise PsError(BAD, f'lights: {light.name or light.panel.name} has no intensity')
    if not np.isfinite([*used.plane.normal, used.plane.offset]).all() or used.plane.normal[2] <= 0:
        raise PsError(BAD, 'plane: the normal must be finite and point to the camera')
    return used


def photometric_problem(
    stack: Stack, near_field: bool = True, saturation: float = 0.98,
    height: NDArray[np.float64] | None = None, bits: int = 0,
) -> Problem:
    """What the solvers need, from a stack that passed `check`.

    :param near_field: light vectors per node; False takes those of the plane's centre for all.
    :param saturation: share of full scale from which on a value counts as saturated.
    :param height: (gh, gw) heights of the surface above the plane at the nodes, m.
    :param bits: of integer pixel values that count; 0: all of the pixel type.
    """
    shape = stack.shape
    dtype = stack.images[0].dtype
    full_scale = FULL_SCALE[str(dtype)]
    if bits and dtype != np.float32:
        full_scale = min(full_scale, 2.0 ** bits - 1)
    step = node_step(shape)
    gh, gw = grid_size(shape, step)
    channels = 3 if stack.images[0].ndim == 3 else 1
    on_plane, view = _plane_points(stack, step)
    on_surface = on_plane
    if near_field and height is not None and stack.camera is not None:
        on_surface = surface_points(
            camera_rays(stack.camera, shape, step), stack.plane, height)
    lights = np.empty((gh, gw, len(stack.images), 3))
    scale = np.empty((len(stack.images), channels))
    normal = np.asarray(stack.plane.normal)
    flat = _flat_at_nodes(stack, step) if stack.gain_maps else None
    centre = np.array([[0.0, 0.0, stack.plane.offset / normal[2]]])
    for t, light in enumerate(stack.lights):
        scale[t] = 1 / (full_scale * light.exposure_scale)
        # a distant light's colour belongs to the frame; a panel's brightness to its light vector
        known = replace(light, intensity=1.0) if light.distant else light
        if light.distant:
            scale[t] /= _channel_intensity(light, channels)
        local = near_field and not light.distant
        vectors = light_vectors(known, on_surface if local else centre)
        if flat is not None:
            # the board's picture already holds s . n (physics.md, Light model)
            board = light_vectors(known, on_plane if local else centre) @ normal
            if np.any(board <= 0):
                raise PsError(BAD, f'lights: {light.name or light.panel.name} does not shine on '
                                   'the plane of the flat field')
            vectors = vectors / board[..., None]
        lights[:, :, t] = vectors
    if not any(light.distant for light in stack.lights) and flat is None:
        # relative radiance to image scale, so that albedo is of the order of 1
        lights /= np.linalg.norm(lights[gh // 2, gw // 2], axis=-1).mean()
    coloured = any(np.ndim(light.intensity) > 0 for light in stack.lights)
    return Problem(
        frames=[np.ascontiguousarray(image) for image in stack.images], lights=lights, step=step,
        scale=scale, clip=1.0 if coloured else float('inf'), reciprocal_flat=flat,
        ambient=None if stack.ambient is None else np.ascontiguousarray(stack.ambient),
        mask=None if stack.mask is None else np.ascontiguousarray(stack.mask, bool),
        saturation=saturation * full_scale, view=view)


def surface_heights(stack: Stack, rounds: int, tolerance: float = 2e-5
                    ) -> tuple[NDArray[np.float64] | None, int]:
    """Alternate height and lighting on a small copy of the pictures.

    Lights vary slowly, so the heights that matter to them do too: a few thousand pixels suffice.

    :param stack: checked; with a camera.
    :param rounds: at most this many.
    :param tolerance: m, median change of the heights at which it ends.
    :returns: heights at the full-size grid nodes (None for no round) and the rounds done.
    """
    if rounds <= 0 or stack.camera is None:
        return None, 0
    small, factor = _reduced(stack)
    assert small.camera is not None
    rays = stack_rays(small)
    step = node_step(small.shape)
    gh, gw = grid_size(small.shape, step)
    columns, rows = np.meshgrid(np.arange(gw) * step, np.arange(gh) * step)
    at_nodes: NDArray[np.float64] = np.zeros((gh, gw))
    height = np.zeros(small.shape, np.float32)
    masked = partial(integrate, steepness=0.0, tolerance=1e-3)
    done = 0
    for done in range(1, rounds + 1):    # noqa: B007
        solution = solve(photometric_problem(small, height=at_nodes), quality=False)
        whole = np.isfinite(solution.normal[..., 2]).all()
        height = height_from_normals(
            solution.normal, rays, small.plane.normal, small.plane.offset,
            solver=None if whole else masked)
        height[~np.isfinite(height)] = 0
        height = np.asarray(cv2.GaussianBlur(height, (0, 0), step / 2))
        new = _sample(height, columns, rows)
        change = float(np.median(np.abs(new - at_nodes)))
        at_nodes = new
        if change < tolerance:
            break
    full_step = node_step(stack.shape)
    gh, gw = grid_size(stack.shape, full_step)
    u, v = np.meshgrid(np.arange(gw) * full_step, np.arange(gh) * full_step)
    return _sample(height, (u + 0.5) / factor - 0.5, (v + 0.5) / factor - 0.5), done


def _plane_points(stack: Stack, step: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points of the plane and unit view vectors at the nodes."""
    gh, gw = grid_size(stack.shape, step)
    if stack.camera is None:
        return np.zeros((gh, gw, 3)), np.broadcast_to((0.0, 0.0, 1.0), (gh, gw, 3)).copy()
    rays = camera_rays(stack.camera, stack.shape, step)
    view = np.concatenate([-rays.nodes, np.ones((gh, gw, 1))], axis=-1)
    return (surface_points(rays, stack.plane),
            view / np.linalg.norm(view, axis=-1, keepdims=True))


def _channel_intensity(light: Light, channels: int) -> NDArray[np.float64]:
    intensity = np.broadcast_to(np.asarray(light.intensity, np.float64), (3,))
    if channels == 3:
        return intensity
    return np.array([intensity @ np.array(GREY_WEIGHTS) / sum(GREY_WEIGHTS)])


def _flat_at_nodes(stack: Stack, step: int) -> NDArray[np.float64]:
    """Reciprocal of the gain maps at the nodes, (gh, gw, T); smoothed to the node distance."""
    gh, gw = grid_size(stack.shape, step)
    out = np.empty((gh, gw, len(stack.gain_maps)))
    for t, gain in enumerate(stack.gain_maps):
        gain = np.asarray(gain, np.float32)
        if gain.ndim != 2 or not gain.size or not np.isfinite(gain).all() or gain.max() <= 0:
            raise PsError(BAD, f'gain_maps[{t}]: not a positive single-channel picture')
        ratio = np.array(gain.shape) / stack.shape
        # dust and noise of the board must not be divided into the part
        sigma = 0.5 * step * float(ratio.mean())
        if sigma > 0.3:
            gain = np.asarray(cv2.GaussianBlur(gain, (0, 0), sigma))
        columns = (np.arange(gw) * step + 0.5) * ratio[1] - 0.5
        rows = (np.arange(gh) * step + 0.5) * ratio[0] - 0.5
        values = _sample(gain, *np.meshgrid(columns, rows))
        if values.min() <= 0.001 * gain.max():
            raise PsError(BAD, f'gain_maps[{t}]: the flat field is dark in places')
        out[:, :, t] = 1 / values
    return out


def _sample(image: NDArray, columns: NDArray, rows: NDArray) -> NDArray[np.float64]:
    """Bilinear samples; beyond the border the border's values."""
    return np.asarray(cv2.remap(
        np.asarray(image, np.float32), columns.astype(np.float32), rows.astype(np.float32),
        cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float64)


def _reduced(stack: Stack) -> tuple[Stack, int]:
    """Pictures averaged over whole blocks of pixels, with the camera to match."""
    factor = max(1, -(-max(stack.shape) // COARSE_PIXELS))
    if factor == 1 or stack.camera is None:
        return stack, 1
    rows, columns = (max(2, n // factor) for n in stack.shape)

    def shrink(image: NDArray) -> NDArray[np.float32]:
        return _block_means(image, factor, rows, columns, 1 / FULL_SCALE[str(image.dtype)])

    # the last rows and columns that fill no block are cut off
    cut = stack.camera.model_copy(update={
        'width_px': columns * factor, 'height_px': rows * factor})
    camera = scaled_camera(cut, columns, rows)
    # a block counts if all its pixels do
    mask = None if stack.mask is None else shrink(stack.mask.astype(np.float32)) > 0.999
    return replace(
        stack, images=[shrink(image) for image in stack.images], camera=camera,
        ambient=None if stack.ambient is None else shrink(stack.ambient),
        mask=mask), factor


def _block_means(image: NDArray, factor: int, rows: int, columns: int, scale: float
                 ) -> NDArray[np.float32]:
    """Mean of factor x factor pixels, times ``scale``; worth more than the 8 bits of a pixel."""
    planes = image.reshape(len(image), -1)
    out = np.empty((rows, columns, image[0, 0].size), np.float32)
    for_bands(rows, 8, lambda i, j: _block_rows(
        planes[i * factor:j * factor], factor, np.float32(scale / factor ** 2), out[i:j]))
    return out.reshape(rows, columns, *image.shape[2:])


@numba.njit(nogil=True, cache=True)
def _block_rows(planes, factor, scale, out):    # type: ignore[no-untyped-def]
    rows, columns, channels = out.shape
    # sums over the rows first, which is vectorised; exact for integers
    line = np.empty(columns * factor * channels, np.float32)
    for y in range(rows):
        line[:] = np.float32(0)
        for b in range(factor):
            row = planes[y * factor + b]
            for i in range(len(line)):
                line[i] += np.float32(row[i])
        for x in range(columns):
            for c in range(channels):
                total = np.float32(0)
                for a in range(factor):
                    total += line[(x * factor + a) * channels + c]
                out[y, x, c] = total * scale
