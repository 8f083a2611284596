"""Remove what killed processes have left."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

import typer

from photonpano.api.command import command
from photonpano.errors import InputError
from photonpano.files.atomic import remove
from photonpano.files.folders import PENDING
from photonpano.files.locks import claim, is_lock
from photonpano.record.contents import finish_run_folder
from photonpano.text import counted

_PARTIAL = re.compile(r"\.(.+\.)?[0-9a-f]{8}\.partial(\.\w+)?")
_UNPACKED = ".unpacked.npy"


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

    Files of a run that was killed while it put them in place are put there. An unpacked archive is removed if the archive is
    there, from which it can be unpacked again. Nothing is removed that a process uses. Unfinished conversions (`.part`) are
    kept, since `convert` continues them.

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
    found = []
    for path in _candidates(folder, dry_run):
        with claim(path) as nobody_else:
            if nobody_else:
                found.append(path)
                if not dry_run:
                    remove(path)
    return found


def _candidates(folder: Path, dry_run: bool) -> Iterator[Path]:
    """Yield what bears a name of unfinished or temporary files; it may be in use."""
    for inside, folders, files in os.walk(folder):
        if PENDING in folders and not dry_run:
            finish_run_folder(Path(inside))
        named = [name for name in (*folders, *files) if _is_temporary(Path(inside, name))]
        folders[:] = [name for name in folders if name not in named and name != PENDING]
        yield from (Path(inside, name) for name in sorted(named))


def _is_temporary(path: Path) -> bool:
    if path.is_symlink():
        return False
    if path.name.endswith(f".gz{_UNPACKED}"):
        return path.with_name(path.name.removesuffix(_UNPACKED)).is_file()
    return _PARTIAL.fullmatch(path.name) is not None or is_lock(path)
