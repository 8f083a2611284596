"""Replace a folder in one step: after a kill at any instant it is wholly old or wholly new.

The new folder is made beside the old one, and both change their names at once. Where the system or the file system cannot do
that, or the folder cannot be renamed, the new files are moved into the folder, in it under the name `PENDING`, in one rename.
From then on they count: `finish_replacement` puts them in place, and whoever opens the folder calls it.
"""

from __future__ import annotations

import ctypes
import errno
import os
import pwd
import re
import shutil
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from shlex import quote

from photonpano.errors import OutputError
from photonpano.files.atomic import flush, is_partial, partial_paths, remove, unfinished_folder, writing
from photonpano.files.locks import claim

PENDING = ".photonpano-pending"  # the folder of new files that are complete, and not yet all in place
_REMOVED = ".removed"  # a file in it: the names that the folder loses
_AT_FDCWD, _RENAME_EXCHANGE, _RENAME_SWAP = -100, 2, 2


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
    """Lend an empty folder beside `final`, which becomes `final` in one step when the block ends well.

    If `final` is there already, it loses what has the names of new files and folders, whatever the numbers in them, such as
    `frame_07.png`. The rest stays in it.

    Raises:
        OutputError: there is a file under that name, or the folder cannot be written.
    """
    place = final.absolute().resolve()
    with writing(final):
        if place.exists() and not place.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR))
        with staging_of(place) as staging:
            yield staging
            finish_replacement(place)
            names = {_without_numbers(path) for path in staging.iterdir()}
            old = [path for path in _entries(place) if _without_numbers(path) in names]
            lost = [file for path in old for file in (_files(path) if path.is_dir() and not path.is_symlink() else [path])]
            replace_folder(staging, place, [file.relative_to(place).as_posix() for file in lost])


def _without_numbers(path: Path) -> str:
    return re.sub(r"\d+", "0", path.name)


def lock_path(directory: Path) -> Path:
    """Return the lock file of a folder: beside it, or in it if it cannot be renamed."""
    return directory / ".lock" if _stays(directory) else directory.with_name(f".{directory.name}.lock")


@contextmanager
def staging_of(directory: Path) -> Iterator[Path]:
    """Lend an empty folder in which the files of a new `directory` are gathered.

    It lies beside the folder; or in it, if that cannot be renamed, or is the current folder.
    """
    inside = _stays(directory) or Path.cwd().is_relative_to(directory)
    place, start = (directory / PENDING, ".") if inside else (directory, f".{directory.name}.")
    with unfinished_folder(place, start) as staging:
        yield staging


def remove_leftovers(directory: Path) -> None:
    """Remove what dead replacements of a folder have left; for the process that holds its lock."""
    beside = partial_paths(directory.parent, f".{directory.name}.", ".partial")
    inside = partial_paths(directory, ".", ".partial")
    for path in (*beside, *inside):
        with claim(path) as mine:
            if mine is not False:
                remove(path)


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
            elif name not in own and not is_ours(name):
                found.append(path)
    return found


def is_ours(name: str) -> bool:
    """Return whether a name in a folder belongs to its replacement."""
    return name in (PENDING, ".lock") or is_partial(name, ".", ".partial")


def replace_folder(staging: Path, directory: Path, replaced: Iterable[str]) -> None:
    """Make the files in `staging` those of `directory`, in one step. What else lies in the folder stays in it.

    Args:
        staging: from `staging_of`; afterwards it is gone.
        directory: it may be missing.
        replaced: the paths in the folder of the files that it loses, or gets anew, such as `sparse/images.txt`.

    Raises:
        OSError: the disk is full, or something cannot be renamed; the folder is as it was.
        OutputError: the new files are complete, but could not all be put in place.
    """
    written = {path.relative_to(staging).as_posix() for path in _files(staging)}
    for path in (*staging.rglob("*"), staging):
        flush(path)
    if staging.parent == directory or not _exchanged(staging, directory, {*replaced, *written}):
        (staging / _REMOVED).write_text("\n".join({*replaced} - written), encoding="utf-8")
        flush(staging / _REMOVED)
        flush(staging)
        staging.rename(directory / PENDING)
        try:
            finish_replacement(directory)
        except OSError as error:
            raise OutputError(
                f"{directory}: the new files are complete in {directory / PENDING}, but could not be put in place "
                f"({error.strerror}); `photonpano verify {quote(str(directory))}` puts them there"
            ) from error


