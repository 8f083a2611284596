"""The check of packed captures says what to write where the layout of a file is another than the spec's."""

from __future__ import annotations

import gzip
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano_core.sources.npy import PACKED_NPY, PackedNpyConfig


def problem_of(path: Path, array: np.ndarray, **config: Any) -> str | None:
    """Return what the check says of an array, without the path, and without figures."""
    np.save(path, array)
    problems = PACKED_NPY.check(PackedNpyConfig(path=path, **config))
    assert len(problems) <= 1
    return re.sub(r"\b0\.\d\d\b", "R", problems[0]).replace(str(path), "PATH") if problems else None


ACROSS = "pixels correlate by R within bytes, by R across their borders, and by R across their borders if"
MISTAKES = {
    "zeros and ones": (
        lambda frames: frames,
        "PATH is not packed: all of 2,359,296 bytes sampled are 0 or 1; write source: {use: npy, with: {path: PATH, "
        "holds: bits}}",
    ),
    "zeros and 255": (
        lambda frames: frames * np.uint8(255),
        "PATH is not packed: all of 2,359,296 bytes sampled are 0 or 255; write source: {use: npy, with: {path: PATH, "
        "holds: bits}}",
    ),
    "sums of four": (
        lambda frames: frames.reshape(96, 4, *frames.shape[1:]).sum(axis=1, dtype=np.uint8),
        "PATH is not packed: neighbouring bytes are alike as numbers, up to 4 in 589,824 sampled; write source: {use: npy, "
        "with: {path: PATH, holds: sums, frames_per_sum: 4}}, with the number of binary frames in a sum if it is larger",
    ),
    "lowest bit first": (
        lambda frames: np.packbits(frames, axis=2, bitorder="little"),
        f"PATH is packed in another order: {ACROSS} the first pixel is the lowest bit; write bit_order: little, or "
        "bit_order: big if it is right",
    ),
    "packed along the height": (
        lambda frames: np.packbits(frames, axis=1),
        f"PATH is packed in another order: {ACROSS} bytes are packed along the height; write packed_along: height, or "
        "bit_order: big if it is right",
    ),
    "packed along the height, lowest bit first": (
        lambda frames: np.packbits(frames, axis=1, bitorder="little"),
        f"PATH is packed in another order: {ACROSS} bytes are packed along the height, with the first pixel in the lowest "
        "bit; write packed_along: height and bit_order: little, or bit_order: big if it is right",
    ),
    "frames last": (
        lambda frames: np.ascontiguousarray(np.moveaxis(np.packbits(frames[:, :32, :48], axis=2), 0, -1)),
        "PATH has its frames along the last axis of (32, 6, 384), where values are most alike, and a byte holds eight pixels; "
        "save numpy.moveaxis(numpy.load(path), -1, 0) to another file, or write bit_order: big if it is right",
    ),
    "frames last and packed": (
        lambda frames: np.packbits(np.moveaxis(frames, 0, -1), axis=-1),
        "PATH has its frames along the last axis of (64, 96, 48), where values are most alike, and a byte holds eight frames; "
        "save numpy.packbits(numpy.moveaxis(numpy.unpackbits(numpy.load(path), axis=-1), -1, 0), axis=-1) to another file, "
        "or write bit_order: big if it is right",
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_check_says_what_to_write_for_another_layout(tmp_path: Path, clouds: Callable, mistake: str) -> None:
    store, message = MISTAKES[mistake]
    frames = clouds()
    assert problem_of(tmp_path / "cube.npy", np.packbits(frames, axis=2)) is None
    assert problem_of(tmp_path / "cube.npy", store(frames)) == message


def test_path_in_the_line_to_write_is_quoted_where_yaml_needs_it(tmp_path: Path, clouds: Callable) -> None:
    message = problem_of(tmp_path / "scan: 2, {a}.npy", clouds(n_frames=16))
    assert str(message).endswith('write source: {use: npy, with: {path: "PATH", holds: bits}}')


@pytest.mark.parametrize("keys", [{"bit_order": "big"}, {"bit_order": "little"}, {"packed_along": "width"}])
def test_layout_that_the_spec_states_is_believed(tmp_path: Path, clouds: Callable, keys: dict[str, Any]) -> None:
    for packed in (np.packbits(clouds(), axis=2, bitorder="little"), clouds()):
        assert problem_of(tmp_path / "cube.npy", packed, **keys) is None


def test_layout_of_each_channel_is_checked(tmp_path: Path, clouds: Callable) -> None:
    stored = np.packbits(np.repeat(clouds(n_frames=128)[..., None], 3, axis=-1), axis=2, bitorder="little")
    assert "write bit_order: little" in str(problem_of(tmp_path / "cube.npy", stored, channel=2))


def test_layout_of_a_compressed_capture_is_checked(tmp_path: Path, clouds: Callable) -> None:
    path = tmp_path / "cube.npy.gz"
    with gzip.open(path, "wb") as file:
        np.save(file, np.packbits(clouds(), axis=2, bitorder="little"))
    (problem,) = PACKED_NPY.check(PackedNpyConfig(path=path))
    assert problem.endswith("write bit_order: little, or bit_order: big if it is right")
