"""Warps that add to a grid, compared with interpolation pixel by pixel."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from photonpano.geometry import Canvas, transform_points, translation
from photonpano.merging.footprints import Footprint
from photonpano.merging.warping import Grid, Texture, add_warped

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


def warped(image: np.ndarray, to_image: np.ndarray, shape: tuple[int, int], seen: np.ndarray | None = None) -> Grid:
    """Warp an image, and its share of each pixel times 3, onto a grid of zeros."""
    grid, footprint = Grid.zeros(Canvas(*shape, np.eye(3)), 1), Footprint(1, to_image, range(shape[0]), (range(shape[1]),))
    textures = [None if each is None else Texture.of(each.astype(np.float32)) for each in (image, seen)]
    add_warped(textures[0], textures[1], np.array([3.0]), footprint, grid)
    return grid


@settings(deadline=None, max_examples=60)
@given(
    x=st.floats(-45, 45),
    y=st.floats(-30, 30),
    linear=st.lists(st.floats(-0.15, 0.15), min_size=4, max_size=4),
    perspective=st.lists(st.floats(-1e-3, 1e-3), min_size=2, max_size=2),
)
def test_add_warped_equals_bilinear_interpolation(x: float, y: float, linear: list[float], perspective: list[float]) -> None:
    to_image = np.array([[1 + linear[0], linear[1], x], [linear[2], 1 + linear[3], y], [*perspective, 1]])
    grid = warped(IMAGE, to_image, (31, 53), seen=IMAGE > 0.5)
    np.testing.assert_allclose(grid.total, interpolated(IMAGE, to_image, (31, 53)), atol=1e-4)
    np.testing.assert_allclose(grid.coverages[0], 3 * interpolated(IMAGE > 0.5, to_image, (31, 53)), atol=4e-4)


@pytest.mark.parametrize("shift", [(0, 0), (3, -5), (2.25, 1.5), (-0.5, 0.5), (36.5, 0), (37, 0), (0, -22.5), (200, 0)])
def test_add_warped_is_exact_up_to_the_border(shift: tuple[float, float]) -> None:
    grid = warped(IMAGE, translation(*shift), (40, 60))
    np.testing.assert_allclose(grid.total, interpolated(IMAGE, translation(*shift), (40, 60)), atol=2e-5)
    whole = np.ones(IMAGE.shape)
    np.testing.assert_allclose(grid.coverages[0], 3 * interpolated(whole, translation(*shift), (40, 60)), atol=2e-5)


def test_places_on_a_wide_grid_are_exact_to_a_thousandth_of_a_pixel() -> None:
    ramp = np.tile(np.arange(64, dtype=np.float32), (16, 1))
    to_image = np.array([[0.5, 0.001, -20_000.25], [0, 1, 0], [0, 0, 1]])
    grid = warped(ramp, to_image, (16, 40_200))
    inside = slice(40_010, 40_110)
    np.testing.assert_allclose(grid.total[5, inside], 0.5 * np.arange(40_200)[inside] + 0.005 - 20_000.25, atol=0.01)


@pytest.mark.parametrize("largest", [1, 7, 65_535], ids=str)
def test_texture_keeps_whole_numbers(largest: int) -> None:
    image = np.random.default_rng(1).integers(0, largest + 1, (9, 14)).astype(np.uint32)
    image[0, 0] = largest
    np.testing.assert_array_equal(warped(image, np.eye(3), (9, 14)).total, image)


def test_texture_rounds_other_numbers_to_its_range() -> None:
    image = np.random.default_rng(1).normal(-3, 10, (9, 14)).astype(np.float32)
    np.testing.assert_allclose(warped(image, np.eye(3), (9, 14)).total, image, atol=np.ptp(image) / 65_000)
