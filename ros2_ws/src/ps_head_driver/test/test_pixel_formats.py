"""Raw pixels of every supported format to mono or RGB at full scale."""
import numpy as np
import pytest

from ps_head_driver.pixel_formats import PFNC, demosaic, use_all_bits

COLOUR = (200, 100, 40)      # red, green, blue


def mosaic(order: str) -> np.ndarray:
    """A uniform colour behind a Bayer filter."""
    value = dict(zip('rgb', COLOUR, strict=True))
    cell = np.array([[value[c] for c in order[:2]], [value[c] for c in order[2:]]], np.uint8)
    return np.tile(cell, (8, 8))


@pytest.mark.parametrize('order', ['rggb', 'bggr', 'gbrg', 'grbg'])
def test_demosaic_finds_the_colours(order):
    image = demosaic(mosaic(order), order)
    assert image.shape == (16, 16, 3)
    np.testing.assert_array_equal(image[4:-4, 4:-4], np.broadcast_to(COLOUR, (8, 8, 3)))


@pytest.mark.parametrize(('code', 'order'), [
    (0x01080009, 'rggb'), (0x0108000B, 'bggr'), (0x0108000A, 'gbrg'), (0x01080008, 'grbg')])
def test_bayer_codes(code, order):
    image = PFNC[code].decode(mosaic(order).ravel(), 16, 16)
    np.testing.assert_array_equal(image[4:-4, 4:-4], np.broadcast_to(COLOUR, (8, 8, 3)))


@pytest.mark.parametrize(('code', 'bits'), [
    (0x01080001, 8), (0x01100003, 10), (0x01100005, 12), (0x01100025, 14), (0x01100007, 16)])
def test_mono_of_any_depth_uses_the_full_scale(code, bits):
    counts = np.linspace(0, (1 << bits) - 1, 32 * 24).round()
    data = counts.astype(np.uint8 if bits == 8 else '<u2').view(np.uint8)
    image = PFNC[code].decode(data, 32, 24)
    assert image.shape == (24, 32)
    full = np.iinfo(image.dtype).max
    np.testing.assert_allclose(image.ravel() / full, counts / ((1 << bits) - 1),
                               atol=1.01 / ((1 << bits) - 1))
    assert image.max() > 0.98 * full      # so that saturation is seen


@pytest.mark.parametrize(('code', 'pixel'), [
    (0x02180014, (1, 2, 3)), (0x02180015, (3, 2, 1)), (0x02300033, (1, 2, 3))])
def test_colour(code, pixel):
    dtype = np.uint8 if code < 0x02300000 else np.dtype('<u2')
    data = np.tile(np.array(pixel, dtype), 4).view(np.uint8)
    image = PFNC[code].decode(data, 2, 2)
    np.testing.assert_array_equal(image, np.broadcast_to((1, 2, 3), (2, 2, 3)))


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match='3 bytes for 2 x 2'):
        PFNC[0x01080001].decode(np.zeros(3, np.uint8), 2, 2)
    with pytest.raises(ValueError, match='value 5000, more than 12 bits'):
        use_all_bits(np.array([[5000]], np.uint16), 12)
