from __future__ import annotations

import gzip
import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from photonpano import FrameSpan, InputError, OutputError, SourceContext
from photonpano.reading import PackedFileSource
from photonpano_core.sources.npy import PACKED_NPY, PackedNpyConfig


def cube(n: int = 40, height: int = 6, width: int = 24, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 2, (n, height, width), dtype=np.uint8)


def saved(path: Path, array: np.ndarray, **options: Any) -> Path:
    np.save(path, array, **options)
    return path


def opened(path: Path, **config: Any) -> PackedFileSource:
    source = PACKED_NPY.build(PackedNpyConfig(path=path, **config), SourceContext())
    assert isinstance(source, PackedFileSource)
    return source


@pytest.mark.parametrize("width", [24, 19])
def test_frames_and_counts_equal_the_array(tmp_path: Path, width: int) -> None:
    frames = cube(width=width)
    path = saved(tmp_path / "cube.npy", np.packbits(frames, axis=-1))
    with opened(path, width=width, frame_rate_hz=96800) as source:
        assert (source.info.n_frames, source.info.frame_shape, source.info.frame_rate_hz) == (40, (6, width), 96800)
        assert (source.info.kind, source.info.bit_depth) == ("binary", 1)
        assert source.valid.all()
        assert source.valid.shape == (6, width)
        for span in (FrameSpan(0, 40), FrameSpan(7, 8), FrameSpan(13, 40)):
            np.testing.assert_array_equal(source.frames(span), frames[span.start : span.stop])
            np.testing.assert_array_equal(source.counts(span), frames[span.start : span.stop].sum(axis=0))


def test_width_defaults_to_whole_bytes(tmp_path: Path) -> None:
    path = saved(tmp_path / "cube.npy", np.packbits(cube(width=19), axis=-1))
    with opened(path) as source:
        assert source.info.frame_shape == (6, 24)


def test_lit_padding_bits_are_ignored(tmp_path: Path) -> None:
    with opened(saved(tmp_path / "cube.npy", np.full((3, 2, 2), 255, np.uint8)), width=11) as source:
        np.testing.assert_array_equal(source.counts(FrameSpan(0, 3)), np.full((2, 11), 3))
        assert source.frames(FrameSpan(0, 3)).shape == (3, 2, 11)


def test_source_is_read_from_many_threads(tmp_path: Path) -> None:
    frames = cube(n=400)
    start = threading.Barrier(4)

    def read(offset: int) -> bool:
        start.wait()
        spans = [FrameSpan(first, first + 50) for first in range(offset, 350, 4)]
        return all(np.array_equal(source.counts(s), frames[s.start : s.stop].sum(axis=0)) for s in spans)

    with opened(saved(tmp_path / "cube.npy", np.packbits(frames, axis=-1))) as source, ThreadPoolExecutor(4) as pool:
        assert all(pool.map(read, range(4)))


@pytest.mark.parametrize("width", [24, 19])
def test_channel_of_a_colour_capture_is_read(tmp_path: Path, width: int) -> None:
    channels = [cube(width=width, seed=seed) for seed in range(3)]
    path = saved(tmp_path / "cube.npy", np.packbits(np.stack(channels, axis=-1), axis=2))
    for channel, frames in enumerate(channels):
        with opened(path, width=width, channel=channel) as source:
            np.testing.assert_array_equal(source.frames(source.info.span), frames)
            np.testing.assert_array_equal(source.counts(FrameSpan(3, 30)), frames[3:30].sum(axis=0))
            np.testing.assert_array_equal(source.packed(FrameSpan(3, 30)), np.packbits(frames[3:30], axis=-1))


@pytest.mark.parametrize("bit_order", ["big", "little"])
@pytest.mark.parametrize("height", [16, 13])
def test_frames_packed_along_the_height_are_read(tmp_path: Path, bit_order: Any, height: int) -> None:
    frames = cube(height=height, width=21)
    path = saved(tmp_path / "cube.npy", np.packbits(frames, axis=1, bitorder=bit_order))
    with opened(path, packed_along="height", bit_order=bit_order, height=height) as source:
        assert source.info.frame_shape == (height, 21)
        np.testing.assert_array_equal(source.frames(FrameSpan(3, 30)), frames[3:30])
        np.testing.assert_array_equal(source.counts(FrameSpan(3, 30)), frames[3:30].sum(axis=0))
        np.testing.assert_array_equal(source.packed(FrameSpan(3, 30)), np.packbits(frames[3:30], axis=-1))


def test_colour_packed_along_the_height_is_read(tmp_path: Path) -> None:
    frames = np.stack([cube(height=16, seed=seed) for seed in range(3)], axis=-1)
    path = saved(tmp_path / "cube.npy", np.packbits(frames, axis=1, bitorder="little"))
    with opened(path, packed_along="height", bit_order="little", channel=2) as source:
        np.testing.assert_array_equal(source.frames(source.info.span), frames[..., 2])


