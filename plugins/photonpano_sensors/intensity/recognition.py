"""Recognise captures of grey levels by their names and first bytes."""

from __future__ import annotations

import re
from pathlib import Path

from photonpano import InputError, Recognised
from photonpano.reading import natural_order, read_start

PICTURES = (".png", ".tif", ".tiff")
_CONTAINERS = (
    ("an AVI file", re.compile(rb"RIFF....AVI ", re.DOTALL)),
    ("an MP4 or MOV file", re.compile(rb"....(ftyp|moov|mdat|wide|free)", re.DOTALL)),
    ("a Matroska or WebM file", re.compile(rb"\x1a\x45\xdf\xa3")),
)
_START_BYTES = 16
_TIFF = re.compile(rb"II[\x2a\x2b]\0|MM\0[\x2a\x2b]")


def recognise_video(path: Path) -> Recognised | None:
    """Recognise videos by their first bytes."""
    start = read_start(path, _START_BYTES)
    for name, pattern in _CONTAINERS:
        if pattern.match(start):
            return Recognised({"path": path}, f"by its first bytes it is {name}")
    return None


def recognise_mraw(path: Path) -> Recognised | None:
    """Recognise headers and frames of Photron cameras, including those of an Infinicam: opening these says what to do."""
    suffix = path.suffix.lower()
    if not is_file(path):
        return None
    if suffix == ".mdat":
        return Recognised({"path": path}, "Photron's cameras write .mdat files")
    if suffix == ".mraw" and (header := header_beside(path)):
        return Recognised({"path": path}, f"{header.name} beside it is its header")
    if suffix in (".cih", ".cihx") and (mraw := mraw_beside(path) or _beside(path, ".mdat")):
        return Recognised({"path": path}, f"{mraw.name} beside it holds the frames")
    return None


def recognise_pictures(path: Path) -> Recognised | None:
    """Recognise folders of pictures, and TIFF files."""
    if _TIFF.match(read_start(path, _START_BYTES)):
        return Recognised({"path": path}, "by its first bytes it is a TIFF file")
    found = pictures_in(path)
    if not found:
        return None
    return Recognised({"path": path}, f"it holds {len(found)} {found[0].suffix} file{'s' if len(found) > 1 else ''}")


def refuse_mdat(path: Path) -> None:
    """Refuse raw files of an Infinicam, or the header of one, with an `InputError` that says what to do."""
    header_of = _beside(path, ".mdat") if path.suffix.lower() in (".cih", ".cihx") and not mraw_beside(path) else None
    if path.suffix.lower() == ".mdat" or header_of is not None:
        raise InputError(
            f"{header_of or path} is compressed by the camera, and only Photron's own library for Windows decodes it; "
            "export it as AVI or MP4 in the camera's viewer, and read that with the source video"
        )


def header_beside(mraw: Path) -> Path | None:
    """Return the header of an .mraw file; None if there is none."""
    return _beside(mraw, ".cihx") or _beside(mraw, ".cih")


def mraw_beside(header: Path) -> Path | None:
    """Return the .mraw file of a header; None if there is none."""
    return _beside(header, ".mraw")


def pictures_in(folder: Path) -> list[Path]:
    """Return the pictures of a folder in natural order; none if the folder cannot be read."""
    try:
        pictures = [file for file in folder.iterdir() if file.suffix.lower() in PICTURES]
    except OSError:
        return []
    return sorted(pictures, key=natural_order)


def _beside(path: Path, suffix: str) -> Path | None:
    candidates = (path.with_suffix(each) for each in (suffix, suffix.upper()))
    return next((each for each in candidates if is_file(each)), None)


def is_file(path: Path) -> bool:
    """Return whether there is such a file; False if the system refuses to answer."""
    try:
        return path.is_file()
    except OSError:
        return False
