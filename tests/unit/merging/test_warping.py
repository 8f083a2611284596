"""Warps that add to a grid, compared with interpolation pixel by pixel."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from photonpano.geometry import transform_points, translation
from photonpano.merging.warping import add_footprint, add_warped

IMAGE = np.random.default_rng(0).random((23, 37)).astype(np.float32)


def interpolated(image: np.ndarray, to_image: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Interpolate an image, with zeros around it, at each pixel of a grid."""
    padded = np.pad(image.astype(np.float64), 2)
    y, x = np.mgrid[: shape[0], : shape[1]]
    seen = transform_points(to_image, np.stack([x.ravel(), y.ravel()], axis=-1).astype(float)) + 2
    u, v = (np.clip(seen[:, axis], 0, padded.shape[1 - axis] - 2) for axis in (0, 1))
    left, top = np.floor(u).astype(int), np.floor(v).astype(int)
    a, b = u - left, v - top
    upper = (1 - a) * padded[top, left] + a * padded[top, left + 1]
    lower = (1 - a) * padded[top + 1, left] + a * padded[top + 1, left + 1]
    return ((1 - b) * upper + b * lower).reshape(shape)


@settings(deadline=None, max_examples=60)
@given(
    x=st.floats(-45, 45),
    y=st.floats(-30, 30),
    linear=st.lists(st.floats(-0.15, 0.15), min_size=4, max_size=4),
    perspective=st.lists(st.floats(-1e-3, 1e-3), min_size=2, max_size=2),
)
def test_add_warped_equals_bilinear_interpolation(x: float, y: float, linear: list[float], perspective: list[float]) -> None:
    to_image = np.array([[1 + linear[0], linear[1], x], [linear[2], 1 + linear[3], y], [*perspective, 1]])
    shape = (31, 53)
    total = np.full(shape, 7, np.float32)
    add_warped(IMAGE, to_image, total)
    np.testing.assert_allclose(total, 7 + interpolated(IMAGE, to_image, shape), atol=1e-4)


@pytest.mark.parametrize("shift", [(0, 0), (3, -5), (2.25, 1.5), (-0.5, 0.5), (36.5, 0), (37, 0), (0, -22.5), (200, 0)])
def test_add_warped_is_exact_up_to_the_border(shift: tuple[float, float]) -> None:
    total = np.zeros((40, 60), np.float32)
    add_warped(IMAGE, translation(*shift), total)
    np.testing.assert_allclose(total, interpolated(IMAGE, translation(*shift), total.shape), atol=1e-6)


@pytest.mark.parametrize(
    "to_image",
    [
        translation(0, 0),
        translation(-2.25, 1.5),
        np.array([[0.9, 0.2, -4], [-0.1, 1.1, 3], [1e-3, -5e-4, 1]]),
        translation(500, 0),
    ],
    ids=["identity", "shift", "perspective", "outside"],
)
def test_add_footprint_equals_warp_of_uniform_image(to_image: np.ndarray) -> None:
    shape = (40, 60)
    expected, total, steps = np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.zeros((40, 61), np.float32)
    add_warped(np.full(IMAGE.shape, 3, np.float32), to_image, expected)
    add_footprint(IMAGE.shape, to_image, 3.0, steps, total)
    np.testing.assert_allclose(total + np.cumsum(steps, axis=1)[:, :-1], expected, atol=1e-4)
