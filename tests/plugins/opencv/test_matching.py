from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from photonpano_opencv.keypoints import match_everywhere, match_nearby, unit_bits, unit_descriptors

counts = st.integers(0, 12)
seeds = st.integers(0, 2**32 - 1)


def descriptors(rng: np.random.Generator, count: int) -> np.ndarray:
    """Descriptors of few values, so that there are near ties and distinct matches."""
    return unit_descriptors(rng.integers(0, 4, (count, 128), dtype=np.uint8) ** rng.integers(1, 5, (count, 1), dtype=np.uint8))


def chosen(moving: np.ndarray, fixed: np.ndarray, allowed: np.ndarray, ratio: float) -> set[tuple[int, int]]:
    """Match pair by pair: mutual nearest neighbours that pass Lowe's ratio test."""
    distance = np.where(allowed, np.sqrt(np.maximum(2 - 2 * moving.astype(float) @ fixed.T.astype(float), 0)), np.inf)
    pairs = set()
    for i in range(len(moving)):
        if not allowed[i].any():
            continue
        j = int(distance[i].argmin())
        others = np.delete(distance[i], j)
        second = others.min() if np.isfinite(others).any() else 2.0
        if distance[:, j].argmin() == i and distance[i, j] <= ratio * second:
            pairs.add((i, j))
    return pairs


def test_unit_descriptors_are_square_roots_of_length_1() -> None:
    unit = unit_descriptors(np.array([[1, 4, 4] + [0] * 125, [0] * 128], np.uint8))
    np.testing.assert_allclose(unit[0, :3], [1 / 3, 2 / 3, 2 / 3], rtol=1e-6)
    np.testing.assert_array_equal(unit[1], 0)


@given(seed=seeds)
def test_unit_bits_have_hamming_distance_as_squared_distance(seed: int) -> None:
    raw = np.random.default_rng(seed).integers(0, 256, (2, 32), dtype=np.uint8)
    first, second = unit_bits(raw)
    differing = np.count_nonzero(np.unpackbits(raw[0]) != np.unpackbits(raw[1]))
    np.testing.assert_allclose(np.sum((first - second) ** 2), 4 / 256 * differing, rtol=1e-5)
    np.testing.assert_allclose(first @ first, 1, rtol=1e-6)


@given(n_moving=counts, n_fixed=counts, seed=seeds)
def test_match_everywhere_keeps_mutual_distinct_matches(n_moving: int, n_fixed: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    moving, fixed = descriptors(rng, n_moving), descriptors(rng, n_fixed)
    pairs = match_everywhere(moving, fixed, 0.95)
    assert pairs.shape == (len(pairs), 2)
    if min(n_moving, n_fixed) < 2:
        assert len(pairs) == 0
    else:
        assert {tuple(pair) for pair in pairs} == chosen(moving, fixed, np.ones((n_moving, n_fixed), bool), 0.95)


@given(n_moving=counts, n_fixed=counts, seed=seeds, radius_px=st.floats(1, 200))
def test_match_nearby_keeps_mutual_distinct_matches_within_radius(
    n_moving: int, n_fixed: int, seed: int, radius_px: float
) -> None:
    rng = np.random.default_rng(seed)
    moving, fixed = descriptors(rng, n_moving), descriptors(rng, n_fixed)
    predicted, points = rng.uniform(0, 100, (n_moving, 2)), rng.uniform(0, 100, (n_fixed, 2)).astype(np.float32)
    pairs = match_nearby(moving, fixed, predicted, points, radius_px, 0.95)
    near = np.linalg.norm(predicted[:, None] - points[None], axis=-1) <= radius_px
    assert {tuple(pair) for pair in pairs} == chosen(moving, fixed, near, 0.95)
