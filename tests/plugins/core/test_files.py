"""Captures in .npy files, packed and not, and in files without a header: layouts, compression, and what is refused."""

from __future__ import annotations

import gzip
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from photonpano import FrameSpan, InputError, PackedSource, Source, SourceContext
from photonpano.photometry import BinarySumResponse
from photonpano_core.sources import NPY, PACKED_NPY, PACKED_RAW, NpyConfig, PackedNpyConfig, PackedRawConfig


def cube(n: int = 40, height: int = 6, width: int = 24, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 2, (n, height, width), dtype=np.uint8)


BITS, PACKED = cube(width=19), np.packbits(cube(), axis=-1)
SUMS = np.random.default_rng(1).integers(0, 301, (40, 6, 19), dtype=np.uint16)


def saved(path: Path, array: np.ndarray) -> Path:
    np.save(path, array)
    return path


def opened(path: Path, **config: Any) -> PackedSource:
    return PACKED_NPY.build(PackedNpyConfig(path=path, **config), SourceContext())


def unpacked(path: Path, **config: Any) -> Source:
    return NPY.build(NpyConfig(path=path, **config), SourceContext())


def frames_last(frames: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(np.moveaxis(frames, 0, -1))


ALONG = {"packed_along": "height"}
LITTLE = {"bit_order": "little"}
# Frames, how they are stored, and the keys that read them.
LAYOUTS: dict[str, tuple[np.ndarray, Callable[[np.ndarray], np.ndarray], dict[str, Any]]] = {
    "whole bytes": (cube(), lambda frames: np.packbits(frames, axis=2), {}),
    "a width of 19": (cube(width=19), lambda frames: np.packbits(frames, axis=2), {"width": 19}),
    "lowest bit first": (cube(width=19), lambda frames: np.packbits(frames, axis=2, bitorder="little"), LITTLE | {"width": 19}),
    "along the height": (cube(height=16, width=21), lambda frames: np.packbits(frames, axis=1), ALONG),
    "along a height of 13": (
        cube(height=13, width=21),
        lambda frames: np.packbits(frames, axis=1, bitorder="little"),
        ALONG | LITTLE | {"height": 13},
    ),
    **{
        f"channel {channel}": (
            cube(width=19),
            lambda frames, channel=channel: np.packbits(np.roll(in_colour(frames), channel, axis=-1), axis=2),
            {"width": 19, "channel": channel},
        )
        for channel in range(3)
    },
    "a channel along the height": (
        cube(height=16),
        lambda frames: np.packbits(np.roll(in_colour(frames), 2, axis=-1), axis=1, bitorder="little"),
        ALONG | LITTLE | {"channel": 2},
    ),
}


def in_colour(frames: np.ndarray) -> np.ndarray:
    """Return frames with two other channels after them: (n, H, W, 3)."""
    return np.stack([frames, *(cube(*frames.shape, seed=seed) for seed in (1, 2))], axis=-1)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_frames_are_read_in_any_layout(tmp_path: Path, layout: str) -> None:
    frames, store, keys = LAYOUTS[layout]
    with opened(saved(tmp_path / "cube.npy", store(frames)), frame_rate_hz=96800, **keys) as source:
        assert str(source.info) == f"40 binary frames of {frames.shape[1]}x{frames.shape[2]} at 96,800 Hz"
        assert source.valid.all()
        assert source.valid.shape == frames.shape[1:]
        for span in (FrameSpan(0, 40), FrameSpan(7, 8), FrameSpan(13, 40)):
            part = frames[span.start : span.stop]
            np.testing.assert_array_equal(source.frames(span), part)
            np.testing.assert_array_equal(source.counts(span), part.sum(axis=0))
            np.testing.assert_array_equal(source.packed(span), np.packbits(part, axis=-1))


@pytest.fixture
def gzipped(tmp_path: Path) -> Path:
    path = tmp_path / "cube.npy.gz"
    path.write_bytes(gzip.compress(saved(tmp_path / "cube.npy", PACKED).read_bytes()))
    (tmp_path / "cube.npy").unlink()
    return path


def test_compressed_captures_are_unpacked_once(gzipped: Path, caplog: pytest.LogCaptureFixture) -> None:
    beside = gzipped.with_name("cube.npy.gz.unpacked.npy")
    message = f"{gzipped} is unpacked to {beside.name}, once"

    def read() -> list[str]:
        caplog.clear()
        with opened(gzipped) as source:
            np.testing.assert_array_equal(source.frames(source.info.span), cube())
        return caplog.messages

    assert list(PACKED_NPY.check(PackedNpyConfig(path=gzipped))) == []
    assert caplog.messages == [message]
    assert read() == []
    assert sorted(gzipped.parent.iterdir()) == [gzipped, beside]
    os.utime(gzipped, (beside.stat().st_mtime + 10,) * 2)
    assert read() == [message]
    assert read() == []
    os.truncate(beside, 100)
    assert read() == [message]


def problem_of(path: Path, array: np.ndarray, **config: Any) -> str | None:
    """Return what the check says of an array."""
    problems = PACKED_NPY.check(PackedNpyConfig(path=saved(path, array), **config))
    assert len(problems) <= 1
    return problems[0] if problems else None


@pytest.mark.parametrize("keys", [{"bit_order": "big"}, {"bit_order": "little"}, {"packed_along": "width"}])
def test_layout_that_the_spec_states_is_believed(tmp_path: Path, clouds: Callable, keys: dict[str, Any]) -> None:
    for packed in (np.packbits(clouds(), axis=2, bitorder="little"), clouds()):
        assert problem_of(tmp_path / "cube.npy", packed, **keys) is None


@pytest.mark.parametrize("dtype", [bool, np.uint8, np.int64, ">u2"])
@pytest.mark.parametrize("last", [False, True])
def test_bits_of_any_integer_type_are_a_packed_source(tmp_path: Path, dtype: Any, last: bool) -> None:
    stored = frames_last(BITS) if last else BITS
    path = saved(tmp_path / "cube.npy", stored.astype(dtype))
    with unpacked(path, holds="bits", frame_axis="last" if last else "first", frame_rate_hz=96800) as source:
        assert str(source.info) == "40 binary frames of 6x19 at 96,800 Hz"
        assert isinstance(source, PackedSource)
        span = FrameSpan(3, 30)
        np.testing.assert_array_equal(source.frames(span), BITS[3:30])
        np.testing.assert_array_equal(source.packed(span), np.packbits(BITS[3:30], axis=-1))
        np.testing.assert_array_equal(source.counts(span), BITS[3:30].sum(axis=0))


@pytest.mark.parametrize("dtype", [np.uint16, np.int64, ">u2"])
@pytest.mark.parametrize("last", [False, True])
def test_sums_have_the_response_of_their_number(tmp_path: Path, dtype: Any, last: bool) -> None:
    stored = frames_last(SUMS) if last else SUMS
    path = saved(tmp_path / "cube.npy", stored.astype(dtype))
    with unpacked(path, holds="sums", frames_per_sum=300, frame_axis="last" if last else "first") as source:
        assert str(source.info) == "40 9-bit frames of 6x19"
        assert source.response == BinarySumResponse(300)
        frames = source.frames(FrameSpan(3, 30))
        assert frames.dtype == np.uint16
        np.testing.assert_array_equal(frames, SUMS[3:30])
        np.testing.assert_array_equal(source.counts(FrameSpan(3, 30)), SUMS[3:30].sum(axis=0))


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"holds": "sums"}, "sums need frames_per_sum, the number of binary frames in each"),
        ({"holds": "bits", "frames_per_sum": 3}, "frames_per_sum is for sums; leave it out, or write holds: sums"),
    ],
)
def test_frames_per_sum_belongs_to_sums(keys: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        NpyConfig(path=Path("cube.npy"), **keys)


@pytest.mark.parametrize(
    ("n_bytes", "keys", "message"),
    [
        (
            47,
            {},
            "{path} ends within a frame: after 3 frames of 15 bytes come 2 bytes more; correct height and width, or cut off "
            "the rest with `truncate -s 45 {path}`",
        ),
        (14, {}, "{path} has 14 bytes, and a frame of 5x20 px takes 15; correct height and width"),
        (
            45,
            {"header_bytes": 40},
            "{path} has 45 bytes, and a frame of 5x20 px takes 15 after 40 bytes; correct height and width",
        ),
    ],
)
def test_file_without_whole_frames_is_refused(tmp_path: Path, n_bytes: int, keys: dict[str, int], message: str) -> None:
    path = tmp_path / "capture.raw"
    path.write_bytes(bytes(n_bytes))
    with pytest.raises(InputError) as caught:
        PACKED_RAW.build(PackedRawConfig(path=path, height=5, width=20, **keys), SourceContext())
    assert str(caught.value) == message.format(path=path)
