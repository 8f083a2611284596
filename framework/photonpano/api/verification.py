"""Verify a run folder, and remove what dead processes have left."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from photonpano.atomic import remove
from photonpano.captures.fingerprint import CaptureRecord, changes, fingerprint
from photonpano.errors import InputError, SpecError
from photonpano.folders import PENDING
from photonpano.locks import claim, is_lock
from photonpano.pipeline.components import open_source
from photonpano.record.contents import changed_files, finish_run_folder, recorded_contents
from photonpano.record.run_json import read_record
from photonpano.registry import Catalog
from photonpano.specs import parse_spec

_PARTIAL = re.compile(r"\.(.+\.)?[0-9a-f]{8}\.partial(\.\w+)?")
_OLDER = re.compile(r"\.part-[a-z0-9_]{8}")
_OLDER_S = 24 * 3600
"""Older versions lock nothing: what they began counts as left behind after a day."""
_UNPACKED = ".unpacked.npy"


@dataclass(frozen=True, slots=True)
class Verification:
    """What `verify` found.

    Attributes:
        n_files: number of files that were compared.
        n_bytes: their size.
        problems: what is not as the run left it, a clause each.
        capture: what became of the capture, if that is no problem: a clause.
    """

    n_files: int
    n_bytes: int
    problems: tuple[str, ...]
    capture: str


def verify(run_folder: Path | str, catalog: Catalog | None = None) -> Verification:
    """Compare the files of a run with the hashes in `run.json`, and the capture with its fingerprint there.

    If a run was killed while it put its files in place, they are put there first.

    Args:
        run_folder: written by `run`.
        catalog: what can be chosen; by default what the installed plugins offer.

    Raises:
        InputError: the folder is no run folder.
    """
    folder = Path(run_folder)
    finish_run_folder(folder)
    record = read_record(folder)
    recorded, changed = recorded_contents(folder), changed_files(folder)
    if recorded is None or changed is None:
        return Verification(0, 0, ("run.json lists no hashes, as in older versions",), "not compared")
    problems = [f"{name} is missing" for name in recorded if not os.path.lexists(folder / name)]
    problems += [f"{name} is not the file that the run wrote" for name in changed]
    others, capture = _capture(folder, record["spec"], record.get("capture"), catalog)
    size = sum(content["bytes"] for content in recorded.values())
    return Verification(len(recorded), size, (*problems, *others), capture)


def _capture(folder: Path, spec: object, old: CaptureRecord | None, catalog: Catalog | None) -> tuple[list[str], str]:
    """Return the problems of the capture; and if there are none, what became of it."""
    if old is None:
        return [], "not compared: run.json has no fingerprint of it"
    try:
        plan = parse_spec(spec, name=str(folder / "run.json"), catalog=catalog)  # type: ignore[arg-type]  # checked there
        with open_source(plan) as source:
            new = fingerprint(plan, source)
    except SpecError as error:
        return [], f"not compared: {error.problems[0].message}"
    except InputError as error:
        return [], f"not compared: {error}"
    found = changes(old, new)
    sizes = [[(file["path"], file["bytes"]) for file in record["files"]] for record in (old, new)]
    same = sizes[0] == sizes[1] and all(old[key] == new[key] for key in ("frames_sha256", "pixels_sha256"))
    return ([], "; ".join(["the same frames", *found])) if same else (found, "")


def clean(directory: Path | str, dry_run: bool = False) -> list[Path]:
    """Remove what killed processes have left in a folder and those in it: unfinished files, locks, unpacked archives.

    Files of a run that was killed while it put them in place are put there. An unpacked archive is removed if the archive is
    there, from which it can be unpacked again. Nothing is removed that a process uses. Unfinished conversions (`.part`) are
    kept, since `convert` continues them.

    Args:
        directory: symbolic links in it are not followed.
        dry_run: whether to remove nothing.

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
    if _OLDER.fullmatch(path.name):
        return path.is_dir() and time.time() - path.stat().st_mtime > _OLDER_S
    if path.name.endswith(f".gz{_UNPACKED}"):
        return path.with_name(path.name.removesuffix(_UNPACKED)).is_file()
    return _PARTIAL.fullmatch(path.name) is not None or is_lock(path)
