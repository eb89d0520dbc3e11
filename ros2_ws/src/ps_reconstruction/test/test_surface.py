import numpy as np
import pytest

from ps_head_driver.frames import slope_to_normal
from ps_reconstruction import preview, surface
from ps_reconstruction.integration import gradients, parallel_rays

PITCH = 20e-6


def normals_of(z: np.ndarray) -> np.ndarray:
    """Normals of heights on a grid, y up."""
    q, p = (g / PITCH for g in np.gradient(z))
    return slope_to_normal(np.stack([p, -q], axis=-1)).astype(np.float32)


def test_slope_and_normal_agree() -> None:
    slope = np.random.default_rng(0).normal(0, 0.5, (20, 30, 2))
    np.testing.assert_allclose(
        surface.slope(slope_to_normal(slope).astype(np.float32)), slope, atol=1e-5)


@pytest.mark.parametrize('sign', [1, -1])
def test_mean_curvature_of_a_sphere(sign: int) -> None:
    radius = 5e-3
    y, x = (np.mgrid[:100, :120] - 50) * PITCH
    normal = normals_of(sign * np.sqrt(radius ** 2 - x ** 2 - y ** 2))
    found = surface.mean_curvature(normal, PITCH)
    # a bump is negative, a hollow positive
    assert float(np.median(found)) == pytest.approx(-sign / radius, rel=0.01)


@pytest.mark.parametrize('shape', [(1, 1), (1, 5), (2, 7), (7, 2)])
def test_a_picture_without_inner_pixels_has_no_curvature(shape: tuple[int, int]) -> None:
    normal = np.broadcast_to(np.float32([0, 0, 1]), (*shape, 3))
    assert np.isnan(surface.mean_curvature(normal, PITCH)).all()


def test_shape_image_is_bright_on_a_bump_and_dark_in_a_pit() -> None:
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:200, :240]

    def blob(cx: int, cy: int) -> np.ndarray:
        return np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * 6.0 ** 2))

    bowl = 2e-4 * ((x - 120) ** 2 + (y - 100) ** 2) / 120 ** 2
    z = 3e-6 * (blob(60, 100) - blob(180, 100)) + bowl + 1e-8 * rng.standard_normal(x.shape)
    normal = normals_of(z)
    du, dv = gradients(normal, parallel_rays(z.shape, PITCH))
    relief = surface.relief(du, dv, np.ones(z.shape, np.float32), 1.0, 12.0)
    valid = np.ones(z.shape, bool)
    picture = surface.shape_image(relief, valid, 1.0, PITCH)
    assert picture[100, 60] > 200
    assert picture[100, 180] < 56
    # the bowl, 60 times as high as the bump, is gone
    assert abs(float(np.median(picture)) - surface.NEUTRAL) < 4
    assert np.abs(picture[20:50, 100:140].astype(int) - surface.NEUTRAL).max() < 90
    swapped = surface.shape_image(relief, valid, 1.0, -PITCH)
    assert swapped[100, 60] < 56


def test_shape_image_of_a_perfect_plate_is_grey() -> None:
    zero = np.zeros((40, 50), np.float32)
    relief = surface.relief(zero, zero, zero + 1, 1.0, 10.0)
    assert (surface.shape_image(relief, zero == 0) == surface.NEUTRAL).all()


def test_roughness_of_a_sine() -> None:
    """Sa = 2 a / pi, Sq = a / sqrt 2, Sdq = a k / sqrt 2 for a wave that passes the filters."""
    amplitude, wavelength = 2e-6, 0.4e-3
    slope = amplitude * 2 * np.pi / wavelength
    p = slope * np.cos(2 * np.pi * np.arange(400) * PITCH / wavelength)
    normal = slope_to_normal(np.stack(
        [np.tile(p, (300, 1)), np.zeros((300, 400))], axis=-1)).astype(np.float32)
    du, dv = gradients(normal, parallel_rays((300, 400), PITCH))
    found = surface.roughness(normal, du, dv, PITCH, 1.0, 0.0, 2.5e-3)
    assert found.sa == pytest.approx(2 * amplitude / np.pi, rel=0.03)
    assert found.sq == pytest.approx(amplitude / np.sqrt(2), rel=0.03)
    assert found.sdq == pytest.approx(slope / np.sqrt(2), rel=0.05)
    assert found.sdr == pytest.approx(np.mean(np.sqrt(
        1 + (slope * np.cos(np.linspace(0, 2 * np.pi, 999))) ** 2)) - 1, rel=0.1)


def test_l_filter_halves_a_wave_of_its_cut_off() -> None:
    amplitude, wavelength = 2e-6, 0.8e-3
    x = np.arange(800) * PITCH
    z = np.tile(amplitude * np.sin(2 * np.pi * x / wavelength), (300, 1))
    normal = normals_of(z)
    du, dv = gradients(normal, parallel_rays(z.shape, PITCH))
    found = surface.roughness(normal, du, dv, PITCH, 1.0, 0.0, wavelength)
    assert found.sq == pytest.approx(0.5 * amplitude / np.sqrt(2), rel=0.03)


def test_colours_of_the_normal_preview() -> None:
    normal = slope_to_normal(np.array([[[0.0, 0.0], [-0.5, 0.0], [0.0, -0.5]]]))
    flat, right, up = preview.normal_preview(normal.astype(np.float32))[0].astype(int)
    assert tuple(flat) == (128, 128, 255)
    assert right[0] > 170      # faces right: red
    assert up[1] > 170         # faces up in the picture: green
    assert not preview.normal_preview(np.full((1, 1, 3), np.nan, np.float32)).any()


def test_slope_preview_is_white_where_flat() -> None:
    slope = np.zeros((4, 4, 2), np.float32)
    slope[0, 0] = np.nan
    picture = preview.slope_preview(slope, 1.0)
    assert (picture[1:] == 255).all()
    assert not picture[0, 0].any()


def test_pngs_keep_16_bits() -> None:
    assert preview.grey16(np.array([0.0, 0.5, 1.0, np.nan]), 0, 1).tolist() == [1, 32768, 65535, 0]
    assert preview.normal16(np.array([[0, 0, 1.0]], np.float32)).tolist() == [
        [32768, 32768, 65535]]


def test_height_view_shows_the_surface() -> None:
    y, x = np.mgrid[:60, :80]
    height = (1e-4 * np.exp(-((x - 40) ** 2 + (y - 30) ** 2) / 100)).astype(np.float32)
    height[:, :5] = np.nan
    picture = preview.height_view(height, PITCH, (600, 400))
    assert picture.shape == (400, 600, 3)
    assert 0.1 < (picture < 250).any(axis=-1).mean() < 0.9
    empty = preview.height_view(np.full((9, 9), np.nan, np.float32), PITCH, (60, 40))
    assert (empty == 255).all()
