"""Write files and folders whole or not at all: under a temporary name, which then becomes the final one. Lock them."""

from __future__ import annotations

import errno
import os
import pwd
import re
import secrets
import shutil
import socket
import stat
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path, PurePosixPath

from filelock import FileLock, Timeout

from photonpano.errors import OutputError
from photonpano.text import byte_size

_PATIENCE_S = 0.2  # how long to wait for a lock that may be given back right now
_HOLDER = "process "  # how the note of the holder of a lock begins
NEW, OLD = "photonpano-new", "photonpano-old"  # ends of the names of a folder that is written, and of one that is put aside


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


def require_new(path: Path, overwrite: bool, inputs: Sequence[Path] = ()) -> None:
    """Refuse a name under which there is something, unless it is to be overwritten; an empty folder is nothing.

    `inputs` are what the new file or folder is made of: they must not lie in a folder that is overwritten.

    Raises:
        OutputError: there is something under the name.
    """
    if path.is_dir():
        with writing(path):
            there = any(path.iterdir())
    else:
        there = os.path.lexists(path)
    if there and not overwrite:
        raise OutputError(f"{path} is there already; choose another name, or replace it with --overwrite")
    if there and path.is_dir():
        require_harmless(path.absolute().resolve(), inputs)


def require_harmless(directory: Path, inputs: Sequence[Path]) -> None:
    """Raise an `OutputError` for a folder of a user, of the system, or in which one of the `inputs` lies."""
    homes = [Path("/")]
    with suppress(KeyError, RuntimeError):  # containers run users that the system does not know
        homes += [Path(pwd.getpwuid(os.getuid()).pw_dir), Path.home()]
    if any(home.resolve().is_relative_to(directory) for home in homes):
        raise OutputError(f"{directory} is the folder of a user or of the system; choose another one")
    for path in inputs:
        if path.absolute().resolve().is_relative_to(directory):
            raise OutputError(f"{directory} cannot be written, since {path}, which is read, lies in it; choose another folder")


@contextmanager
def atomic_folder(final: Path) -> Iterator[Path]:
    """Lend an empty folder beside `final`, which becomes `final` when the block ends well.

    If `final` is there already, it loses what has the names of new files and folders, whatever the numbers in them, such as
    `frame_07.png`. The rest stays in it.

    Raises:
        OutputError: there is a file under that name, the folder cannot be written, or another process writes it.
    """
    place = final.absolute().resolve()
    with writing(final):
        if place.exists() and not place.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR))
        with staging_of(place, f"the folder {final}") as staging:
            yield staging
            names = {_without_numbers(path) for path in staging.iterdir()}
            old = [path for path in _entries(place) if _without_numbers(path) in names]
            lost = [file for path in old for file in (_files(path) if path.is_dir() and not path.is_symlink() else [path])]
            replace_folder(staging, place, [file.relative_to(place).as_posix() for file in lost])


def _without_numbers(path: Path) -> str:
    return re.sub(r"\d+", "0", path.name)


@contextmanager
def staging_of(directory: Path, what: str) -> Iterator[Path]:
    """Lock a folder, and lend an empty one beside it, in which the files of a new `directory` are gathered.

    What a killed process has left is put right first. `what` names the folder in the message.

    Raises:
        OutputError: another process writes the folder, or it cannot be replaced.
        OSError: the new folder cannot be made.
    """
    if os.path.ismount(directory) or (directory.is_dir() and Path.cwd().is_relative_to(directory)):
        raise OutputError(
            f"{what} cannot be replaced, since it is mounted, or the current folder lies in it; choose another one, such as "
            f"{directory / 'panorama'}"
        )
    with locked(directory, what):
        recover(directory)
        staging = beside(directory, NEW)
        staging.mkdir()
        try:
            yield staging
        finally:
            remove(staging)


def beside(directory: Path, end: str) -> Path:
    """Return the path of a folder that is written, or put aside: `.scan.photonpano-new` for `scan`."""
    return directory.with_name(f".{directory.name}.{end}")


def recover(directory: Path) -> None:
    """Put back a folder that was put aside, and has no successor; remove what else is left. For the holder of its lock."""
    new, old = beside(directory, NEW), beside(directory, OLD)
    if old.is_dir() and not os.path.lexists(directory):
        old.rename(directory)
    remove(new)
    remove(old)


def others_in(directory: Path, own: Iterable[str]) -> list[Path]:
    """Return what lies in a folder beside its own files, given as paths in it; a folder without any of these is one entry."""
    own = set(own)
    holders = {str(parent) for name in own for parent in PurePosixPath(name).parents}
    found, folders = [], [directory]
    for folder in folders:  # grows meanwhile
        for path in _entries(folder):
            name = path.relative_to(directory).as_posix()
            if name in holders and path.is_dir() and not path.is_symlink():
                folders.append(path)
            elif name not in own:
                found.append(path)
    return found


def replace_folder(staging: Path, directory: Path, replaced: Iterable[str]) -> None:
    """Make the files in `staging` those of `directory`. What else lies in the folder stays in it.

    Args:
        staging: from `staging_of`; afterwards it is gone.
        directory: it may be missing.
        replaced: the paths in the folder of the files that it loses, or gets anew, such as `sparse/images.txt`.

    Raises:
        OSError: the disk is full, or something cannot be renamed; the folder is as it was.
    """
    written = {path.relative_to(staging).as_posix() for path in _files(staging)}
    for path in (*staging.rglob("*"), staging):
        flush(path)
    if directory.is_dir():
        shutil.copymode(directory, staging)
        for path in others_in(directory, {*replaced, *written}):
            _copy(path, staging / path.relative_to(directory))
    try:
        if directory.is_dir():
            directory.rename(beside(directory, OLD))
        staging.rename(directory)
        with suppress(OSError):  # nothing can be undone any more
            flush(directory.parent)
    finally:
        recover(directory)


def _copy(path: Path, target: Path) -> None:
    """Copy a file, a link or a folder, unless there is something; files get a second name where the file system can do that."""
    if os.path.lexists(target):
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    if path.is_dir() and not path.is_symlink():
        shutil.copytree(path, target, symlinks=True, copy_function=_link_or_copy)
    else:
        _link_or_copy(path, target)


def _link_or_copy(path: str | Path, target: str | Path) -> None:
    """Give a file a second name; where the file system cannot, copy it."""
    try:
        os.link(path, target, follow_symlinks=False)
    except OSError:
        shutil.copy2(path, target, follow_symlinks=False)


def _files(folder: Path) -> list[Path]:
    """Return all files in a folder, those in its folders as well."""
    return sorted(path for path in folder.rglob("*") if path.is_symlink() or not path.is_dir())


def _entries(directory: Path) -> list[Path]:
    try:
        return sorted(directory.iterdir())
    except (FileNotFoundError, NotADirectoryError):
        return []
