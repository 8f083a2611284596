"""Moments against the same sums written out in numpy."""

from __future__ import annotations

import numpy as np
import pytest

from photonpano.geometry import apply
from photonpano_direct.moments import Buffers, Layer, derivative_moments, differentiate, residuals_and_moments

SHAPE = (31, 47)
HOMOGRAPHY = np.array([[1.01, 0.02, 3.3], [-0.01, 0.99, -2.63], [1e-4, -2e-4, 1]])


@pytest.fixture
def images() -> np.ndarray:
    return np.random.default_rng(0).random((6, *SHAPE), dtype=np.float32)


def places() -> tuple[np.ndarray, np.ndarray]:
    """Return the unit coordinates of all pixels."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    half = max(SHAPE) / 2
    return (x - (SHAPE[1] - 1) / 2) / half, (y - (SHAPE[0] - 1) / 2) / half


def interpolated(image: np.ndarray) -> np.ndarray:
    """Warp an image by linear interpolation; NaN outside."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    u, v = apply(HOMOGRAPHY, np.stack([x.ravel(), y.ravel()], axis=-1)).T
    seen = (u >= 0) & (u <= SHAPE[1] - 1) & (v >= 0) & (v <= SHAPE[0] - 1)
    left = np.clip(np.floor(u), 0, SHAPE[1] - 2).astype(int)
    top = np.clip(np.floor(v), 0, SHAPE[0] - 2).astype(int)
    a, b = u - left, v - top
    upper = (1 - a) * image[top, left] + a * image[top, left + 1]
    lower = (1 - a) * image[top + 1, left] + a * image[top + 1, left + 1]
    return np.where(seen, (1 - b) * upper + b * lower, np.nan).reshape(SHAPE)


def test_residuals_and_moments_match_sums_written_out(images: np.ndarray) -> None:
    image, weight, gx, gy, fixed, fixed_weight = images
    weight[:4] = 0
    fixed_weight[:, :5] = 0
    buffers = Buffers(*(np.empty(shape, np.float32) for shape in (SHAPE, SHAPE, (2, *SHAPE))))
    along_x, along_y = np.empty((3, 3)), np.empty((3, 3))
    moving = Layer(image, weight, 1.0, images[2:4].copy(), images[2:4].copy())
    pixels, squares, weights = residuals_and_moments(
        moving, Layer(fixed, fixed_weight, 1.0, images[:2].copy(), images[:2].copy()), HOMOGRAPHY, buffers, along_x, along_y
    )
    there = interpolated(fixed_weight)
    expected = np.nan_to_num(weight * there / np.maximum(weight + there, 1e-12))
    differs = np.where(np.isnan(there), 0, np.nan_to_num(interpolated(fixed)) - image)
    np.testing.assert_allclose(buffers.weight, expected, atol=1e-5)
    np.testing.assert_allclose(buffers.residual, differs, atol=1e-5)
    assert pixels == np.count_nonzero(expected)
    assert squares == pytest.approx(np.sum(expected * differs**2), rel=1e-4)
    assert weights == pytest.approx(expected.sum(), rel=1e-4)
    x, y = places()
    for i, j in ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1)):
        assert along_x[i, j] == pytest.approx(np.sum(expected * differs * gx * x**i * y**j), rel=1e-3, abs=1e-3)
    for i, j in ((0, 0), (1, 0), (0, 1), (0, 2), (1, 1)):
        assert along_y[i, j] == pytest.approx(np.sum(expected * differs * gy * x**i * y**j), rel=1e-3, abs=1e-3)


def test_derivative_moments_match_sums_written_out(images: np.ndarray) -> None:
    first, second, weight = images[:2].copy(), images[2:4].copy(), images[4]
    sums = np.empty((3, 5, 5))
    derivative_moments(first, second, weight, sums)
    x, y = places()
    xx, yy = weight * first[0] * second[0], weight * first[1] * second[1]
    xy = weight * (first[0] * second[1] + first[1] * second[0]) / 2
    for index, (image, most_x, most_y) in enumerate(((xx, 4, 2), (xy, 3, 3), (yy, 2, 4))):
        for i in range(most_x + 1):
            for j in range(most_y + 1):
                assert sums[index, i, j] == pytest.approx(np.sum(image * x**i * y**j), rel=1e-3, abs=1e-2)


def test_differentiate_gives_central_differences_and_0_at_borders(images: np.ndarray) -> None:
    gradients = np.empty((2, *SHAPE), np.float32)
    differentiate(images[0], gradients)
    np.testing.assert_allclose(gradients[0, :, 1:-1], (images[0, :, 2:] - images[0, :, :-2]) / 2, atol=1e-6)
    np.testing.assert_allclose(gradients[1, 1:-1], (images[0, 2:] - images[0, :-2]) / 2, atol=1e-6)
    assert not gradients[0, :, [0, -1]].any()
    assert not gradients[1, [0, -1]].any()
