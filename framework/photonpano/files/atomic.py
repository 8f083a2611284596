"""Write files whole or not at all: under a temporary name, which then becomes the final one."""

from __future__ import annotations

import errno
import os
import re
import secrets
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from photonpano.errors import OutputError
from photonpano.files.locks import claim, claimed, is_at
from photonpano.text import byte_size

_PARTIAL = re.compile("[0-9a-f]{8}")
_unfinished: set[Path] = set()  # files and folders under temporary names, which are to become final


def discard_unfinished() -> None:
    """Remove the files and folders that are being written, in a program that ends now. Never raises.

    Each is renamed first. So a thread that still works finds nothing that it could give the final name to.
    """
    for each in list(_unfinished):
        doomed = each.with_name(f".{secrets.token_hex(4)}.partial")
        with suppress(OSError):
            each.rename(doomed)
            if doomed.is_dir():
                shutil.rmtree(doomed, ignore_errors=True)
            else:
                doomed.unlink()


@contextmanager
def atomic_path(final: Path, *, flushed: bool = True) -> Iterator[Path]:
    """Lend a temporary path beside `final`, which becomes `final` when the block ends well.

    When the block raises, Ctrl-C included, the temporary file is removed, and an older `final` stays as it was. The temporary
    name keeps the suffix of `final`, by which writers of images and archives choose their format. A file that is not `flushed`
    to the disk may be damaged after a power failure.

    Raises:
        OutputError: the file cannot be written. Every `OSError` of the block counts as one of writing.
    """
    with _becoming(final), _lent(final, f".{final.stem}.", f".partial{final.suffix}") as temporary:
        yield temporary
        _rename(temporary, final, flushed=flushed)


def part_path(final: Path) -> Path:
    """Return the name that a resumable file has until it is whole: `cube.npy.part` for `cube.npy`."""
    return final.with_name(f"{final.name}.part")


@contextmanager
def resumable_path(final: Path) -> Iterator[Path]:
    """Lend the `part_path` of `final`, which becomes `final` when the block ends well; it may exist already.

    When the block raises, Ctrl-C included, the file stays, to be continued by a later call.

    Raises:
        OutputError: as `atomic_path`; or another process writes the file.
    """
    part = part_path(final)
    with _becoming(final):
        if os.path.lexists(part) and not stat.S_ISREG(part.lstat().st_mode):
            raise OutputError(f"cannot write {final}: {part} is no regular file; remove it, or choose another name")
        descriptor = os.open(part, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
        try:
            if claimed(descriptor) is False or not is_at(descriptor, part):
                raise OutputError(f"cannot write {final}: another process is writing it; wait for it, or choose another name")
            yield part
            _rename(part, final)
        finally:
            if is_at(descriptor, part) and not os.fstat(descriptor).st_size:
                part.unlink()
            os.close(descriptor)


@contextmanager
def unfinished_folder(place: Path, start: str) -> Iterator[Path]:
    """Lend a new folder beside `place` whose name begins with `start` and ends in `.partial`, and remove it after the block."""
    with _lent(place, start, ".partial", folder=True) as temporary:
        yield temporary


@contextmanager
def _lent(place: Path, start: str, end: str, *, folder: bool = False) -> Iterator[Path]:
    """Make a file or folder beside `place`, lock it, so that others see that it is in use, and remove it after the block."""
    for path in partial_paths(place.parent, start, end):
        with claim(path) as mine:
            if mine:
                remove(path)
    descriptor = None
    while descriptor is None:
        temporary = place.with_name(f"{start}{secrets.token_hex(4)}{end}")
        try:
            _unfinished.add(temporary)  # before it is there: a signal may come at any moment
            descriptor = _created(temporary, folder)
            if descriptor is not None:
                yield temporary
        finally:
            if descriptor is not None:
                os.close(descriptor)
            with suppress(OSError):
                remove(temporary)
            _unfinished.discard(temporary)


def _created(temporary: Path, folder: bool) -> int | None:
    """Make and lock a file or folder; None if another process took it for abandoned before it was locked."""
    if folder:
        temporary.mkdir()
    flags = os.O_RDONLY if folder else os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW
    descriptor = os.open(temporary, flags, 0o666)
    if claimed(descriptor) is not False and temporary.exists():
        return descriptor
    os.close(descriptor)
    return None


def partial_paths(folder: Path, start: str, end: str) -> list[Path]:
    """Return what bears a temporary name: `start`, eight hexadecimal digits, and `end`."""
    try:
        return [path for path in sorted(folder.iterdir()) if is_partial(path.name, start, end)]
    except (FileNotFoundError, NotADirectoryError):
        return []


def is_partial(name: str, start: str, end: str) -> bool:
    """Return whether a name is a temporary one: see `partial_paths`."""
    return bool(_PARTIAL.fullmatch(name[len(start) : len(name) - len(end)])) and name.startswith(start) and name.endswith(end)


def remove(path: Path) -> None:
    """Remove a file, a symbolic link, or a folder with its content; a missing one is no error."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


@contextmanager
def _becoming(final: Path) -> Iterator[None]:
    """Refuse a name that no file can get, and turn what the system raises into an `OutputError`."""
    with writing(final):
        if final.is_symlink():
            raise OutputError(f"cannot write {final}: it is a symbolic link; remove it, or choose another name")
        if final.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        yield


@contextmanager
def writing(final: Path) -> Iterator[None]:
    """Turn what the system raises in the block into an `OutputError` that names `final`, and says what to do."""
    try:
        yield
    except OSError as error:
        raise OutputError(_message(final, error)) from error


def _rename(temporary: Path, final: Path, *, flushed: bool = True) -> None:
    """Give a file or folder its final name, once it is on the disk if it is to be flushed."""
    if flushed:
        flush(temporary)
    temporary.replace(final)
    if flushed:
        flush(final.parent)


def require_space(final: Path, n_bytes: int) -> None:
    """Raise an `OutputError` for a file of `n_bytes` that does not fit on its disk."""
    free = shutil.disk_usage(final.parent).free
    if n_bytes > free:
        raise OutputError(
            f"cannot write {final}: it takes {byte_size(n_bytes)}, and its disk has {byte_size(free)} free; "
            "free some space or choose another folder"
        )


def flush(path: Path) -> None:
    """Wait for the disk: some file systems report only now that they are full, and a rename may overtake the data."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno != errno.EINVAL:  # some file systems flush no folders
            raise
    finally:
        os.close(descriptor)


_REMEDIES = {
    errno.ENOTDIR: "choose another name, or remove the file",
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
