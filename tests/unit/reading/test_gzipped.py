import gzip
import os
from pathlib import Path

import numpy as np
import pytest

from photonpano import InputError
from photonpano.reading import unpacked

FRAMES = np.random.default_rng(0).integers(0, 256, (7, 5, 3), np.uint8)


def write(path: Path, frames: np.ndarray) -> None:
    with gzip.open(path, "wb") as file:
        np.save(file, frames)


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    write(tmp_path / "cube.npy.gz", FRAMES)
    return tmp_path / "cube.npy.gz"


def test_unpacked_copy_is_used_again_but_not_of_another_archive_or_if_it_was_written_to(archive: Path) -> None:
    copy = unpacked(archive)
    before = copy.stat()
    assert unpacked(archive).stat().st_ino == before.st_ino
    np.testing.assert_array_equal(np.load(unpacked(archive)), FRAMES)
    with copy.open("r+b") as file:
        file.seek(-1, os.SEEK_END)
        file.write(bytes([255 - int(FRAMES[-1, -1, -1])]))
    np.testing.assert_array_equal(np.load(unpacked(archive)), FRAMES)
    # An older archive of the same size, as after restoring a backup.
    write(archive, FRAMES[::-1])
    os.utime(archive, (0, 0))
    np.testing.assert_array_equal(np.load(unpacked(archive)), FRAMES[::-1])


def test_unpacking_replaces_no_symbolic_link(archive: Path, tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("content")
    link = tmp_path / "cube.npy.gz.unpacked.npy"
    link.symlink_to("precious")
    with pytest.raises(InputError) as caught:
        unpacked(archive)
    refused = f"cannot write {link}: it is a symbolic link; remove it, or choose another name"
    assert str(caught.value).startswith(f"{archive} is unpacked to a file beside it: {refused}; or link or copy it to a folder")
    assert (tmp_path / "precious").read_text() == "content"
