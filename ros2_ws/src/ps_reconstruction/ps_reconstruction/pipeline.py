"""One stack in, all asked-for surface quantities out. Pure and deterministic, no ROS."""
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
import time

import numpy as np
from numpy.typing import NDArray

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.stack import Geometry, Stack
from ps_reconstruction import integration, least_squares, preview, surface
from ps_reconstruction.near_field import (
    COARSE_PIXELS,
    check,
    photometric_problem,
    stack_rays,
    surface_heights,
)
from ps_reconstruction.problem import MAX_PATCH, Problem, Solution
from ps_reconstruction.surface import Roughness
from ps_reconstruction.weighted_integration import integrate

METHODS = ('ls', 'stv')
WHOLE = 0.98                  # share of valid pixels from which the fast integration is right
FORMS = ('auto', 'none', 'plane', 'slow')
TRUSTS = ('auto', 'least_squares', 'rejection', 'reflectance')
OUTPUTS = ('normal', 'slope', 'albedo', 'height', 'curvature', 'shape', 'confidence', 'reason',
           'preview', 'roughness')


@dataclass(frozen=True)
class Options:
    """How to reconstruct; the defaults suit quasi-planar machined parts.

    :param method: 'ls' or 'stv'.
    :param trust: how far 'stv' departs from least squares: 'auto' chooses for every stack, the
        other TRUSTS fix it.
    :param patch: width of the neighbourhood of 'stv', px, odd; 1 for none.
    :param near_field: light vectors per pixel from the panel geometry.
    :param height_rounds: alternations of height and lighting, 0 for none.
    :param careful: integrate with confidence weights and height steps. Else by cosine transform,
        or over the valid pixels only where many are not.
    :param form: what is removed from the height: 'none', 'plane' (the one that fits best), 'slow'
        (all slow form; the picture's longer side / 16) or 'auto': 'slow' where the lights are
        assumed, so that their error is not taken for form, else 'none'.
    :param bits: of a pixel value that count, for cameras with 10, 12 or 14 bits in 16 (lower
        ones); 0: all of the pixel type.
    :param saturation: share of full scale that counts as saturated.
    :param smoothness: sigma of the smoothing of shape and curvature, px.
    :param flattening: length beyond which form is removed from the shape, px; 0 takes a 150th of
        the longer side.
    :param contrast: of the shape, 1 is normal.
    :param s_filter: roughness S-filter nesting index, m; 0 for none.
    :param l_filter: roughness L-filter nesting index, m.
    :param pixel_pitch: m, for stacks without a camera; 0: unknown.
    """

    method: str = 'ls'
    trust: str = 'auto'
    patch: int = 5
    near_field: bool = True
    height_rounds: int = 2
    careful: bool = False
    form: str = 'auto'
    bits: int = 0
    saturation: float = 0.98
    smoothness: float = 1.0
    flattening: float = 0.0
    contrast: float = 1.0
    s_filter: float = 0.0
    l_filter: float = 0.8e-3
    pixel_pitch: float = 0.0

    def __post_init__(self) -> None:
        def refuse(name: str, what: str) -> None:
            raise PsError(ErrorCode.RECONSTRUCTION_BAD_PARAMETER,
                          f'{name}: {getattr(self, name)!r} {what}')
        for name, choices in (('method', METHODS), ('trust', TRUSTS), ('form', FORMS)):
            if getattr(self, name) not in choices:
                refuse(name, f'is not one of {", ".join(choices)}')
        for name in ('smoothness', 'flattening', 's_filter', 'pixel_pitch', 'height_rounds'):
            if not 0 <= getattr(self, name) < float('inf'):
                refuse(name, 'must not be negative')
        for name in ('contrast', 'l_filter', 'saturation'):
            if not 0 < getattr(self, name) < float('inf'):
                refuse(name, 'must be positive')
        if self.patch % 2 == 0 or not 1 <= self.patch <= MAX_PATCH:
            refuse('patch', f'is not an odd number from 1 to {MAX_PATCH}')
        if self.bits and not 8 <= self.bits <= 16:
            refuse('bits', 'is neither 0 nor 8 to 16')


