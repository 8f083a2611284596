"""Pictures inside the page."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
from numpy.typing import NDArray

JPEG_QUALITY = 90


def shrunk(image: NDArray[Any], max_pixels: int) -> NDArray[Any]:
    """Average an image down until its longer side has at most `max_pixels`; smaller images stay as they are."""
    import cv2

    height, width = image.shape[:2]
    scale = max_pixels / max(height, width)
    if scale >= 1:
        return image
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def jpeg_uri(image: NDArray[np.uint8]) -> str:
    """Return an (H, W) grey or (H, W, 3) red-green-blue image as a data URI."""
    import cv2

    in_opencv_order = image if image.ndim == 2 else image[..., ::-1]
    _, encoded = cv2.imencode(".jpg", in_opencv_order, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode()