def finish_replacement(directory: Path) -> None:
    """Put files in place that are complete, if there are any; after an `OSError`, the next call goes on."""
    pending = directory / PENDING
    if pending.is_symlink() or not pending.is_dir():
        return
    _flush_committed(directory)
    try:
        _put_in_place(pending, directory)
    except OSError:  # a disk may be away for a moment
        _put_in_place(pending, directory)


def _put_in_place(pending: Path, directory: Path) -> None:
    """Move files; when it is called again after a kill, it goes on."""
    removed = pending / _REMOVED
    if removed.exists():  # then none is in place yet
        for name in removed.read_text(encoding="utf-8").splitlines():
            with suppress(NotADirectoryError):
                (directory / name).unlink(missing_ok=True)
            with suppress(OSError):  # other files may lie in a folder
                for parent in PurePosixPath(name).parents[:-1]:
                    (directory / parent).rmdir()
        removed.unlink()
    for path in _files(pending):
        target = directory / path.relative_to(pending)
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.exists() and target.samefile(path):  # a rename onto itself does nothing
            path.unlink()
        else:
            path.replace(target)
    _flush_committed(directory)
    shutil.rmtree(pending)


def _remove_old(old: Path, directory: Path, replaced: set[str]) -> None:
    """Remove the old folder; what another program has put there since it was copied moves to the new one."""
    for path in others_in(old, replaced):
        target = directory / path.relative_to(old)
        with suppress(OSError):
            if not os.path.lexists(target):
                target.parent.mkdir(parents=True, exist_ok=True)
                path.rename(target)
    shutil.rmtree(old, ignore_errors=True)


def _stays(directory: Path) -> bool:
    """Return whether a folder cannot be renamed: a mounted one, or one in a folder that may not be written to."""
    return directory.is_dir() and (os.path.ismount(directory) or not os.access(directory.parent, os.W_OK))


def _exchanged(staging: Path, directory: Path, replaced: set[str]) -> bool:
    """Let two folders change their names, if the system can do that in one step; then remove the old one."""
    if not os.path.lexists(directory):
        staging.rename(directory)
        _flush_committed(directory.parent)
        return True
    shutil.copymode(directory, staging)
    others = [path for path in others_in(directory, replaced) if not os.path.lexists(staging / path.relative_to(directory))]
    for path in others:
        target = staging / path.relative_to(directory)
        target.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir() and not path.is_symlink():
            shutil.copytree(path, target, symlinks=True, copy_function=link_or_copy)
        else:
            link_or_copy(path, target)
    if others:
        flush(staging)
    if not _exchange(staging, directory):
        for path in others:
            remove(staging / path.relative_to(directory))
        return False
    _flush_committed(directory.parent)
    _remove_old(staging, directory, replaced)
    return True


def _flush_committed(folder: Path) -> None:
    """Flush a folder after the step that counts: an error cannot undo it."""
    with suppress(OSError):
        flush(folder)


def _exchange(one: Path, other: Path) -> bool:
    """Exchange the names of two folders; return False where that is impossible."""
    libc = ctypes.CDLL(None, use_errno=True)
    first, second = os.fsencode(one), os.fsencode(other)
    if sys.platform == "darwin" and hasattr(libc, "renamex_np"):
        return bool(libc.renamex_np(first, second, _RENAME_SWAP) == 0)
    if hasattr(libc, "renameat2"):
        return bool(libc.renameat2(_AT_FDCWD, first, _AT_FDCWD, second, _RENAME_EXCHANGE) == 0)
    return False


def link_or_copy(path: str | Path, target: str | Path) -> None:
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
