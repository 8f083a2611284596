"""Which part of an image follows a motion: two images, of which a square differs."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from photonpano.locating import Follows, follows

SHAPE = (60, 90)
NOISE = 0.01


def texture(seed: int) -> np.ndarray:
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(0, 1, SHAPE), (0, 0), 2)
    return (noise / noise.std()).astype(np.float32)


def noisy(image: np.ndarray, seed: int) -> np.ndarray:
    return image + np.random.default_rng(seed).normal(0, np.sqrt(NOISE / 2), SHAPE).astype(np.float32)


@pytest.fixture
def with_a_square() -> Follows:
    """Images that are the same but for the square of rows 20 to 39 and columns 30 to 59."""
    scene, other = texture(1), texture(1)
    other[20:40, 30:60] = texture(2)[20:40, 30:60]
    return follows(noisy(scene, 3), noisy(other, 4), np.full(SHAPE, NOISE, np.float32))


def test_part_that_differs_is_left_out_with_a_border(with_a_square: Follows) -> None:
    assert with_a_square.suspect
    assert not with_a_square.part[24:36, 34:56].any()
    assert with_a_square.part[:12].all()
    assert not with_a_square.inner[20:40, 30:60].any()
    assert with_a_square.inner[:10].all()


def test_the_same_image_is_not_suspect() -> None:
    same = follows(noisy(texture(1), 3), noisy(texture(1), 4), np.full(SHAPE, NOISE, np.float32))
    assert not same.suspect
    assert same.part.all()


def test_nothing_is_told_where_nothing_stands_out_from_noise() -> None:
    flat = np.zeros(SHAPE, np.float32)
    part = follows(noisy(flat, 3), noisy(flat, 4), np.full(SHAPE, NOISE, np.float32))
    assert np.isnan(part.difference).mean() > 0.99
    assert not part.suspect
    assert part.part.mean() > 0.99


def test_nothing_is_told_where_nothing_was_seen() -> None:
    noise = np.full(SHAPE, NOISE, np.float32)
    noise[:, :30] = np.inf
    part = follows(texture(1), texture(2), noise)
    assert np.isnan(part.difference[:, :30]).all()
    assert np.isfinite(part.difference[:, 35:]).all()


def test_larger_part_counts_more_unless_the_other_motion_is_trusted(with_a_square: Follows) -> None:
    inside = np.ones(SHAPE, np.float32)
    inside[20:40, 30:60] = 0
    square = Follows(inside)
    assert with_a_square.more_than(square)
    assert not square.more_than(with_a_square)
    assert square.more_than(with_a_square, trust=1e3)
