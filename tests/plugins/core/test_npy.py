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


NO_BIT = "bits are 0 and 1, or 0 and 255; write holds: sums for sums, or use packed-npy for bytes of eight pixels"


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


WRONG_ARRAYS = {
    "float": (
        BITS.astype(np.float32),
        "{path} holds float32 values; bits are bool or whole numbers: convert them with cube.astype(bool)",
    ),
    "objects": (
        np.array([{}], dtype=object),
        "{path} holds object values; bits are bool or whole numbers: convert them with cube.astype(bool)",
    ),
    "flat": (BITS[0], "{path} has the shape (6, 19); a capture has 3 dimensions, frames, height and width"),
    "empty": (BITS[:0], "{path} is empty: its shape is (0, 6, 19) (frames, height, width)"),
    "Fortran order": (
        np.asfortranarray(BITS),
        "{path} is stored in Fortran order; save it again with numpy.ascontiguousarray(cube)",
    ),
}


@pytest.mark.parametrize("case", WRONG_ARRAYS)
def test_wrong_arrays_are_refused(tmp_path: Path, case: str) -> None:
    array, message = WRONG_ARRAYS[case]
    path = saved(tmp_path / "cube.npy", array, allow_pickle=True)
    assert_refused(message.format(path=path), path, holds="bits")


def assert_refused(message: str, path: Path, **config: Any) -> None:
    """The check tells what the build raises."""
    with pytest.raises(InputError) as caught:
        opened(path, **config)
    assert str(caught.value) == message
    assert list(NPY.check(NpyConfig(path=path, **config))) == [message]


def test_float_sums_are_refused_with_a_type_for_sums(tmp_path: Path) -> None:
    path = saved(tmp_path / "cube.npy", SUMS.astype(">f8"))
    assert_refused(
        f"{path} holds >f8 values; sums are bool or whole numbers: convert them with cube.astype(numpy.uint16)",
        path,
        holds="sums",
        frames_per_sum=300,
    )


def test_truncated_file_is_refused_with_both_sizes(tmp_path: Path) -> None:
    path = saved(tmp_path / "cube.npy", BITS)
    whole = path.stat().st_size
    path.write_bytes(path.read_bytes()[:-100])
    for frames in ("first", "last"):
        assert_refused(
            f"{path} is cut short: its header (40, 6, 19) promises {whole} bytes, the file has {whole - 100}; "
            "copy or record it again",
            path,
            holds="bits",
            frame_axis=frames,
        )


@pytest.mark.parametrize(
    ("value", "dtype", "keys", "remedy"),
    [
        (2, np.uint8, {"holds": "bits"}, NO_BIT),
        (-1, np.int8, {"holds": "bits"}, NO_BIT),
        (
            301,
            np.uint16,
            {"holds": "sums", "frames_per_sum": 300},
            "sums of frames_per_sum: 300 go from 0 to 300; correct frames_per_sum",
        ),
        (
            2**63 + 5,
            np.uint64,
            {"holds": "sums", "frames_per_sum": 65535},
            "sums of frames_per_sum: 65535 go from 0 to 65535; correct frames_per_sum",
        ),
        (
            -7,
            np.int16,
            {"holds": "sums", "frames_per_sum": 300},
            "sums of frames_per_sum: 300 go from 0 to 300; correct frames_per_sum",
        ),
    ],
)
@pytest.mark.parametrize("last", [False, True])
def test_value_out_of_range_is_named_with_its_place(
    tmp_path: Path, value: int, dtype: Any, keys: dict[str, Any], remedy: str, last: bool
) -> None:
    array = BITS.astype(dtype)
    array[21, 4, 17] = value
    path = saved(tmp_path / "cube.npy", frames_last(array) if last else array)
    with opened(path, **keys, frame_axis="last" if last else "first") as source:
        source.counts(FrameSpan(0, 21))
        for read in (source.counts, source.frames):
            with pytest.raises(InputError) as caught:
                read(FrameSpan(10, 30))
            assert str(caught.value) == f"{path} holds the value {value} in frame 21, row 4, column 17; {remedy}"


def test_check_reads_some_frames(tmp_path: Path) -> None:
    path = saved(tmp_path / "cube.npy", np.minimum(SUMS + 2, 299))
    value = int(min(SUMS[0, 0, 0] + 2, 299))
    for keys, remedy in (
        ({"holds": "bits"}, NO_BIT),
        (
            {"holds": "sums", "frames_per_sum": 1},
            "sums of frames_per_sum: 1 go from 0 to 1; correct frames_per_sum",
        ),
    ):
        (problem,) = NPY.check(NpyConfig(path=path, **keys))
        assert problem == f"{path} holds the value {value} in frame 0, row 0, column 0; {remedy}"


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


def test_frames_that_seem_to_be_last_are_refused_unless_the_spec_states_their_axis(tmp_path: Path, clouds: Callable) -> None:
    path = saved(tmp_path / "cube.npy", frames_last(clouds()))
    assert_refused(
        f"{path} has its frames along the last axis of (64, 96, 384), where values are most alike; write frame_axis: last, or "
        "frame_axis: first if it is right",
        path,
        holds="bits",
    )
    for frames in ("first", "last"):
        assert list(NPY.check(NpyConfig(path=path, holds="bits", frame_axis=frames))) == []