@dataclass
class Reconstruction:
    """What was asked for of one stack; the rest is None.

    Shapes and units: normal (H, W, 3) n_plane; slope (H, W, 2); albedo (H, W) or (H, W, 3)
    relative; height (H, W) m above the reference plane, median 0; curvature (H, W) 1/m; all
    float32, NaN where invalid. shape, confidence (H, W) uint8; preview (H, W, 3) uint8 RGB; reason
    (H, W) uint8, bits of problem.py.

    :param metric: lengths are metres; False if the scale is unknown (then pixels).
    """

    method: str
    near_field: bool
    metric: bool
    normal: NDArray[np.float32]
    mask: NDArray[np.bool_]
    pixel_pitch: float
    slope: NDArray[np.float32] | None = None
    albedo: NDArray[np.float32] | None = None
    height: NDArray[np.float32] | None = None
    curvature: NDArray[np.float32] | None = None
    shape: NDArray[np.uint8] | None = None
    confidence: NDArray[np.uint8] | None = None
    reason: NDArray[np.uint8] | None = None
    preview: NDArray[np.uint8] | None = None
    roughness: Roughness = field(default_factory=Roughness)
    timings: dict[str, float] = field(default_factory=dict)
    valid_fraction: float = 0.0
    residual_rms: float = float('nan')


def reconstruct(
    stack: Stack, options: Options | None = None, outputs: set[str] | None = None,
    on_ready: Callable[[Reconstruction, str], None] = lambda result, name: None,
) -> Reconstruction:
    """Reconstruct a stack.

    :param outputs: names of OUTPUTS; None for all. Only these and what they need are computed.
    :param on_ready: called with the name of a wanted picture as soon as the result holds it.
    :raises PsError: RECONSTRUCTION_* naming what is wrong with the stack or an option.
    """
    options = options or Options()
    wanted = set(OUTPUTS) if outputs is None else set(outputs)
    if wanted - set(OUTPUTS):
        raise PsError(ErrorCode.RECONSTRUCTION_BAD_PARAMETER,
                      f'outputs: {", ".join(sorted(wanted - set(OUTPUTS)))}: not among '
                      + ', '.join(OUTPUTS))
    timings: dict[str, float] = {}
    with _timed(timings, 'lights'):
        stack = check(stack)
        near = options.near_field and any(not light.distant for light in stack.lights)
        if near and stack.camera is None:
            raise PsError(ErrorCode.RECONSTRUCTION_BAD_STACK,
                          'camera_info: near lights need camera intrinsics (focal length is 0); '
                          'set near_field to false to do without')
        heights = None
        if near:
            heights, _ = surface_heights(stack, options.height_rounds)
        problem = photometric_problem(stack, near, options.saturation, heights, options.bits)
    with _timed(timings, 'normals'):
        careful = options.careful and 'height' in wanted
        quality = careful or not wanted.isdisjoint({'confidence', 'reason'})
        solution = _solve(problem, options, quality)
        valid = np.isfinite(solution.normal[..., 2])
    rays = stack_rays(stack, options.pixel_pitch)
    pitch = _pitch(stack, options)
    result = Reconstruction(
        options.method, near, stack.camera is not None or options.pixel_pitch > 0,
        solution.normal, valid, pitch, residual_rms=solution.residual_rms, timings=timings)
    # pixels that the mask leaves out are no failures
    used = valid.size if stack.mask is None else np.count_nonzero(stack.mask)
    result.valid_fraction = np.count_nonzero(valid) / used
    if 'slope' in wanted:
        with _timed(timings, 'slope'):
            result.slope = surface.slope(solution.normal)
        on_ready(result, 'slope')
    if 'normal' in wanted:
        on_ready(result, 'normal')
    for name in ('albedo', 'confidence', 'reason'):
        if name in wanted:
            setattr(result, name, getattr(solution, name))
            on_ready(result, name)
    if 'curvature' in wanted:
        with _timed(timings, 'curvature'):
            result.curvature = surface.mean_curvature(
                solution.normal, pitch, options.smoothness)
        on_ready(result, 'curvature')
    if 'preview' in wanted:
        with _timed(timings, 'preview'):
            result.preview = preview.normal_preview(solution.normal)
        on_ready(result, 'preview')
    if wanted & {'height', 'shape', 'roughness'}:
        _integrate(result, stack, rays, options, wanted, solution, on_ready)
    return result