def test_frames_with_the_first_pixel_in_the_lowest_bit_are_read(tmp_path: Path) -> None:
    frames = cube(width=19)
    path = saved(tmp_path / "cube.npy", np.packbits(frames, axis=2, bitorder="little"))
    with opened(path, bit_order="little", width=19) as source:
        np.testing.assert_array_equal(source.frames(source.info.span), frames)
        np.testing.assert_array_equal(source.packed(FrameSpan(3, 30)), np.packbits(frames[3:30], axis=-1))


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        (
            {"packed_along": "height", "height": 40},
            "has columns of 6 bytes, which hold a height of 41 to 48, not 40; correct the height",
        ),
        ({"packed_along": "height", "width": 24}, "has 3 columns, not 24; correct the width, or leave it out"),
        ({"height": 48}, "has 6 rows, not 48; correct the height, or leave it out"),
    ],
)
def test_size_that_does_not_fit_the_array_is_refused(tmp_path: Path, keys: dict[str, Any], words: str) -> None:
    path = saved(tmp_path / "cube.npy", PACKED)
    assert_refused(f"{path} {words}", path, **keys)


def test_channel_without_colour_is_refused(tmp_path: Path) -> None:
    path = saved(tmp_path / "cube.npy", PACKED)
    assert_refused(f"{path} has the shape (40, 6, 3) and no channels; leave out channel: 2", path, channel=2)


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
    assert not beside.exists()
    assert read() == [message]
    assert read() == []
    assert sorted(gzipped.parent.iterdir()) == [gzipped, beside]
    os.utime(gzipped, (beside.stat().st_mtime + 10,) * 2)
    assert read() == []
    os.truncate(beside, 100)
    assert read() == [message]


@pytest.mark.parametrize(
    ("damaged", "words"),
    [
        (lambda content: content[:-12], "is cut short or damaged: gzip cannot unpack it; copy it again"),
        (lambda content: content[:15], "holds no .npy file; compress one that numpy.save has written"),
        (lambda content: content[:-6] + b"wrong!", "is cut short or damaged: gzip cannot unpack it; copy it again"),
        (lambda _: gzip.compress(b"text"), "holds no .npy file; compress one that numpy.save has written"),
        (
            lambda content: gzip.compress(gzip.decompress(content)[:-1]),
            "is damaged: the header of its array promises 848 bytes, there are 847; copy or record it again",
        ),
        (
            lambda content: gzip.compress(gzip.decompress(content) + b"1"),
            "is damaged: the header of its array promises 848 bytes, there are more; copy or record it again",
        ),
    ],
)
def test_damaged_compressed_captures_leave_no_files(gzipped: Path, damaged: Callable, words: str) -> None:
    gzipped.write_bytes(damaged(gzipped.read_bytes()))
    with pytest.raises(InputError) as caught:
        opened(gzipped)
    assert str(caught.value) == f"{gzipped} {words}"
    assert list(gzipped.parent.iterdir()) == [gzipped]


def test_full_disk_is_reported_before_unpacking(gzipped: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=847))
    with pytest.raises(OutputError) as caught:
        opened(gzipped)
    beside = gzipped.with_name("cube.npy.gz.unpacked.npy")
    assert str(caught.value) == (
        f"cannot write {beside}: it takes 848 B, and its disk has 847 B free; free some space or choose another folder"
    )
    assert list(gzipped.parent.iterdir()) == [gzipped]


def test_span_beyond_the_end_is_refused(tmp_path: Path) -> None:
    with opened(saved(tmp_path / "cube.npy", np.packbits(cube(), axis=-1))) as source:
        for read in (source.counts, source.frames):
            with pytest.raises(InputError) as caught:
                read(FrameSpan(30, 41))
            assert str(caught.value) == "frames 30 to 40 were requested, but the capture has 40 frames (0 to 39)"


PACKED = np.packbits(cube(), axis=-1)

WRONG_ARRAYS = {
    "dtype": (
        cube().astype(np.float32),
        "{path} holds float32 values, not bytes of eight pixels; pack frames of zeros and ones with "
        "numpy.packbits(cube, axis=-1)",
    ),
    "bool": (
        cube().astype(bool),
        "{path} holds bool values, not bytes of eight pixels; write source: {{use: npy, with: {{path: {path}, holds: bits}}}}",
    ),
    "sums": (
        3 * cube().astype(np.int64),
        "{path} holds int64 values, not bytes of eight pixels; write source: {{use: npy, with: {{path: {path}, holds: sums, "
        "frames_per_sum: 3}}}}, with the number of binary frames in a sum if it is larger",
    ),
    "objects": (
        np.array([{}], dtype=object),
        "{path} holds object values, not bytes of eight pixels; pack frames of zeros and ones with "
        "numpy.packbits(cube, axis=-1)",
    ),
    "colour": (
        np.zeros((4, 6, 3, 3), np.uint8),
        "{path} is a capture in colour, of shape (4, 6, 3, 3); choose a channel: 0, 1 or 2",
    ),
    "flat": (
        np.zeros((4, 6), np.uint8),
        "{path} has the shape (4, 6); a packed capture has 3 dimensions, frames, height and bytes of a row, and one of colour "
        "a fourth, of 3 channels",
    ),
    "no frames": (
        np.zeros((0, 6, 3), np.uint8),
        "{path} is empty: its shape is (0, 6, 3) (frames, height, bytes of a row)",
    ),
    "Fortran order": (
        np.asfortranarray(PACKED),
        "{path} is stored in Fortran order; save it again with numpy.ascontiguousarray(cube)",
    ),
}


