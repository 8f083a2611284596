"""Remove what killed processes have left."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import typer

from photonpano.api.command import command
from photonpano.errors import InputError, OutputError
from photonpano.files.atomic import in_use, is_lock, locked, remove
from photonpano.files.folders import NEW, OLD, recover
from photonpano.text import counted

_OF_LOCKED = re.compile(rf"\.(.+)\.(lock|{NEW}|{OLD})")  # what the holder of a lock makes, and the file or folder that it locks
_PARTIAL = re.compile(r"\.(.+\.)?[0-9a-f]{8}\.partial(\.\w+)?")
_UNPACKED = ".unpacked.npy"
_IDLE_S = 600.0  # an unfinished file to which nothing was written for this time is left over


def _lines(found: list[Path], *, dry_run: bool = False) -> Iterator[str]:
    yield from map(str, found)
    yield f"{counted(len(found), 'leftover')} {'found' if dry_run else 'removed'}"


@command(
    ". --dry-run",
    _lines,
    directory=typer.Argument(metavar="DIR", help="A folder with captures or run folders."),
    dry_run=typer.Option("--dry-run", "-n"),
)
def clean(directory: Path | str, dry_run: bool = False) -> list[Path]:
    """Remove what killed processes have left in a folder and those in it: unfinished files, locks, unpacked archives.

    A folder that was put aside, and has no successor, is put back. An unfinished file is removed if nothing was written to it
    for ten minutes, an unpacked archive if the archive is there, from which it can be unpacked again. What is locked is left
    alone, and unfinished conversions (`.part`) are kept, since `convert` continues them.

    Args:
        directory: symbolic links in it are not followed.
        dry_run: list what would be removed, and remove nothing.

    Returns:
        What was removed, or would be.

    Raises:
        InputError: there is no such folder.
    """
    folder = Path(directory)
    if not folder.is_dir():
        raise InputError(f"there is no folder {folder}; check the path")
    found = list(_leftovers(folder))
    for path in () if dry_run else found:
        if (locks := _locked_by(path)) is None:
            remove(path)
        else:
            with suppress(OutputError), locked(locks, str(locks)):  # the lock file goes with the lock
                recover(locks)
    return found


def _leftovers(folder: Path) -> Iterator[Path]:
    for inside, folders, files in os.walk(folder):
        named = [name for name in (*folders, *files) if _is_leftover(Path(inside, name))]
        folders[:] = [name for name in folders if name not in named]
        yield from (Path(inside, name) for name in sorted(named))


def _is_leftover(path: Path) -> bool:
    if path.is_symlink():
        return False
    if (locks := _locked_by(path)) is not None:
        return not in_use(locks) and (path.is_dir() or is_lock(path))
    if path.name.endswith(f".gz{_UNPACKED}"):
        return path.with_name(path.name.removesuffix(_UNPACKED)).is_file()
    return _PARTIAL.fullmatch(path.name) is not None and time.time() - path.stat().st_mtime > _IDLE_S


def _locked_by(path: Path) -> Path | None:
    """Return the file or folder whose lock protects what has this name; None for another name."""
    found = _OF_LOCKED.fullmatch(path.name)
    return None if found is None else path.with_name(found[1])
