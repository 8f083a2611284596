"""Write files whole or not at all: under a temporary name, which then becomes the final one."""

from __future__ import annotations

import errno
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from photonpano.errors import OutputError
from photonpano.text import byte_size

_unfinished: set[Path] = set()
"""Files and folders under temporary names, which are to become final."""


def discard_unfinished() -> None:
    """Remove the files and folders that are being written, in a program that ends now. Never raises.

    Each is renamed first. So a thread that still works finds nothing that it could give the final name to.
    """
    for each in list(_unfinished):
        doomed = each.with_name(f".part-{secrets.token_hex(4)}")
        with suppress(OSError):
            each.rename(doomed)
            if doomed.is_dir():
                shutil.rmtree(doomed, ignore_errors=True)
            else:
                doomed.unlink()


@contextmanager
def atomic_path(final: Path) -> Iterator[Path]:
    """Lend a temporary path beside `final`, which becomes `final` when the block ends well.

    When the block raises, Ctrl-C included, the temporary file is removed, and an older `final` stays as it was. The temporary
    name keeps the suffix of `final`, by which writers of images and archives choose their format.

    Example:
        ```python
        with atomic_path(folder / "trajectory.npz") as temporary:
            np.savez(temporary, homographies=homographies)
        ```

    Raises:
        OutputError: the file cannot be written. Every `OSError` of the block counts as one of writing.
    """
    temporary = final.with_name(f".{final.stem}.{secrets.token_hex(4)}.partial{final.suffix}")
    _unfinished.add(temporary)
    try:
        with _becoming(final, temporary):
            temporary.touch(exist_ok=False)
            yield temporary
    finally:
        temporary.unlink(missing_ok=True)
        _unfinished.discard(temporary)


def part_path(final: Path) -> Path:
    """Return the name that a resumable file has until it is whole: `cube.npy.part` for `cube.npy`."""
    return final.with_name(f"{final.name}.part")


@contextmanager
def resumable_path(final: Path) -> Iterator[Path]:
    """Lend the `part_path` of `final`, which becomes `final` when the block ends well.

    When the block raises, Ctrl-C included, the file stays, to be continued by a later call. So it may exist already.

    Raises:
        OutputError: the file cannot be written. Every `OSError` of the block counts as one of writing.
    """
    with _becoming(final, part_path(final)):
        yield part_path(final)


@contextmanager
def atomic_files(directory: Path, last: str = "") -> Iterator[Path]:
    """Lend an empty folder whose files move into `directory` when the block ends well.

    The directory is made before the block runs. When the block raises, Ctrl-C included, what was in it stays as it was, and
    folders that were made for it are removed.

    Args:
        directory: it may exist, and hold files.
        last: the file that is moved after all others: once it is new, so are they.

    Raises:
        OSError: the directory cannot be made or written to.
    """
    made = [folder for folder in (directory, *directory.parents) if not folder.exists()]
    directory.mkdir(parents=True, exist_ok=True)
    staging = Path(tempfile.mkdtemp(prefix=".part-", dir=directory))
    _unfinished.add(staging)
    try:
        yield staging
        files = sorted(staging.iterdir(), key=lambda file: file.name == last)
        for file in files:
            _flush_to_disk(file)
        for file in files:
            file.replace(directory / file.name)
        made.clear()
    finally:
        shutil.rmtree(staging, ignore_errors=True)
        _unfinished.discard(staging)
        with suppress(OSError):  # another program has put something there
            for folder in made:
                folder.rmdir()


@contextmanager
def atomic_folder(final: Path) -> Iterator[Path]:
    """Lend an empty folder beside `final`, which becomes `final` in one rename when the block ends well.

    Raises:
        OutputError: there is something under that name, or the folder cannot be written.
    """
    place = final.absolute()
    temporary = place.with_name(f".{place.name}.{secrets.token_hex(4)}.partial")
    _unfinished.add(temporary)
    try:
        if final.exists() and not (final.is_dir() and next(final.iterdir(), None) is None):
            raise OutputError(f"cannot write {final}: it is there already; choose another folder, or remove it")
        temporary.mkdir()
        yield temporary
        for file in temporary.iterdir():
            _flush_to_disk(file)
        temporary.replace(place)
    except OSError as error:
        raise OutputError(_message(final, error)) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        _unfinished.discard(temporary)


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
    """Refuse to begin a file that does not fit on its disk.

    Raises:
        OutputError: fewer than `n_bytes` are free.
    """
    free = shutil.disk_usage(final.parent).free
    if n_bytes > free:
        raise OutputError(
            f"cannot write {final}: it takes {byte_size(n_bytes)}, and its disk has {byte_size(free)} free; "
            "free some space or choose another folder"
        )


def _flush_to_disk(path: Path) -> None:
    """Wait for the disk: some file systems report only now that they are full, and a rename may overtake the data."""
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
