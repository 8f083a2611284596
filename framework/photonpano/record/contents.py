"""The files of a run folder: what they are called, their sizes and hashes, and whether they belong to one run."""

from __future__ import annotations

import hashlib
import json
import stat
from collections.abc import Iterable, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from photonpano.contracts.protocols import Source
from photonpano.errors import InputError
from photonpano.record.fingerprint import frames_sha256
from photonpano.record.schema import FileContent

RECORD = "run.json"
MAPS = ("panorama.tiff", "coverage.tiff", "panorama-std.tiff")  # flux, frames, and standard deviation of the flux of each pixel
REPORT = "report.html"


def contents_of(folder: Path) -> dict[str, FileContent]:
    """Return size and SHA-256 of the files in a folder by their paths in it, such as `sparse/images.txt`, without run.json."""
    paths = (path for path in folder.rglob("*") if path.is_symlink() or not path.is_dir())
    names = sorted(name for path in paths if (name := path.relative_to(folder).as_posix()) != RECORD)
    return {name: content_of(folder / name) for name in names}


def recorded_json(folder: Path) -> Mapping[str, Any] | None:
    """Return the content of run.json if a run wrote it, else None."""
    try:
        record = json.loads((folder / RECORD).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    return record if isinstance(record, dict) and "photonpano" in record and isinstance(record.get("spec"), dict) else None


def recorded_contents(folder: Path) -> Mapping[str, FileContent]:
    """Return size and SHA-256 of each file as run.json lists them; nothing if it lists none, or files outside of the folder."""
    listed = (recorded_json(folder) or {}).get("files")
    if not isinstance(listed, dict) or not all(isinstance(each, dict) for each in listed.values()):
        return {}
    outside = any(PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts for name in listed)
    return {} if outside else listed


def names_of_results(folder: Path) -> set[str]:
    """Return the paths in a folder of the files that belong to its run."""
    return {RECORD, REPORT, *recorded_contents(folder)}


def changed_files(folder: Path, names: Iterable[str] | None = None) -> list[str]:
    """Return which of the named files, by default all, differ from what run.json lists."""
    recorded = recorded_contents(folder)
    there = [name for name in (recorded if names is None else names) if name in recorded and (folder / name).exists()]
    return [name for name in there if _differs(folder / name, recorded[name])]


def require_one_run(folder: Path, names: Iterable[str]) -> None:
    """Raise `InputError` if files are not those of the run.json beside them."""
    if changed := changed_files(folder, names):
        was = "is not the file" if len(changed) == 1 else "are not the files"
        raise InputError(
            f"{folder}: {' and '.join(changed)} {was} that its run.json lists; the folder mixes several runs, or a file was "
            "changed: run the spec again"
        )


def require_same_frames(folder: Path, record: Mapping[str, Any], source: Source) -> None:
    """Raise `InputError` if a capture has other frames than a run has read."""
    recorded = record.get("capture")
    if isinstance(recorded, dict) and frames_sha256(source) != recorded.get("frames_sha256"):
        raise InputError(f"{folder}: the capture has other frames than when it was run; it is another capture")


def _differs(path: Path, recorded: FileContent) -> bool:
    try:
        return path.lstat().st_size != recorded.get("bytes") or content_of(path) != recorded
    except OSError:
        return True


def content_of(path: Path) -> FileContent:
    """Return size and SHA-256 of a file; nothing of what is no regular file."""
    if not stat.S_ISREG(path.lstat().st_mode):
        return {"bytes": 0, "sha256": ""}
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256")
        return {"bytes": file.tell(), "sha256": digest.hexdigest()}
