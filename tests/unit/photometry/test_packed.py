import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from photonpano.photometry import packed_along_width, packed_counts


@given(n=st.integers(0, 600), height=st.integers(1, 5), width=st.integers(1, 41), seed=st.integers(0, 2**32 - 1))
def test_packed_counts_equals_sum_of_frames(n: int, height: int, width: int, seed: int) -> None:
    frames = np.random.default_rng(seed).integers(0, 2, (n, height, width), dtype=np.uint8)
    counts = packed_counts(np.packbits(frames, axis=-1), width)
    assert counts.dtype == np.uint32
    np.testing.assert_array_equal(counts, frames.sum(axis=0, dtype=np.uint32).reshape(height, width))


@pytest.mark.parametrize("width", [1, 16, 43])
def test_packed_along_width_repacks_frames_packed_along_height(width: int) -> None:
    frames = np.random.default_rng(width).integers(0, 2, (5, 24, width), dtype=np.uint8)
    np.testing.assert_array_equal(packed_along_width(np.packbits(frames, axis=1)), np.packbits(frames, axis=2))


@pytest.mark.parametrize(
    ("packed", "width"),
    [
        (np.zeros((2, 3, 4), np.int8), 32),
        (np.zeros((2, 3, 4, 3), np.uint8), 32),
        (np.zeros((2, 3, 4), np.uint8), 33),
        (np.zeros((2, 3, 4), np.uint8), 24),
    ],
)
def test_packed_counts_refuses_other_arrays(packed: np.ndarray, width: int) -> None:
    with pytest.raises(ValueError, match="packed frames of width"):
        packed_counts(packed, width)
