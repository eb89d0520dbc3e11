"""Self-contained HTML pages: pictures are inside the file, nothing is loaded from elsewhere."""
import base64
from pathlib import Path
from typing import Any

import cv2
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
import numpy as np
from numpy.typing import NDArray


def png_bytes(image: NDArray) -> bytes:
    """Encode a picture as PNG.

    :param image: (H, W) or (H, W, 3) RGB; uint8 or uint16.
    """
    if image.ndim == 3:
        image = image[..., ::-1]
    ok, data = cv2.imencode('.png', np.ascontiguousarray(image))
    if not ok:
        raise ValueError(f'cannot encode a picture of {image.shape} {image.dtype}')
    return data.tobytes()


def shrink(image: NDArray, width: int) -> NDArray:
    """The picture at most ``width`` pixels wide, by area averaging."""
    if image.shape[1] <= width:
        return image
    height = round(image.shape[0] * width / image.shape[1])
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def data_uri(png: bytes) -> str:
    """A PNG as text for the src of an img element."""
    return 'data:image/png;base64,' + base64.b64encode(png).decode()


def render_page(template: str, path: Path, **content: Any) -> None:
    """Fill a template of this package and write the page."""
    environment = Environment(
        loader=PackageLoader('ps_inspection'), autoescape=select_autoescape(),
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    path.write_text(environment.get_template(template).render(**content), encoding='utf-8')
