from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from photonpano import FrameSpan, InputError, PackedSource, Source, SourceContext
from photonpano.photometry import BinarySumResponse
from photonpano_core.sources.npy import NPY, NpyConfig

BITS = np.random.default_rng(0).integers(0, 2, (40, 6, 19), dtype=np.uint8)
SUMS = np.random.default_rng(1).integers(0, 301, (40, 6, 19), dtype=np.uint16)


def saved(path: Path, array: np.ndarray, **options: Any) -> Path:
    np.save(path, array, **options)
    return path


def opened(path: Path, **config: Any) -> Source:
    return NPY.build(NpyConfig(path=path, **config), SourceContext())


def frames_last(frames: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(np.moveaxis(frames, 0, -1))


@pytest.mark.parametrize("dtype", [bool, np.uint8, np.int64, ">u2"])
@pytest.mark.parametrize("last", [False, True])
def test_bits_of_any_integer_type_are_a_packed_source(tmp_path: Path, dtype: Any, last: bool) -> None:
    stored = frames_last(BITS) if last else BITS
    path = saved(tmp_path / "cube.npy", stored.astype(dtype))
    with opened(path, holds="bits", frame_axis="last" if last else "first", frame_rate_hz=96800) as source:
        assert str(source.info) == "40 binary frames of 6x19 at 96,800 Hz"
        assert isinstance(source, PackedSource)
        span = FrameSpan(3, 30)
        np.testing.assert_array_equal(source.frames(span), BITS[3:30])
        np.testing.assert_array_equal(source.packed(span), np.packbits(BITS[3:30], axis=-1))
        np.testing.assert_array_equal(source.counts(span), BITS[3:30].sum(axis=0))


def test_0_and_255_are_bits(tmp_path: Path) -> None:
    with opened(saved(tmp_path / "cube.npy", BITS * np.uint8(255)), holds="bits") as source:
        np.testing.assert_array_equal(source.frames(source.info.span), BITS)


@pytest.mark.parametrize("dtype", [np.uint16, np.int64, ">u2"])
@pytest.mark.parametrize("last", [False, True])
def test_sums_have_the_response_of_their_number(tmp_path: Path, dtype: Any, last: bool) -> None:
    stored = frames_last(SUMS) if last else SUMS
    path = saved(tmp_path / "cube.npy", stored.astype(dtype))
    with opened(path, holds="sums", frames_per_sum=300, frame_axis="last" if last else "first") as source:
        assert str(source.info) == "40 9-bit frames of 6x19"
        assert source.response == BinarySumResponse(300)
        frames = source.frames(FrameSpan(3, 30))
        assert frames.dtype == np.uint16
        np.testing.assert_array_equal(frames, SUMS[3:30])
        np.testing.assert_array_equal(source.counts(FrameSpan(3, 30)), SUMS[3:30].sum(axis=0))


def test_long_span_is_read_in_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("photonpano.reading.packed_files._READ_BYTES", 7 * 6 * 19)
    with opened(saved(tmp_path / "cube.npy", BITS), holds="bits") as source:
        np.testing.assert_array_equal(source.frames(source.info.span), BITS)
        np.testing.assert_array_equal(source.counts(FrameSpan(1, 40)), BITS[1:].sum(axis=0))


def test_compressed_file_is_unpacked_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "cube.npy.gz"
    path.write_bytes(gzip.compress(saved(tmp_path / "cube.npy", BITS).read_bytes()))
    assert list(NPY.check(NpyConfig(path=path, holds="bits"))) == []
    with opened(path, holds="bits") as source:
        np.testing.assert_array_equal(source.frames(source.info.span), BITS)
    assert (tmp_path / "cube.npy.gz.unpacked.npy").exists()


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


def test_axis_of_frames_that_the_spec_states_is_believed(tmp_path: Path, clouds: Callable) -> None:
    path = saved(tmp_path / "cube.npy", frames_last(clouds()))
    for frames in ("first", "last"):
        assert list(NPY.check(NpyConfig(path=path, holds="bits", frame_axis=frames))) == []


def test_frames_before_a_wrong_value_are_read(tmp_path: Path) -> None:
    array = BITS.copy()
    array[21, 4, 17] = 2
    with opened(saved(tmp_path / "cube.npy", array), holds="bits") as source:
        source.counts(FrameSpan(0, 21))
        for read in (source.counts, source.frames):
            with pytest.raises(InputError, match="holds the value 2 in frame 21, row 4, column 17"):
                read(FrameSpan(10, 30))
