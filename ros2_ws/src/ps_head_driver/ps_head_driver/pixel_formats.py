"""Raw pixels of cameras to the arrays of a stack: mono or RGB, linear, full scale of the dtype."""
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

# OpenCV names a Bayer pattern by its second row, everyone else by its first
_BAYER = {'rggb': cv2.COLOR_BayerBG2RGB, 'bggr': cv2.COLOR_BayerRG2RGB,
          'gbrg': cv2.COLOR_BayerGR2RGB, 'grbg': cv2.COLOR_BayerGB2RGB}


def demosaic(image: NDArray, order: str) -> NDArray:
    """Bayer picture to RGB.

    :param image: (H, W) uint8 or uint16.
    :param order: colours of the first four pixels, row by row: 'rggb', 'bggr', 'gbrg', 'grbg'.
    :returns: (H, W, 3), same dtype.
    """
    return cv2.cvtColor(image, _BAYER[order])


def use_all_bits(image: NDArray, bits: int) -> NDArray:
    """Values of fewer bits in a uint16 picture to the full scale of 16 bits.

    :param bits: that are used, from the lowest.
    :raises ValueError: for a value with more bits than that.
    """
    if image.dtype != np.uint16 or bits == 16:
        return image
    highest = int(image.max(initial=0))
    if highest >> bits:
        raise ValueError(f'the picture holds the value {highest}, more than {bits} bits')
    return image << np.uint16(16 - bits)


@dataclass(frozen=True)
class PixelFormat:
    """A format of the GenICam Pixel Format Naming Convention, not packed.

    :param bits: used, from the lowest.
    :param bayer: order of the colours, or empty.
    """

    bits: int
    channels: int = 1
    bayer: str = ''
    is_bgr: bool = False

    def decode(self, data: NDArray, width: int, height: int) -> NDArray:
        """Bytes of one frame to (H, W) or (H, W, 3), uint8 or uint16.

        :raises ValueError: if there are too few bytes, or a value has too many bits.
        """
        dtype = np.dtype(np.uint8 if self.bits == 8 else '<u2')
        size = width * height * self.channels * dtype.itemsize
        if len(data) < size:
            raise ValueError(f'{len(data)} bytes for {width} x {height} pixels')
        image = data[:size].view(dtype).reshape(height, width, self.channels)
        image = use_all_bits(image[..., 0] if self.channels == 1 else image, self.bits)
        if self.bayer:
            return demosaic(image, self.bayer)
        return np.ascontiguousarray(image[..., ::-1]) if self.is_bgr else image


#: by PFNC code
PFNC: dict[int, PixelFormat] = {
    0x01080001: PixelFormat(8), 0x01100003: PixelFormat(10), 0x01100005: PixelFormat(12),
    0x01100025: PixelFormat(14), 0x01100007: PixelFormat(16),
    0x02180014: PixelFormat(8, 3), 0x02180015: PixelFormat(8, 3, is_bgr=True),
    0x02300018: PixelFormat(10, 3), 0x0230001A: PixelFormat(12, 3), 0x02300033: PixelFormat(16, 3),
    **{first + i: PixelFormat(bits, bayer=order)
       for first, bits in ((0x01080008, 8), (0x0110000C, 10), (0x01100010, 12), (0x0110002E, 16))
       for i, order in enumerate(('grbg', 'rggb', 'gbrg', 'bggr'))},
}
SUPPORTED = ('Mono8, Mono10, Mono12, Mono14, Mono16, RGB8, BGR8, RGB10, RGB12, RGB16 and '
             'Bayer..8, 10, 12, 16, not packed')
