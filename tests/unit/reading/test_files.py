from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from pydantic import BaseModel

from photonpano import FrameSpan, InputError
from photonpano.reading import FrameFile, FrameLayout, PackedFileSource, files_in, read_json


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


def open_files() -> int:
    return len(list(Path("/dev/fd").iterdir()))


def test_at_most_16_files_stay_open(source: PackedFileSource) -> None:
    before = open_files()

    def read(first: int) -> int:
        for start in range(first, 190):
            span = FrameSpan(start, start + 10)
            np.testing.assert_array_equal(source.counts(span), FRAMES[start : start + 10].sum(axis=0))
        return open_files()

    with source, ThreadPoolExecutor(4) as pool:
        assert open_files() == before, "nothing is opened before it is read"
        assert max(pool.map(read, range(4))) <= before + 16 + 4
    assert open_files() == before


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
