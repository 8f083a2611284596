from __future__ import annotations

import errno
import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from photonpano import OutputError
from photonpano.atomic import atomic_folder, atomic_path


def test_atomic_path_creates_the_file_when_the_block_ends(tmp_path: Path) -> None:
    final = tmp_path / "result.bin"
    with atomic_path(final) as temporary:
        temporary.write_bytes(b"half")
        assert not final.exists()
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".bin"
        temporary.write_bytes(b"whole")
    assert final.read_bytes() == b"whole"
    assert list(tmp_path.iterdir()) == [final]


def test_atomic_path_follows_the_umask(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        with atomic_path(tmp_path / "result.bin") as temporary:
            temporary.write_bytes(b"whole")
    finally:
        os.umask(before)
    assert (tmp_path / "result.bin").stat().st_mode & 0o777 == 0o640


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_atomic_path_keeps_the_old_file_on_failure(tmp_path: Path, error: type[BaseException]) -> None:
    final = tmp_path / "result.bin"
    final.write_bytes(b"old")
    with pytest.raises(error), atomic_path(final) as temporary:
        raise error(temporary.write_bytes(b"new"))
    assert final.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [final]


def test_atomic_path_names_a_missing_folder(tmp_path: Path) -> None:
    final = tmp_path / "nowhere" / "result.bin"
    with pytest.raises(OutputError) as caught, atomic_path(final):
        raise AssertionError("the block must not run")
    assert str(caught.value) == (
        f"cannot write {final}: there is no folder {tmp_path / 'nowhere'}; create it or choose another"
    )


def test_atomic_path_refuses_a_folder_before_the_work(tmp_path: Path) -> None:
    with pytest.raises(OutputError) as caught, atomic_path(tmp_path):
        raise AssertionError("the block must not run")
    assert str(caught.value) == f"cannot write {tmp_path}: Is a directory; choose another name, or remove the folder"


def test_atomic_path_reports_missing_permission(tmp_path: Path) -> None:
    final = tmp_path / "result.bin"
    with pytest.raises(OutputError) as caught, atomic_path(final):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    assert str(caught.value) == f"cannot write {final}: Permission denied; choose a folder that you may write to"


_FILLS_THE_DISK = """
import resource, signal, sys
from pathlib import Path
from photonpano import OutputError
from photonpano.atomic import atomic_path

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
try:
    with atomic_path(Path(sys.argv[1])) as temporary:
        temporary.write_bytes(bytes(8192))
except OutputError as error:
    print(error)
"""


def test_atomic_path_leaves_no_file_after_a_short_write(tmp_path: Path) -> None:
    """A limit on file sizes stops the write half-way, as a full disk does."""
    final = tmp_path / "result.bin"
    done = subprocess.run([sys.executable, "-c", _FILLS_THE_DISK, final], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == (
        f"cannot write {final}: File too large; raise the limit on file sizes or choose another file system"
    )
    assert list(tmp_path.iterdir()) == []


def test_atomic_path_reports_a_full_disk_and_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk is found to be full when the whole file is flushed, as some file systems do."""

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    final = tmp_path / "result.bin"
    final.write_bytes(b"old")
    monkeypatch.setattr("photonpano.atomic.os.fsync", full)
    with pytest.raises(OutputError) as caught, atomic_path(final) as temporary:
        temporary.write_bytes(b"new")
    assert str(caught.value) == (f"cannot write {final}: No space left on device; free some space or choose another folder")
    assert final.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [final]


@pytest.mark.parametrize("lend", [atomic_path, atomic_folder])
def test_interrupt_while_the_temporary_file_is_made_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lend: Callable[[Path], AbstractContextManager[Path]]
) -> None:
    def interrupted(_: int) -> bool:
        raise KeyboardInterrupt

    monkeypatch.setattr("photonpano.atomic.claimed", interrupted)
    with pytest.raises(KeyboardInterrupt), lend(tmp_path / "cube.npy"):
        pass
    assert list(tmp_path.iterdir()) == []
