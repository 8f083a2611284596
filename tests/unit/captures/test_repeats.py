"""Frames that are copies of the frame before are found; dark frames, which are alike by chance, are none."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from photonpano.captures.obstacles import timeline_of
from photonpano.context import Context
from photonpano.reading import FrameFile, FrameLayout, PackedFileSource
from photonpano.testing import MemorySource

RNG = np.random.default_rng(8)


def repeated(folder: Path, frames: np.ndarray) -> list[int]:
    """Return the numbers of the repeated frames."""
    np.packbits(frames, axis=2).tofile(folder / "cube.bin")
    file, layout = FrameFile(folder / "cube.bin", len(frames)), FrameLayout((40, 64), (40, 8), "big")
    with PackedFileSource([file], layout) as source:
        return (np.flatnonzero(np.diff(timeline_of(source, Context(2)).taken) == 0) + 1).tolist()


def taken(n_frames: int, share: float = 0.2) -> np.ndarray:
    return RNG.random((n_frames, 40, 64)) < share


def test_copies_of_the_frame_before_are_found_across_blocks(tmp_path: Path) -> None:
    order = np.sort(np.concatenate([np.arange(520), [3, 100, 100, 255, 256]]))
    assert repeated(tmp_path, taken(520)[order]) == [4, 102, 103, 259, 261]


def test_independent_and_dark_and_saturated_frames_are_no_copies(tmp_path: Path) -> None:
    frames = taken(60)
    frames[20:30] = False
    frames[40:50] = True
    frames[:, 5, 5] = True
    assert repeated(tmp_path, frames) == []


def test_source_without_packed_frames_is_taken_as_regular() -> None:
    frames = taken(10)
    frames[5] = frames[4]
    np.testing.assert_array_equal(timeline_of(MemorySource(frames), Context()).taken, np.arange(10))
