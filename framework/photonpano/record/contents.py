"""The files of a run folder and of its capture: what they are called, their sizes and hashes, and whether they belong together.

The files of a folder belong to one run if their hashes are those that it recorded. Two captures with one fingerprint, of their
files and of sampled frames, give one result.
"""

from __future__ import annotations

import hashlib
import json
import os
import stat
from collections.abc import Iterable, Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from pydantic import BaseModel

from photonpano.capture import capture_of
from photonpano.contracts.protocols import Source
from photonpano.errors import InputError
from photonpano.files.paths import Location, Url
from photonpano.reading.files import remote_file
from photonpano.record.schema import CaptureRecord, FileContent, FileRecord
from photonpano.specs.plan import Plan

RECORD = "run.json"
_FLUX = "photons per pixel per frame"
# What maps of the panorama hold of each pixel, as their files say it.
MAPS = {
    "panorama.tiff": f"flux, {_FLUX}",
    "coverage.tiff": "number of frames",
    "panorama-std.tiff": f"standard deviation of the flux, {_FLUX}",
    "first-frame.tiff": "number of the first frame, from 0",
    "last-frame.tiff": "number of the last frame, from 0",
}
HALVES = ("panorama-first.tiff", "panorama-last.tiff")  # by the first and the last half of the frames that saw each place
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


_PLACES, _FRAMES = 16, 4  # 4 frames at each of 16 places are hashed: at the most 1 MB of a packed capture of 254x496 px


def fingerprint(plan: Plan, source: Source) -> CaptureRecord:
    """Return the fingerprint of the open capture of a plan, which names its files."""
    suffixes = tuple(plan.source.contribution.suffixes)  # type: ignore[attr-defined]  # those of a source
    capture, pixels = capture_of(source), hashlib.sha256(np.packbits(source.valid).data)
    for mask in capture.masks:
        pixels.update(f"{mask.span} {np.packbits(mask.valid).tobytes()!r}".encode())
    if capture.corrects_sums:
        (first, *_) = source.info.spread(_PLACES, _FRAMES)
        pixels.update(np.ascontiguousarray(capture.corrected_counts(first)).data)
    return {
        "files": [_remote(path) if isinstance(path, Url) else _file(path, suffixes) for path in _locations(plan)],
        "frames_sha256": frames_sha256(source),
        "pixels_sha256": pixels.hexdigest(),
    }


def capture_files(plan: Plan) -> list[Path]:
    """Return the files and folders that a plan names, for its source, corrections, motion and pairs; URLs are none."""
    return [path for path in _locations(plan) if isinstance(path, Path)]


def name_of_capture(plan: Plan) -> str:
    """Return the name of the file or folder of a capture; that of a source without files."""
    return next((str(each).rstrip("/").rpartition("/")[2] for each in _locations(plan)), plan.source.contribution.name)


def _locations(plan: Plan) -> list[Location]:
    return list(dict.fromkeys(_paths([plan.source.config, plan.corrections, plan.motion, plan.graph])))


def frames_sha256(source: Source) -> str:
    """Hash the size of a capture, and 4 frames at each of 16 places."""
    capture, info = capture_of(source), source.info
    digest = hashlib.sha256(repr((info.n_frames, *info.frame_shape, info.kind)).encode())
    for span in info.spread(_PLACES, _FRAMES):
        frames = capture.packed(span) if capture.is_packed else capture.frames(span)
        digest.update(np.ascontiguousarray(frames).data)
    return digest.hexdigest()


def changes(old: CaptureRecord, new: CaptureRecord) -> list[str]:
    """Return what differs between two fingerprints, a clause each; none if both are of one capture that nobody touched."""
    before, after = ({file["path"]: file for file in record["files"]} for record in (old, new))
    found = [f"{path} is not read any more" for path in before if path not in after]
    for path, file in after.items():
        if path not in before:
            found.append(f"{path} is read as well")
        elif file["bytes"] != before[path]["bytes"]:
            found.append(f"{path} has another size")
        elif file.get("etag") != before[path].get("etag"):
            found.append(f"{path} has another content, by its ETag")
        elif file["modified"] != before[path]["modified"]:
            found.append(f"{path} was written at {file['modified']}, not {before[path]['modified']}")
    if old["frames_sha256"] != new["frames_sha256"]:
        found.append("the frames are others")
    if old["pixels_sha256"] != new["pixels_sha256"]:
        found.append("the mask or another correction gives other pixels")
    return found


def _paths(value: Any) -> Iterator[Location]:
    """Yield the paths and URLs in a config, at any depth."""
    if isinstance(value, Url):
        yield value
    elif isinstance(value, Path):
        yield Path(os.path.normpath(value.absolute()))
    elif isinstance(value, BaseModel):
        for name in type(value).model_fields:
            yield from _paths(getattr(value, name))
    elif isinstance(value, dict):
        yield from _paths(list(value.values()))
    elif isinstance(value, list | tuple):
        for item in value:
            yield from _paths(item)


def _file(path: Path, suffixes: tuple[str, ...]) -> FileRecord:
    stats = [file.stat() for file in _files(path, suffixes) if file.is_file()]
    if not stats:
        return {"path": str(path), "bytes": None, "modified": None, "etag": None}
    latest = max(stat.st_mtime_ns for stat in stats)
    seconds = datetime.fromtimestamp(latest // 10**9, UTC).strftime("%Y-%m-%dT%H:%M:%S")
    size = sum(stat.st_size for stat in stats)
    return {"path": str(path), "bytes": size, "modified": f"{seconds}.{latest % 10**9:09d}Z", "etag": None}


def _remote(url: Url) -> FileRecord:
    """Describe a URL, as far as its server does. A folder in an object store is neither a file, nor has it a size."""
    try:
        found = remote_file(url)
    except InputError:
        return {"path": str(url), "bytes": None, "modified": None, "etag": None}
    modified = None if found.modified is None else found.modified.strftime("%Y-%m-%dT%H:%M:%SZ")
    return {"path": str(url), "bytes": found.size, "modified": modified, "etag": found.etag}


def _files(path: Path, suffixes: tuple[str, ...]) -> Iterator[Path]:
    """Yield a file; or those in a folder with one of the suffixes, without hidden ones and those of run folders."""
    if not path.is_dir():
        yield path
        return
    if path.name.lower().endswith(suffixes):  # the folder itself is the capture
        suffixes = ()
    for folder, inner, names in os.walk(path):
        if "run.json" in names:
            inner.clear()
            continue
        inner[:] = [name for name in inner if not name.startswith(".") and not name.endswith(".work")]
        shown = (name for name in names if not name.startswith("."))
        yield from (Path(folder, name) for name in shown if not suffixes or name.lower().endswith(suffixes))
