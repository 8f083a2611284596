import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from photonpano.photometry import packed_along_width, packed_counts, reversed_bits


@given(n=st.integers(0, 600), height=st.integers(1, 5), width=st.integers(1, 41), seed=st.integers(0, 2**32 - 1))
def test_packed_counts_equals_sum_of_frames(n: int, height: int, width: int, seed: int) -> None:
    frames = np.random.default_rng(seed).integers(0, 2, (n, height, width), dtype=np.uint8)
    counts = packed_counts(np.packbits(frames, axis=-1), width)
    assert counts.dtype == np.uint32
    np.testing.assert_array_equal(counts, frames.sum(axis=0, dtype=np.uint32).reshape(height, width))


@pytest.mark.parametrize("n", [1, 9, 300])
def test_packed_counts_reads_little_bit_order(n: int) -> None:
    frames = np.random.default_rng(n).integers(0, 2, (n, 3, 43), dtype=np.uint8)
    packed = np.packbits(frames, axis=-1, bitorder="little")
    np.testing.assert_array_equal(packed_counts(packed, 43, bit_order="little"), frames.sum(axis=0))
    np.testing.assert_array_equal(reversed_bits(packed), np.packbits(frames, axis=-1))
    np.testing.assert_array_equal(reversed_bits(packed[:, ::-1]), np.packbits(frames, axis=-1)[:, ::-1])


@pytest.mark.parametrize("width", [1, 16, 43])
def test_packed_along_width_repacks_frames_packed_along_height(width: int) -> None:
    frames = np.random.default_rng(width).integers(0, 2, (5, 24, width), dtype=np.uint8)
    np.testing.assert_array_equal(packed_along_width(np.packbits(frames, axis=1)), np.packbits(frames, axis=2))


def test_packed_counts_ignores_padding_bits() -> None:
    np.testing.assert_array_equal(packed_counts(np.full((300, 2, 2), 255, np.uint8), 11), np.full((2, 11), 300))


def test_packed_counts_sums_frames_larger_than_a_block() -> None:
    packed = np.full((3, 1024, 512), 0b01000000, np.uint8)
    np.testing.assert_array_equal(packed_counts(packed, 4096), np.tile([0, 3, 0, 0, 0, 0, 0, 0], (1024, 512)))


def test_packed_counts_memory_does_not_grow_with_frames() -> None:
    packed = np.full((2000, 64, 62), 255, np.uint8)
    tracemalloc.start()
    try:
        packed_counts(packed, 496)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 4 * 1024**2


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


def test_packed_counts_adds_to_given_counts() -> None:
    packed = np.full((300, 3, 2), 0b10100000, np.uint8)
    for width in (16, 11):
        counts = np.full((3, width), 5, np.uint32)
        assert packed_counts(packed, width, counts) is counts
        np.testing.assert_array_equal(counts[:, :4], np.tile([305, 5, 305, 5], (3, 1)))


@pytest.mark.parametrize("counts", [np.zeros((3, 16), np.int64), np.zeros((2, 16), np.uint32), np.zeros((16, 3), np.uint32).T])
def test_packed_counts_refuses_counts_of_other_type(counts: np.ndarray) -> None:
    with pytest.raises(ValueError, match="counts must be contiguous uint32"):
        packed_counts(np.zeros((2, 3, 2), np.uint8), 16, counts)
