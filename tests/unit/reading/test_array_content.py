from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from photonpano.reading import frames_are_last, packed_frames_are_last, unpacked_content


def summed(frames: np.ndarray, n: int) -> np.ndarray:
    return frames[: len(frames) // n * n].reshape(-1, n, *frames.shape[1:]).sum(axis=1, dtype=np.uint8)


def last(frames: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(np.moveaxis(frames, 0, -1))


@pytest.mark.parametrize("dtype", [bool, np.uint8, np.int64, ">u2"])
def test_zeros_and_ones_are_bits(clouds: Callable[..., np.ndarray], dtype: Any) -> None:
    assert unpacked_content([clouds(0.003, n_frames=40).astype(dtype)])[:3] == ("bits", 0, 1)


def test_zeros_and_255_are_bits(clouds: Callable[..., np.ndarray]) -> None:
    assert unpacked_content([clouds(n_frames=40) * np.uint8(255)])[:3] == ("bits", 0, 255)


@pytest.mark.parametrize("flux", [2.0, 0.3, 0.01])
@pytest.mark.parametrize("n", [4, 64, 255])
def test_counts_of_any_height_are_sums(clouds: Callable[..., np.ndarray], n: int, flux: float) -> None:
    sums = summed(clouds(flux, n_frames=510), n)
    found = unpacked_content([sums])
    assert found == ("sums", sums.min(), sums.max(), sums.size)


def test_sums_with_hot_pixels_are_sums(clouds: Callable[..., np.ndarray]) -> None:
    frames = clouds(0.05, n_frames=510)
    frames[:, np.random.default_rng(0).random(frames.shape[1:]) < 0.03] = 1
    assert unpacked_content([summed(frames, 255)]).holds == "sums"


@pytest.mark.parametrize("axis", [1, 2])
@pytest.mark.parametrize("order", ["big", "little"])
@pytest.mark.parametrize("flux", [3.0, 0.3, 0.003])
def test_packed_pixels_are_neither(clouds: Callable[..., np.ndarray], axis: int, order: Any, flux: float) -> None:
    assert unpacked_content([np.packbits(clouds(flux, n_frames=64), axis=axis, bitorder=order)]) is None


@pytest.mark.parametrize("side", [1, 2, 4, 8])
def test_packed_chequers_are_no_numbers(side: int) -> None:
    y, x = np.mgrid[:64, :96]
    chequers = np.repeat(((x // side + y // side) % 2).astype(np.uint8)[None], 16, axis=0)
    assert unpacked_content([np.packbits(chequers, axis=2)]) is None


@pytest.mark.parametrize("value", [0, 1, 255])
def test_single_value_tells_nothing(value: int) -> None:
    frames = np.zeros((20, 8, 8), np.uint8)
    frames[:, 3, 4] = value  # as of one hot pixel
    assert unpacked_content([frames]) is None


def test_last_axis_is_that_of_the_frames_where_values_are_most_alike(clouds: Callable[..., np.ndarray]) -> None:
    frames = clouds(n_frames=512)
    for content in (frames, summed(frames, 2)):
        assert not frames_are_last([content], content.shape)
        moved = last(content)
        assert frames_are_last([moved], moved.shape)


def test_last_axis_of_packed_frames_is_found(clouds: Callable[..., np.ndarray]) -> None:
    frames = clouds(n_frames=1024)
    packed = np.packbits(frames, axis=2)
    for holds in ("pixels", "frames"):
        assert not packed_frames_are_last([packed], packed.shape, holds)
    for stored, holds in ((last(packed), "pixels"), (np.packbits(last(frames), axis=-1), "frames")):
        assert packed_frames_are_last([stored], stored.shape, holds)


def test_last_axis_of_fast_packed_frames_is_found_by_the_axis_that_is_packed(clouds: Callable[..., np.ndarray]) -> None:
    stored = last(np.packbits(clouds(n_frames=1024)[::5, :, :32], axis=2))  # 1 px a frame
    assert packed_frames_are_last([stored], stored.shape, "pixels")


def test_wide_short_noise_has_its_frames_first() -> None:
    alarms = [
        frames_are_last([np.random.default_rng(seed).integers(0, 2, (24, 32, 128), np.uint8)], (24, 32, 128))
        for seed in range(100)
    ]
    assert not any(alarms)
