from __future__ import annotations

import base64

import cv2
import numpy as np
import pytest

from photonpano.report.drawing import jpeg_uri, shrunk


def decoded(uri: str) -> np.ndarray:
    head, content = uri.split(",")
    assert head == "data:image/jpeg;base64"
    return cv2.imdecode(np.frombuffer(base64.b64decode(content), np.uint8), cv2.IMREAD_UNCHANGED)


def test_jpeg_uri_keeps_grey_picture():
    image = np.tile(np.linspace(0, 255, 64).astype(np.uint8), (48, 1))
    np.testing.assert_allclose(decoded(jpeg_uri(image)), image, atol=4)


def test_jpeg_uri_keeps_order_of_colours():
    image = np.zeros((32, 32, 3), np.uint8)
    image[..., 0] = 220
    blue, green, red = decoded(jpeg_uri(image)).reshape(-1, 3).mean(axis=0)
    assert red > 210
    assert max(blue, green) < 15


@pytest.mark.parametrize(
    ("shape", "expected"), [((100, 400), (50, 200)), ((400, 100), (200, 50)), ((120, 80), (120, 80)), ((1, 5000), (1, 200))]
)
def test_shrunk_bounds_longer_side(shape, expected):
    assert shrunk(np.zeros(shape, np.uint8), 200).shape == expected


def test_shrunk_averages_pixels():
    image = np.indices((100, 400)).sum(axis=0) % 2 * np.float32(100)
    np.testing.assert_allclose(shrunk(image, 200), 50)
