"""Files and arrays that hold captures."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import BaseModel

from photonpano import FrameSpan, InputError
from photonpano.geometry import translation
from photonpano.reading import (
    FrameFile,
    FrameLayout,
    PackedFileSource,
    eight_frames_are_first,
    files_in,
    frames_are_last,
    read_json,
    unpacked_content,
)
from photonpano.testing.captures import detected, seen_along, textured


def test_files_in_returns_natural_order(tmp_path: Path) -> None:
    names = ["a2/f10.bin", "a2/f9.BIN", "a10/f1.bin", "f2.bin", "f0.bin", "f02.bin", "f10.bin"]
    for name in [*names, "a2/notes.txt", ".f1.bin", "a2/._f1.bin"]:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    found = [str(path.relative_to(tmp_path)) for path in files_in(tmp_path, ".bin")]
    assert found == ["a2/f9.BIN", "a2/f10.bin", "a10/f1.bin", "f0.bin", "f02.bin", "f2.bin", "f10.bin"]
    assert files_in(tmp_path / "a2" / "notes.txt", ".bin") == [tmp_path / "a2" / "notes.txt"]


FRAMES = np.random.default_rng(0).integers(0, 2, (200, 4, 16), dtype=np.uint8)


@pytest.fixture
def source(tmp_path: Path) -> PackedFileSource:
    """Spread frames over 100 files, after a header of three bytes."""
    files = []
    for number, part in enumerate(np.array_split(FRAMES, 100)):
        path = tmp_path / f"{number}.bin"
        path.write_bytes(b"top" + np.packbits(part, axis=-1).tobytes())
        files.append(FrameFile(path, len(part), 3))
    return PackedFileSource(files, FrameLayout((4, 16), (4, 2)))


def test_missing_file_is_named_when_read(source: PackedFileSource, tmp_path: Path) -> None:
    (tmp_path / "7.bin").unlink()
    source.counts(FrameSpan(0, 14))
    with pytest.raises(InputError) as caught:
        source.counts(FrameSpan(13, 16))
    assert str(caught.value) == f"there is no file {tmp_path / '7.bin'}; check the path"


class Size(BaseModel):
    height: int


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"[1]", " is wrong: Input should be an object; write it again"),
        (b'{"height": "tall"}', " is wrong at height: Input should be a valid integer, unable to parse string as an integer; "),
        (b"\xff", " is wrong: Invalid JSON: "),
    ],
)
def test_read_json_refuses_what_does_not_fit_the_model(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "size.json"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_json(path, Size)
    assert str(caught.value).startswith(f"{path}{message}")
    path.write_bytes(b'{"height": 3, "width": 4}')
    assert read_json(path, Size).height == 3


def summed(frames: np.ndarray, n: int) -> np.ndarray:
    return frames[: len(frames) // n * n].reshape(-1, n, *frames.shape[1:]).sum(axis=1, dtype=np.uint8)


def last(frames: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(np.moveaxis(frames, 0, -1))


@pytest.mark.parametrize("dtype", [bool, np.uint8, np.int64, ">u2"])
def test_zeros_and_ones_are_bits(clouds: Callable[..., np.ndarray], dtype: Any) -> None:
    assert unpacked_content([clouds(0.003, n_frames=40).astype(dtype)])[:2] == ("bits", 1)


@pytest.mark.parametrize("flux", [2.0, 0.3, 0.01])
@pytest.mark.parametrize("n", [4, 64, 255])
def test_counts_of_any_height_are_sums(clouds: Callable[..., np.ndarray], n: int, flux: float) -> None:
    sums = summed(clouds(flux, n_frames=510), n)
    found = unpacked_content([sums])
    assert found == ("sums", sums.max(), sums.size)


def test_last_axis_is_that_of_the_frames_where_values_are_most_alike(clouds: Callable[..., np.ndarray]) -> None:
    frames = clouds(n_frames=512)
    for content in (frames, summed(frames, 2)):
        assert not frames_are_last([content], content.shape)
        moved = last(content)
        assert frames_are_last([moved], moved.shape)


@pytest.mark.parametrize("flux", [0.05, 0.4])
def test_axis_of_bytes_that_hold_eight_frames_is_found(flux: float) -> None:
    scene = textured((70, 140), flux, seed=2).astype(np.float32)
    path = np.array([translation(5 + 0.15 * frame, 5 + 3 * np.sin(frame / 60)) for frame in range(400)])
    frames = detected(seen_along(scene, path, (56, 64)))
    assert eight_frames_are_first([np.packbits(frames, axis=0)])
    assert not eight_frames_are_first([np.packbits(np.moveaxis(frames, 0, -1), axis=-1)])
