"""Self-contained HTML pages: pictures are inside the file, nothing is loaded from elsewhere.

The look is in templates/base.html here; packages to the right have templates that extend it.
"""
import base64
from pathlib import Path
from typing import Any

import cv2
from jinja2 import (
    ChoiceLoader,
    Environment,
    PackageLoader,
    StrictUndefined,
    select_autoescape,
)
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


def data_uri(data: bytes, kind: str = 'png') -> str:
    """A picture as text for the src of an img element.

    :param kind: of the data, 'png' or 'svg+xml'.
    """
    return f'data:image/{kind};base64,' + base64.b64encode(data).decode()


def page(package: str, template: str, **content: Any) -> str:
    """Fill a template.

    :param package: that has the template in its folder templates; base.html is here.
    """
    environment = Environment(
        loader=ChoiceLoader([PackageLoader(package), PackageLoader('ps_reconstruction')]),
        autoescape=select_autoescape(), undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True)
    return environment.get_template(template).render(**content)


def render_page(package: str, template: str, path: Path, **content: Any) -> None:
    """Fill a template, see :func:`page`, and write the page."""
    path.write_text(page(package, template, **content), encoding='utf-8')