def assert_refused(message: str, path: Path, **config: Any) -> None:
    """The check tells what the build raises."""
    with pytest.raises(InputError) as caught:
        opened(path, **config)
    assert str(caught.value) == message
    assert list(PACKED_NPY.check(PackedNpyConfig(path=path, **config))) == [message]


@pytest.mark.parametrize("case", WRONG_ARRAYS)
def test_wrong_arrays_are_refused(tmp_path: Path, case: str) -> None:
    array, message = WRONG_ARRAYS[case]
    path = saved(tmp_path / "cube.npy", array, allow_pickle=True)
    assert_refused(message.format(path=path), path)


def test_missing_file_and_folder_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "cube.npy"
    assert_refused(f"there is no file {path}; check the path", path)
    assert_refused(f"{tmp_path} is a folder; name the .npy file in it", tmp_path)


@pytest.mark.parametrize(
    ("content", "guess"),
    [
        (b"", ": it is empty"),
        (b"PK\x03\x04 something", ": it is an archive; save the array in it with numpy.save"),
        (b"\x93NUMPY\x01\x00\x10\x00{'descr': broken", " that can be read: its header is damaged; write it again"),
        (bytes(1000), ", by its first bytes; write it with numpy.save"),
    ],
)
def test_files_of_other_formats_are_refused(tmp_path: Path, content: bytes, guess: str) -> None:
    path = tmp_path / "cube.npy"
    path.write_bytes(content)
    assert_refused(f"{path} is not a .npy file{guess}", path)


def test_truncated_file_is_refused_with_both_sizes(tmp_path: Path) -> None:
    path = saved(tmp_path / "cube.npy", PACKED)
    whole = path.stat().st_size
    path.write_bytes(path.read_bytes()[:-100])
    assert_refused(
        f"{path} is cut short: its header (40, 6, 3) promises {whole} bytes, the file has {whole - 100}; "
        "copy or record it again",
        path,
    )


@pytest.mark.parametrize("width", [16, 25])
def test_width_that_does_not_fit_the_rows_is_refused(tmp_path: Path, width: int) -> None:
    path = saved(tmp_path / "cube.npy", PACKED)
    assert_refused(
        f"{path} has rows of 3 bytes, which hold a width of 17 to 24, not {width}; correct the width", path, width=width
    )


def test_unpacked_frames_are_refused_by_their_width(tmp_path: Path) -> None:
    path = saved(tmp_path / "cube.npy", cube())
    assert_refused(
        f"{path} has rows of 24 bytes, which hold a width of 185 to 192, not 24; "
        f"it seems not to be packed: write source: {{use: npy, with: {{path: {path}, holds: bits}}}}",
        path,
        width=24,
    )


def test_file_that_shrinks_while_read_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "cube.npy"
    np.save(path, np.zeros((100, 16, 2), np.uint8))
    with opened(path) as source:
        os.truncate(path, 1000)
        assert not source.counts(FrameSpan(0, 10)).any()
        with pytest.raises(InputError) as caught:
            source.counts(FrameSpan(10, 100))
    assert str(caught.value) == f"{path} has become shorter while it was read; copy or record it again"


def test_negative_shape_is_refused(tmp_path: Path) -> None:
    path = saved(tmp_path / "cube.npy", PACKED)
    path.write_bytes(path.read_bytes().replace(b"(40, 6, 3)", b"(-4,-6, 3)"))
    assert_refused(f"{path} is empty: its shape is (-4, -6, 3) (frames, height, bytes of a row)", path)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


@settings(deadline=None, max_examples=100)
@given(changes=st.dictionaries(st.integers(0, 127), st.integers(0, 255), min_size=1, max_size=4))
def test_damaged_headers_raise_input_error_only(folder: Path, changes: dict[int, int]) -> None:
    path = saved(folder / "cube.npy", PACKED)
    content = bytearray(path.read_bytes())
    for place, value in changes.items():
        content[place] = value
    path.write_bytes(content)
    try:
        with opened(path) as source:
            source.counts(FrameSpan(0, 1))
    except InputError:
        pass
