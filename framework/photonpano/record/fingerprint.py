"""Fingerprint a capture: its files, and a hash of sampled frames. Two captures with one fingerprint give one result."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
from pydantic import BaseModel

from photonpano.capture import capture_of
from photonpano.contracts.protocols import Source
from photonpano.errors import InputError
from photonpano.files.paths import Location, Url
from photonpano.reading.remote import remote_file
from photonpano.specs.plan import Plan

_PLACES, _FRAMES = 16, 4  # 4 frames at each of 16 places are hashed: at the most 1 MB of a packed capture of 254x496 px


class FileRecord(TypedDict):
    """A file, or a folder of files, that the source, a correction or the motion graph reads.

    `bytes` is the size of all its files, `modified` the latest of their times, ISO 8601 in UTC; None where there is none.
    `etag` is the mark that a server gives the content of a URL; None for other files.
    """

    path: str
    bytes: int | None
    modified: str | None
    etag: str | None


class CaptureRecord(TypedDict):
    """The fingerprint of a capture.

    `frames_sha256` is of sampled frames, as the source and the corrections of the spec give them. `pixels_sha256` is of the
    mask and of what corrections make of a sum of frames.
    """

    files: Sequence[FileRecord]
    frames_sha256: str
    pixels_sha256: str


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
