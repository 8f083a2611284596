"""The work folder: it stands beside the run folder, and holds what a run has found until the run is finished."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from photonpano.errors import InputError, OutputError, PhotonpanoError
from photonpano.execution.context import Checkpoints, KeepNothing, Progress
from photonpano.files.atomic import atomic_path
from photonpano.pipeline.checkpoints.fingerprint import Fingerprint, differences
from photonpano.pipeline.checkpoints.store import SUFFIX, Kept, Store, finished
from photonpano.text import counted
from photonpano.values import Decision

logger = logging.getLogger(__name__)

MANIFEST = "work.json"
FORMAT = 1
_SHOWN = 3  # differences that a message names


@dataclass(frozen=True, slots=True)
class Continuation:
    """What a run takes from the run before."""

    resume: bool = False  # go on with an interrupted run of the same spec
    # take the levels before this one, and compute this one and everything after it; None to take none
    from_level: int | None = None
    keep: bool = False  # keep the work folder when the run is finished, for `from_level`


class Work:
    """The work of a run; its `checkpoints` keep what the run finds."""

    def __init__(self, folder: Path | None, now: Fingerprint, decisions: list[Decision], keep: bool) -> None:
        self._folder, self._now, self._keep = folder, now, keep
        self._store = None if folder is None else Store(folder)
        self._kept = None if self._store is None else Kept(self._store, decisions)
        self.checkpoints: Checkpoints = self._kept or KeepNothing()
        self._finished = False

    def finish(self) -> None:
        """Remove the work, or keep it for other runs: the results are written."""
        self._finished = True
        if self._folder is None:
            return
        if self._keep:
            with _harmless():
                _write_manifest(self._folder, self._now, finished=True)
        else:
            _remove(self._folder)

    def close(self, *, failed: bool = False) -> bool:
        """Write what has not been written yet; return whether there is work to go on with.

        A run that `failed` would fail again, so that only finished levels are of use.
        """
        if self._finished or self._kept is None or self._store is None or self._folder is None:
            return False
        self._kept.flush()
        useful = finished(self._store, "level-1") if failed else self._store.holds_something
        if not useful:
            _remove(self._folder)
        return useful


def path_of(run_folder: Path) -> Path:
    """Return the path of the work folder of a run: `runs/scan.work` for `runs/scan`."""
    place = run_folder.absolute().resolve()
    return place.with_name(f"{place.name}.work")


@contextmanager
def work_folder(
    run_folder: Path, now: Fingerprint, decisions: list[Decision], how: Continuation, progress: Progress
) -> Iterator[Work]:
    """Open the work folder of a run, whose lock is held; `InputError` if levels before `how.from_level` cannot be taken.

    What it holds stays after an interruption or an error. Where nothing can be kept, a warning says so, and the run goes on.
    """
    folder = path_of(run_folder)
    _require_levels(folder, now, how.from_level)
    try:
        _prepare(folder, now, how, progress)
        work = Work(folder, now, decisions, how.keep or how.from_level is not None)
    except (OutputError, OSError) as error:
        reason = error.strerror or error if isinstance(error, OSError) else error
        logger.warning(
            "%s: what the run finds cannot be kept (%s); if it is interrupted, all of it is computed again", folder, reason
        )
        work = Work(None, now, decisions, keep=False)
    try:
        yield work
    except BaseException as error:
        if work.close(failed=isinstance(error, PhotonpanoError) and not isinstance(error, OutputError)):
            progress.note(f"{folder} holds what was found; with --resume, the run goes on from there")
        raise
    work.close()


def _prepare(folder: Path, now: Fingerprint, how: Continuation, progress: Progress) -> None:
    """Clear the work folder of what this run may not reuse; `OutputError` if it is the folder of somebody else."""
    there = os.path.lexists(folder)
    if there and not _is_ours(folder):
        raise OutputError("it is there already, and is not the work folder of a run")
    manifest = _manifest(folder)
    if how.from_level is not None:
        _clear(folder, from_level=how.from_level)
    elif how.resume and there:
        reasons = _why_not(manifest, now)
        if not reasons:
            progress.note(f"going on with the interrupted run, from {folder}")
            for file in filter(_is_record, folder.glob(".*")):  # what a killed process was writing
                file.unlink(missing_ok=True)
            return
        logger.warning("%s: the interrupted run is not continued, but started again: %s", folder, _named(reasons))
        _clear(folder)
    elif how.resume:
        progress.note("there is no interrupted run to go on with: the run starts at the beginning")
    elif there:
        if manifest is None or not manifest["finished"]:
            if _why_not(manifest, now):
                progress.note(f"{folder} held the work of an interrupted run of something else; it is replaced")
            else:
                logger.warning(
                    "%s held the work of an interrupted run, which --resume would have continued; it is replaced", folder
                )
        _clear(folder)
    folder.mkdir(parents=True, exist_ok=True)
    _write_manifest(folder, now, finished=False)


def _require_levels(folder: Path, now: Fingerprint, from_level: int | None) -> None:
    """Raise `InputError` if levels to start from are missing, or were found in another way."""
    if from_level is None:
        return
    n_levels, option = len(now["levels"]), f"--from-level {from_level}"
    if not 2 <= from_level <= n_levels + 1:
        raise InputError(f"{option}: the spec has {n_levels} levels; expected 2 to {n_levels + 1}")
    manifest = _manifest(folder) if _is_ours(folder) else None
    if manifest is None:
        raise InputError(f"{option}: there is no work folder {folder}; run with --keep-work first")
    store = Store(folder)
    n_finished = next((level - 1 for level in range(1, n_levels + 1) if not finished(store, f"level-{level}")), n_levels)
    if not n_finished:
        raise InputError(f"{option}: {folder} holds no finished level; run without the option")
    if n_finished < from_level - 1:
        expected = "2" if n_finished == 1 else f"2 {'or' if n_finished == 2 else 'to'} {n_finished + 1}"
        raise InputError(f"{option}: {folder} holds {counted(n_finished, 'finished level')}; expected {expected}")
    if reasons := differences(manifest["fingerprint"], now, from_level - 1):
        raise InputError(
            f"{option}: the levels before it were found in another way: {_named(reasons)}; run without the option, or from an "
            "earlier level"
        )


def _why_not(manifest: dict[str, Any] | None, now: Fingerprint) -> list[str]:
    if manifest is None:
        return [f"{MANIFEST} is missing or damaged"]
    return differences(manifest["fingerprint"], now)


def _named(reasons: list[str]) -> str:
    more = f", and {len(reasons) - _SHOWN} more" if len(reasons) > _SHOWN else ""
    return ", ".join(reasons[:_SHOWN]) + more


def _manifest(folder: Path) -> dict[str, Any] | None:
    """Read the manifest; None if there is none that this version can read."""
    try:
        found = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        differences(found["fingerprint"], found["fingerprint"])
        return {"finished": bool(found["finished"]), **found} if found["format"] == FORMAT else None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None


def _write_manifest(folder: Path, now: Fingerprint, *, finished: bool) -> None:
    with atomic_path(folder / MANIFEST) as temporary:
        text = json.dumps({"format": FORMAT, "finished": finished, "fingerprint": now}, indent=1)
        temporary.write_text(text, encoding="utf-8")


def _is_ours(folder: Path) -> bool:
    """Return whether a folder holds nothing but what runs keep in it."""
    return folder.is_dir() and not folder.is_symlink() and all(map(_is_record, folder.iterdir()))


def _is_record(path: Path) -> bool:
    """Return whether a run has written a file, or was about to."""
    return path.name == MANIFEST or path.suffix == SUFFIX or ".partial" in path.suffixes


def _clear(folder: Path, from_level: int = 1) -> None:
    """Remove what was kept, but the levels before one; the manifest last, which names what the rest depends on."""
    taken = tuple(f"level-{level}{end}" for level in range(1, from_level) for end in ".-")
    files = [each for each in folder.iterdir() if _is_record(each)] if folder.is_dir() else []
    for file in sorted(files, key=lambda each: each.name == MANIFEST):
        if not file.name.startswith(taken):
            file.unlink(missing_ok=True)


def _remove(folder: Path) -> None:
    with _harmless():
        _clear(folder)
        folder.rmdir()


@contextmanager
def _harmless() -> Iterator[None]:
    """Warn of what goes wrong with the work folder when it is not needed any more."""
    try:
        yield
    except (OSError, OutputError) as error:
        logger.warning("the work folder could not be changed: %s", error)
