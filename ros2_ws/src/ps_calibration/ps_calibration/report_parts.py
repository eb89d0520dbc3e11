"""What the sections of the calibration report are made of."""
import numpy as np
from numpy.typing import NDArray

from ps_head_driver.stack import Mode, Panel, Stack
from ps_reconstruction.html_report import data_uri, png_bytes, shrink


def figure(name: str, svg: bytes, caption: str) -> dict[str, str]:
    """A drawing for the page."""
    return {'name': name, 'uri': data_uri(svg, 'svg+xml'), 'caption': caption}


def _picture(name: str, image: NDArray, width: int, caption: str = '') -> dict[str, str]:
    return {'name': name, 'uri': data_uri(png_bytes(shrink(image, width))), 'caption': caption}


def single_pictures(stack: Stack, mode: Mode) -> list[dict[str, str]]:
    """The pictures under single panels of one field, each at its own brightness."""
    found = []
    for panel in (Panel.E, Panel.N, Panel.W, Panel.S):
        for image, light in zip(stack.images, stack.lights, strict=True):
            if light.panel == panel and light.mode == mode:
                full = float(np.percentile(image, 99.8)) or 1.0
                grey = (np.clip(image / full, 0, 1) * 255).astype(np.uint8)
                found.append(_picture(panel.name, grey, 560))
    return found
