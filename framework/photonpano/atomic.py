"""Files that are whole or absent: written under a temporary name, then renamed."""

from __future__ import annotations

import errno
import os
import secrets
import shutil
from contextlib import contextmanager
from typing import TYPE_CHECKING

from photonpano.errors import OutputError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@contextmanager
def atomic_path(final: Path) -> Iterator[Path]:
    """Lend a temporary path beside `final`, which becomes `final` when the block ends well.

    When the block raises, Ctrl-C included, the temporary file is removed, and a file that stood under `final` stays as it was.
    The temporary name keeps the suffix of `final`, by which writers of images and archives choose their format.

    Example:
        ```python
        with atomic_path(folder / "trajectory.npz") as temporary:
            np.savez(temporary, homographies=homographies)
        ```

    Raises:
        OutputError: the file cannot be written. Every `OSError` of the block is taken to be one of writing.
    """
    temporary = final.with_name(f".{final.stem}.{secrets.token_hex(4)}.partial{final.suffix}")
    try:
        with _becoming(final, temporary):
            temporary.touch(exist_ok=False)
            yield temporary
    finally:
        temporary.unlink(missing_ok=True)


def part_path(final: Path) -> Path:
    """Return where a file that can be continued lies until it is whole: `cube.npy.part` for `cube.npy`."""
    return final.with_name(f"{final.name}.part")


@contextmanager
def resumable_path(final: Path) -> Iterator[Path]:
    """Lend the `part_path` of `final`, which becomes `final` when the block ends well.

    When the block raises, Ctrl-C included, it is left as it is, to be continued. It may be there before, for that reason.

    Raises:
        OutputError: the file cannot be written. Every `OSError` of the block is taken to be one of writing.
    """
    with _becoming(final, part_path(final)):
        yield part_path(final)


@contextmanager
def atomic_folder(final: Path) -> Iterator[Path]:
    """Lend an empty folder beside `final`, which becomes `final` when the block ends well, and otherwise is removed.

    Raises:
        OutputError: there is something under that name, or the folder cannot be written.
    """
    place = final.absolute()
    temporary = place.with_name(f".{place.name}.{secrets.token_hex(4)}.partial")
    try:
        if final.exists() and not (final.is_dir() and next(final.iterdir(), None) is None):
            raise OutputError(f"cannot write {final}: it is there already; choose another folder, or remove it")
        temporary.mkdir()
        yield temporary
        temporary.replace(place)
    except OSError as error:
        raise OutputError(_message(final, error)) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


@contextmanager
def _becoming(final: Path, temporary: Path) -> Iterator[None]:
    """Rename a file when the block ends well."""
    try:
        if final.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        yield
        _flush_to_disk(temporary)
        temporary.replace(final)
    except OSError as error:
        raise OutputError(_message(final, error)) from error


def require_space(final: Path, n_bytes: int) -> None:
    """Refuse to begin a file that its disk has no room for.

    Raises:
        OutputError: fewer than `n_bytes` are free.
    """
    free = shutil.disk_usage(final.parent).free
    if n_bytes > free:
        raise OutputError(
            f"cannot write {final}: it takes {_size(n_bytes)}, and its disk has {_size(free)} free; "
            "free some space or choose another folder"
        )


def _flush_to_disk(path: Path) -> None:
    """Wait for the disk: some file systems tell only now that they are full, and a rename may overtake the data."""
    descriptor = os.open(path, os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


_REMEDIES = {
    errno.ENOSPC: "free some space or choose another folder",
    errno.EDQUOT: "free some of your quota or choose another folder",
    errno.EFBIG: "raise the limit on file sizes or choose another file system",
    errno.EACCES: "choose a folder that you may write to",
    errno.EPERM: "choose a folder that you may write to",
    errno.EROFS: "choose a folder that you may write to",
    errno.EISDIR: "choose another name, or remove the folder",
    errno.ENAMETOOLONG: "choose a shorter name",
}


def _message(final: Path, error: OSError) -> str:
    reason = error.strerror or str(error)
    if isinstance(error, FileNotFoundError | NotADirectoryError) and not final.parent.is_dir():
        return f"cannot write {final}: there is no folder {final.parent}; create it or choose another"
    remedy = _REMEDIES.get(error.errno or 0)
    return f"cannot write {final}: {reason}" + (f"; {remedy}" if remedy else "")


def _size(n_bytes: int) -> str:
    return f"{n_bytes / 1e9:.1f} GB" if n_bytes >= 1e9 else f"{n_bytes / 1e6:.1f} MB"
