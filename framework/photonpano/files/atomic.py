"""Write files whole or not at all: under a temporary name, which then becomes the final one. Lock files and folders."""

from __future__ import annotations

import errno
import os
import secrets
import shutil
import socket
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

from filelock import FileLock, Timeout

from photonpano.errors import OutputError
from photonpano.text import byte_size

_PATIENCE_S = 0.2  # how long to wait for a lock that may be given back right now
_HOLDER = "process "  # how the note of the holder of a lock begins


def lock_path(final: Path) -> Path:
    """Return the lock file of a file or folder: `.scan.lock` beside `scan`."""
    return final.with_name(f".{final.name}.lock")


@contextmanager
def locked(final: Path, what: str, remedy: str = "choose another folder with --output") -> Iterator[None]:
    """Hold the lock of a file or folder during the block. The system forgets it with the process.

    Args:
        final: the file or folder; it may be missing.
        what: its name in the message, such as `the run folder runs/scan`.
        remedy: what to do but to wait.

    Raises:
        OutputError: another process holds the lock.
        OSError: the lock file cannot be made.
    """
    if not final.parent.is_dir():  # the library would make it
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR))
    path = lock_path(final)
    lock = FileLock(path, timeout=_PATIENCE_S)
    try:
        lock.acquire()
    except Timeout as error:
        raise OutputError(f"{what} is in use: {_holder(path)}; wait for it, or {remedy}") from error
    with_notes = type(lock) is FileLock  # on a file system without locks, it has become one that needs the file for itself
    try:
        if with_notes:
            now = datetime.now().astimezone().isoformat(timespec="seconds")
            path.write_text(
                f"{_HOLDER}{os.getpid()} on {socket.gethostname()} has been writing it since {now}", encoding="utf-8"
            )
        yield
    finally:
        if with_notes:
            path.unlink(missing_ok=True)
        lock.release()


def in_use(final: Path) -> bool:
    """Return whether a process holds the lock of a file or folder."""
    lock = FileLock(lock_path(final), timeout=0)
    with suppress(Timeout):
        if lock_path(final).exists():
            lock.acquire()
            lock.release()
        return False
    return True


def is_lock(path: Path) -> bool:
    """Return whether a file is a lock of this program."""
    return path.is_file() and path.read_bytes().startswith(_HOLDER.encode())


def _holder(path: Path) -> str:
    """Say who holds a lock: the holder may write that a moment later."""
    try:
        note = path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        note = ""
    return note if note.startswith(_HOLDER) else "another process is writing it"


@contextmanager
def atomic_path(final: Path, *, flushed: bool = True) -> Iterator[Path]:
    """Lend a temporary path beside `final`, which becomes `final` when the block ends well.

    When the block raises, Ctrl-C included, the temporary file is removed, and an older `final` stays as it was. The temporary
    name keeps the suffix of `final`, by which writers of images and archives choose their format. A file that is not `flushed`
    to the disk may be damaged after a power failure.

    Raises:
        OutputError: the file cannot be written. Every `OSError` of the block counts as one of writing.
    """
    temporary = final.with_name(f".{final.stem}.{secrets.token_hex(4)}.partial{final.suffix}")
    with _becoming(final):
        try:
            temporary.touch(exist_ok=False)
            yield temporary
            _rename(temporary, final, flushed=flushed)
        finally:
            temporary.unlink(missing_ok=True)


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
    with _becoming(final), locked(final, str(final), "choose another name"):
        if os.path.lexists(part) and not stat.S_ISREG(part.lstat().st_mode):
            raise OutputError(f"cannot write {final}: {part} is no regular file; remove it, or choose another name")
        part.open("ab").close()
        try:
            yield part
            _rename(part, final)
        finally:
            if part.exists() and not part.stat().st_size:
                part.unlink()


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
    """Give a file its final name, once it is on the disk if it is to be flushed."""
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
