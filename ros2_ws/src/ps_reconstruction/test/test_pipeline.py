from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
import subprocess
import sys

import numpy as np
import pytest

from ps_head_driver.convergence_radius import inverse
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.fake.renderer import make_renderer
from ps_head_driver.head_model import CameraGeometry, load_head, nominal_head_path
from ps_head_driver.kinematics import lights_at
from ps_head_driver.stack import Light, Panel, Plane, Stack, angular_error_deg
from ps_reconstruction.near_field import photometric_problem
from ps_reconstruction.pipeline import METHODS, OUTPUTS, Options, Reconstruction, reconstruct
from ps_reconstruction.problem import SATURATED, expand


def plate(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 0.0 * x


def dome(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    cap = np.sqrt(np.maximum(0.02 ** 2 - x * x - y * y, 0)) - np.sqrt(0.02 ** 2 - 0.01 ** 2)
    return np.maximum(cap, 0)


def test_plate_is_flat_near_field_and_a_bowl_without(render: Callable) -> None:
    stack, normal, _ = render(plate)
    near = reconstruct(stack, Options())
    assert angular_error_deg(near.normal, normal).max() < 0.02
    assert np.abs(near.height).max() < 5e-6    # type: ignore[arg-type]
    assert near.near_field
    far = reconstruct(stack, Options(near_field=False), {'normal'})
    assert angular_error_deg(far.normal, normal).mean() > 10
    assert not far.near_field


@pytest.mark.parametrize(('p', 'q'), [(0.1, 0.0), (0.0, 0.1), (-0.1, 0.05)])
def test_signs_on_a_tilted_plate(p: float, q: float, render: Callable) -> None:
    stack, normal, z = render(lambda x, y: p * x + q * y)
    result = reconstruct(stack, Options(height_rounds=3))
    assert result.slope is not None
    assert result.height is not None
    assert np.nanmean(result.slope, axis=(0, 1)) == pytest.approx((p, q), abs=2e-3)
    assert angular_error_deg(result.normal, normal).mean() < 0.05
    np.testing.assert_allclose(result.height, z - np.median(z), atol=1e-4)


def test_height_rounds_make_the_dome_right(render: Callable) -> None:
    stack, normal, z = render(dome)
    errors = [float(angular_error_deg(
        reconstruct(stack, Options(height_rounds=rounds), {'normal'}).normal, normal).mean())
        for rounds in (0, 2)]
    assert errors[1] < 0.02
    assert errors[1] < 0.5 * errors[0]
    height = reconstruct(stack, outputs={'height'}).height
    assert height is not None
    assert np.abs(height - (z - np.median(z))).mean() < 1e-5


@pytest.fixture(scope='module')
def boss() -> tuple[Stack, np.ndarray]:
    """Noisy pictures of a matt boss of 1 mm and its height."""
    head = load_head(nominal_head_path())
    setting = inverse(head, 0.06)
    renderer = make_renderer('boss', head, scale=0.3)
    images = [renderer.render(setting.tilt, 1.3, list(levels), exposure=0.004, frame=i)
              for i, levels in enumerate(np.eye(4))]
    height = renderer.truth().height
    assert height is not None
    return Stack(images, lights_at(head, setting.motor_counts, 1.3)[:4], renderer.camera), height


@pytest.mark.parametrize('method', METHODS)
def test_a_matt_boss_keeps_its_height(method: str, boss: tuple[Stack, np.ndarray]) -> None:
    """Noise alone must not make a robust method flatten the slopes of a matt part."""
    stack, truth = boss
    height = reconstruct(stack, Options(method=method), {'height'}).height
    assert height is not None
    scale = np.polyfit(truth.ravel(), height.ravel(), 1)[0]
    assert scale == pytest.approx(1, abs=0.01)


def test_grid_interpolation_error_is_negligible(render: Callable) -> None:
    stack, _, _ = render(plate)
    coarse = photometric_problem(stack)
    from ps_head_driver.light_model import light_vectors
    from ps_reconstruction.near_field import camera_rays, surface_points
    shape = stack.shape
    every = surface_points(camera_rays(stack.camera, shape, 2), stack.plane)[:shape[0] // 2]
    exact = np.stack([light_vectors(light, every) for light in stack.lights], axis=2)
    found = expand(coarse.lights, coarse.step, shape)[::2, ::2]
    exact = exact[:found.shape[0], :found.shape[1]]
    assert angular_error_deg(found, exact).max() < 0.01


def test_flat_field_with_unnormalised_lights_would_be_wrong(render: Callable) -> None:
    """Division by the board and the light vectors s / s_z cancel on any part (physics.md)."""
    board, _, _ = render(plate)
    stack, normal, _ = render(lambda x, y: 0.15 * x)
    vignette = 1 - 0.3 * np.linspace(-1, 1, stack.shape[1]) ** 2
    flat = replace(
        stack, images=[(image * vignette).astype(np.float32) for image in stack.images],
        gain_maps=[(image * vignette).astype(np.float32) for image in board.images])
    # panel brightness is in the board's pictures too
    flat = replace(flat, lights=[replace(light, intensity=k) for light, k in zip(
        flat.lights, (1.0, 0.7, 1.3, 0.9), strict=True)])
    result = reconstruct(flat, Options(height_rounds=3), {'normal'})
    error = angular_error_deg(result.normal, normal)[8:-8, 8:-8]
    assert error.mean() < 0.1
    assert error.max() < 0.3


def test_exposure_and_intensity_are_divided_out(render: Callable, ring: list[Light]) -> None:
    lights = [replace(light, intensity=k, exposure_scale=e) for light, k, e in zip(
        ring, (1.0, 0.5, 0.8, 1.2), (1.0, 0.5, 0.25, 1.0), strict=True)]
    stack, normal, _ = render(plate, lights=lights)
    stack = replace(stack, images=[
        (image * light.exposure_scale).astype(np.float32)
        for image, light in zip(stack.images, lights, strict=True)])
    assert angular_error_deg(reconstruct(stack).normal, normal).max() < 0.02


def test_frames_without_one_panel_are_left_out(render: Callable) -> None:
    stack, normal, _ = render(plate)
    extra = [np.ones_like(stack.images[0]), np.zeros_like(stack.images[0])]
    stack = replace(stack, images=stack.images + extra,
                    lights=[*stack.lights, Light(panel=Panel.ALL), Light(panel=Panel.NONE)])
    assert angular_error_deg(reconstruct(stack).normal, normal).max() < 0.02


def test_calibrated_plane_is_used(render: Callable) -> None:
    """A part 5 mm above the nominal plane is right once the plane says so."""
    stack, normal, _ = render(lambda x, y: 0 * x + 5e-3)
    wrong = angular_error_deg(reconstruct(stack, outputs={'normal'}).normal, normal).mean()
    right = reconstruct(replace(stack, plane=Plane(offset=5e-3)), outputs={'normal', 'height'})
    assert wrong > 0.3
    assert angular_error_deg(right.normal, normal).max() < 0.02
    assert np.abs(right.height).max() < 5e-6    # type: ignore[arg-type]


def test_only_what_is_asked_for_is_computed(render: Callable) -> None:
    stack, _, _ = render(plate)
    result = reconstruct(stack, outputs={'slope'})
    assert result.slope is not None
    for name in set(OUTPUTS) - {'slope', 'normal', 'roughness'}:
        assert getattr(result, name) is None, name
    assert set(result.timings) == {'lights', 'normals', 'slope'}
    assert reconstruct(stack, outputs=set()).height is None


def test_pictures_are_announced_once_each_as_soon_as_they_are_there(render: Callable) -> None:
    stack, _, _ = render(plate)
    heard: list[str] = []

    def hear(result: Reconstruction, name: str) -> None:
        assert getattr(result, name) is not None
        heard.append(name)

    reconstruct(stack, on_ready=hear)
    assert sorted(heard) == sorted(set(OUTPUTS) - {'roughness'})
    assert heard.index('normal') < heard.index('height')
    heard.clear()
    reconstruct(stack, outputs={'shape'}, on_ready=hear)
    assert heard == ['shape']


def test_cameras_with_fewer_bits_than_the_pixel_type(render: Callable) -> None:
    """12 bits in 16: the scale of the albedo and the saturated level are those of 12 bits."""
    stack, normal, _ = render(dome)
    float_albedo = reconstruct(stack, outputs={'albedo'}).albedo
    twelve = replace(stack, images=[np.rint(i * 4095).astype(np.uint16) for i in stack.images])
    twelve.images[2][40:44, 50:60] = 4095
    result = reconstruct(twelve, Options(bits=12), {'albedo', 'reason'})
    assert angular_error_deg(result.normal, normal).mean() < 0.1
    assert np.nanmedian(result.albedo / float_albedo) == pytest.approx(1, rel=1e-3)
    assert result.reason is not None
    assert (result.reason[40:44, 50:60] & SATURATED).all()
    assert not (result.reason[60:] & SATURATED).any()


def test_trust_can_be_fixed(render: Callable) -> None:
    stack, normal, _ = render(dome)
    stack.images[0][60:64, 70:74] *= 0.03       # a cast shadow
    fixed = reconstruct(stack, Options(method='stv', trust='least_squares'), {'normal'}).normal
    plain = reconstruct(stack, outputs={'normal'}).normal
    np.testing.assert_allclose(fixed, plain, atol=2e-3)
    robust = reconstruct(stack, Options(method='stv', trust='rejection', patch=1), {'normal'})
    errors = [angular_error_deg(n, normal)[60:64, 70:74].max() for n in (plain, robust.normal)]
    assert errors[0] > 10
    assert errors[1] < 0.5


def test_bit_identical_on_repeat(render: Callable) -> None:
    stack, _, _ = render(dome)
    first, second = reconstruct(stack), reconstruct(stack)
    for name in set(OUTPUTS) - {'roughness'}:
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name), err_msg=name)
    assert first.roughness == second.roughness
    assert first.residual_rms == second.residual_rms


def test_mask_and_colour(render: Callable) -> None:
    stack, normal, _ = render(dome)
    tint = np.array([1.0, 0.6, 0.3], np.float32)
    mask = np.zeros(stack.shape, bool)
    mask[20:100, 30:120] = True
    colour = replace(stack, images=[image[..., None] * tint for image in stack.images], mask=mask)
    result = reconstruct(colour)
    assert result.albedo is not None
    assert np.isnan(result.normal[~mask]).all()
    assert result.valid_fraction == 1.0
    assert angular_error_deg(result.normal, normal)[mask].mean() < 0.05
    ratio = np.nanmean(result.albedo, axis=(0, 1))
    assert ratio / ratio[0] == pytest.approx(tint, rel=1e-3)


BAD, FEW, DEGENERATE = (
    ErrorCode.RECONSTRUCTION_BAD_STACK, ErrorCode.RECONSTRUCTION_TOO_FEW_LIGHTS,
    ErrorCode.RECONSTRUCTION_DEGENERATE_LIGHTS)


@pytest.mark.parametrize(('spoil', 'code', 'word'), [
    (lambda s: s.subset([0, 1]), FEW, 'at least 3'),
    (lambda s: replace(s, images=s.images[:3]), BAD, 'lights'),
    (lambda s: replace(s, images=[*s.images[:3], s.images[3][:-1]]), BAD, 'images'),
    (lambda s: replace(s, images=[*s.images[:3], s.images[3] * np.nan]), BAD, 'NaN'),
    (lambda s: replace(s, images=[i.astype(np.float64) for i in s.images]), BAD, 'float64'),
    (lambda s: replace(s, mask=np.zeros(s.shape, bool)), BAD, 'mask'),
    (lambda s: replace(s, mask=np.ones((3, 3), bool)), BAD, 'mask'),
    (lambda s: replace(s, camera=None), BAD, 'camera_info'),
    (lambda s: replace(s, lights=[s.lights[0]] * 4), DEGENERATE, 'condition'),
    (lambda s: replace(s, lights=[replace(k, intensity=0.0) for k in s.lights]), BAD, 'intensity'),
    (lambda s: replace(s, lights=[replace(k, axis=(np.nan, 0, 1)) for k in s.lights]), BAD,
     'finite'),
    (lambda s: replace(s, gain_maps=s.images[:2]), BAD, 'gain_maps'),
    (lambda s: replace(s, gain_maps=[0 * i for i in s.images]), BAD, 'gain_maps'),
    (lambda s: replace(s, plane=Plane((0.0, 0.0, -1.0))), BAD, 'plane'),
])
def test_bad_stacks_are_refused_with_a_reason(
    spoil: Callable[[Stack], Stack], code: ErrorCode, word: str, render: Callable,
) -> None:
    stack, _, _ = render(plate)
    with pytest.raises(PsError, match=word) as caught:
        reconstruct(spoil(stack))
    assert caught.value.code == code


@pytest.mark.parametrize('change', [
    {'method': 'magic'}, {'form': 'cube'}, {'contrast': 0.0}, {'smoothness': -1.0},
    {'l_filter': float('nan')}, {'trust': 'blind'}, {'patch': 4}, {'patch': 17}, {'bits': 7}])
def test_bad_options_are_refused(change: dict) -> None:
    with pytest.raises(PsError, match=next(iter(change))) as caught:
        Options(**change)
    assert caught.value.code == ErrorCode.RECONSTRUCTION_BAD_PARAMETER


def test_unknown_output_is_refused(render: Callable) -> None:
    with pytest.raises(PsError, match='gloss'):
        reconstruct(render(plate)[0], outputs={'gloss'})


def test_all_black_pictures_give_no_normals(camera: CameraGeometry, ring: list[Light]) -> None:
    images = [np.zeros((camera.height_px, camera.width_px), np.uint8) for _ in ring]
    result = reconstruct(Stack(images, ring, camera))
    assert result.valid_fraction == 0
    assert np.isnan(result.normal).all()
    assert not result.confidence.any()    # type: ignore[union-attr]


@pytest.mark.parametrize(('name', 'published'), [('ball', 4.09), ('cat', 8.41)])
def test_least_squares_gives_the_published_diligent_values(
    data: Path, name: str, published: float,
) -> None:
    from ps_head_driver.stack_folder import read_stack
    folder = data / 'diligent' / f'{name}PNG'
    if not folder.is_dir():
        pytest.skip(f'{folder} is missing')
    stack, truth = read_stack(folder)
    assert truth is not None
    error = angular_error_deg(reconstruct(stack, outputs={'normal'}).normal, truth.normal)
    assert error[stack.mask].mean() == pytest.approx(published, abs=0.03)


COMPILED = """
from dataclasses import replace
import sys
import numpy as np
from numba.core.dispatcher import Dispatcher
from ps_head_driver.fake.renderer import make_renderer
from ps_head_driver.head_model import load_head, nominal_head_path
from ps_head_driver.kinematics import BrightFieldKinematics, lights_at
from ps_head_driver.stack import Stack
from ps_reconstruction.pipeline import METHODS, Options, reconstruct, warm_up

def kernels():
    return {(name, key, str(signature)) for name, module in list(sys.modules.items())
            if name.startswith('ps_reconstruction') for key, value in vars(module).items()
            if isinstance(value, Dispatcher) for signature in value.signatures}

head = load_head(nominal_head_path())
renderer = make_renderer('boss', head, scale=0.3)
tilt = float(BrightFieldKinematics(head).tilt(20_000))
stack = Stack([renderer.render(tilt, 1.3, np.eye(4)[i], frame=i) for i in range(4)],
              lights_at(head, 20_000, 1.3)[:4], renderer.camera)
for method in METHODS:
    warm_up(method)
    before = kernels()
    for images in (stack.images, [image.astype(np.uint16) * 257 for image in stack.images]):
        reconstruct(replace(stack, images=images), Options(method=method))
    print(method, kernels() - before or 'nothing')
"""


def test_nothing_is_left_to_compile_for_the_first_stack() -> None:
    """In a process of its own: others have compiled what they need."""
    done = subprocess.run([sys.executable, '-c', COMPILED], capture_output=True, text=True,
                          timeout=300, check=True)
    assert done.stdout.splitlines() == [f'{method} nothing' for method in METHODS]