def warm_up(method: str = 'ls') -> None:
    """Compile the kernels of a method on a small stack, so that the first real one is not late."""
    from ps_head_driver.head_model import CameraGeometry
    from ps_head_driver.stack import Light, Panel
    # as large as it must be to be treated like a real one: in bands, and reduced for the rounds
    # of height and light
    shape = (COARSE_PIXELS + 1, 40)
    camera = CameraGeometry(width_px=shape[1], height_px=shape[0], fx=2000, fy=2000,
                            cx=shape[1] / 2, cy=shape[0] / 2, camera_standoff=0.3)
    lights = [Light(panel=Panel(i), position=(0.1 * c, 0.1 * s, 0.12), size=(0.06, 0.03),
                    axis=(-0.64 * c, -0.64 * s, -0.768375), right=(-s, c, 0.0))
              for i, (c, s) in enumerate([(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)])]
    for dtype in (np.uint8, np.uint16):
        images = [np.full(shape, 100, dtype) for _ in lights]
        for trust in ('least_squares', 'reflectance') if method == 'stv' else ('auto',):
            reconstruct(Stack(images, lights, camera), Options(method=method, trust=trust))


@contextmanager
def _timed(timings: dict[str, float], stage: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    timings[stage] = time.perf_counter() - start


def _solve(problem: Problem, options: Options, quality: bool) -> Solution:
    if options.method == 'stv':
        from ps_reconstruction import stv  # loaded only when it is used
        trust = None if options.trust == 'auto' else stv.Trust[options.trust.upper()]
        return stv.solve(problem, stv.StvOptions(patch=options.patch, trust=trust), quality)
    return least_squares.solve(problem, quality=quality)


def _pitch(stack: Stack, options: Options) -> float:
    """Pixel distance on the reference plane at the optical axis, m (1 if unknown)."""
    if stack.camera is None:
        return options.pixel_pitch or 1.0
    depth = stack.camera.camera_standoff - stack.plane.offset / stack.plane.normal[2]
    pitch = depth / stack.camera.fx
    if not 1e-12 < pitch < 1e3:
        raise PsError(ErrorCode.RECONSTRUCTION_BAD_STACK,
                      f'camera_info, plane: a pixel would be {pitch:g} m wide')
    return pitch


def _integrate(result: Reconstruction, stack: Stack, rays: integration.Rays, options: Options,
               wanted: set[str], solution: Solution,
               on_ready: Callable[[Reconstruction, str], None]) -> None:
    timings = result.timings
    plane = stack.plane
    with _timed(timings, 'gradients'):
        du, dv = integration.gradients(result.normal, rays)
    if 'height' in wanted:
        with _timed(timings, 'height'):
            solver: Callable[..., NDArray[np.float32]] = integration.poisson
            if options.careful:
                pitch = 1 / stack.camera.fx if stack.camera is not None else result.pixel_pitch
                solver = partial(integrate, confidence=solution.confidence, pitch=pitch)
            elif np.count_nonzero(result.mask) < WHOLE * result.mask.size:
                # the cosine transform would pull the rim of a masked part down to flat ground
                solver = partial(integrate, steepness=0.0, tolerance=1e-3)
            result.height = integration.metric_height(
                solver(du, dv), result.normal, rays, plane.normal, plane.offset)
            form = options.form
            if form == 'auto':
                form = 'slow' if stack.geometry == Geometry.ASSUMED else 'none'
            if form == 'plane':
                result.height = integration.remove_plane(result.height)
            elif form == 'slow':
                result.height = surface.without_slow_form(result.height, max(stack.shape) / 16)
        on_ready(result, 'height')
    # the perspective integral is ln(depth): higher is less
    metres = 1.0 if stack.camera is None else -result.pixel_pitch * stack.camera.fx
    if 'shape' in wanted:
        with _timed(timings, 'shape'):
            relief = surface.relief(
                du, dv, solution.albedo, options.smoothness,
                options.flattening or max(stack.shape) / 150)
            # one pixel pitch of height in the unit of the integral
            unit = result.pixel_pitch / metres
            result.shape = surface.shape_image(relief, result.mask, options.contrast, unit)
        on_ready(result, 'shape')
    if 'roughness' in wanted and result.metric:
        with _timed(timings, 'roughness'):
            result.roughness = surface.roughness(
                result.normal, du, dv, result.pixel_pitch, metres, options.s_filter,
                options.l_filter)
