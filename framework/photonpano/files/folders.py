"""Write folders whole or not at all: beside the old one, which is put aside, replaced, and removed.

After a kill there is the old folder, or none, or the new one. An old one that stands aside is put back by the next process.
"""

from __future__ import annotations

import errno
import os
import pwd
import re
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath

from photonpano.errors import OutputError
from photonpano.files.atomic import flush, locked, remove, writing

NEW, OLD = "photonpano-new", "photonpano-old"  # ends of the names of a folder that is written, and of one that is put aside


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
