"""Source `fastcam-mraw`: raw frames of Photron FASTCAM cameras; their headers are .cih, text, or .cihx, which contains XML."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from photonpano import FrameSpan, InputError
from photonpano.compiling import compiled
from photonpano.reading import OpenFiles, missing_file, reading
from photonpano_sensors.intensity.contributions import FastcamMrawConfig, header_beside, mraw_beside, refuse_mdat
from photonpano_sensors.intensity.source import Encoding, IntensitySource, Levels

_MOST_BYTES = 4 * 1024**2  # headers have a few kB; larger files are something else
_BITS = (8, 12, 16)
_COUNT = re.compile(r"\d{1,9}")
_RATE = re.compile(r"\d{1,9}(\.\d{1,9})?")
# The keys of .cih and .cihx files.
_KEYS = {
    "width": ("Image Width", "imageDataInfo/resolution/width"),
    "height": ("Image Height", "imageDataInfo/resolution/height"),
    "frames": ("Total Frame", "frameInfo/totalFrame"),
    "bits": ("Color Bit", "imageDataInfo/colorInfo/bit"),
    "effective bits": ("EffectiveBit Depth", "imageDataInfo/effectiveBit/depth"),
    "effective side": ("EffectiveBit Side", "imageDataInfo/effectiveBit/side"),
    "format": ("File Format", "imageFileInfo/fileFormat"),
    "rate": ("Record Rate(fps)", "recordInfo/recordRate"),
    "step": ("Save Step", "frameInfo/skipFrame"),
}


class FastcamMrawSource(IntensitySource):
    """Frames of 8, 12 or 16 bits in one .mraw file, described by the .cih or .cihx file beside it."""

    def __init__(self, config: FastcamMrawConfig) -> None:
        self._path, header = open_recording(config.path)
        super().__init__(config, (header.n_frames, header.height, header.width), header.frame_rate_hz, header.encoding)
        self._header = header
        self._files = OpenFiles()

    def close(self) -> None:
        """Close the file."""
        self._files.close()

    def _read(self, span: FrameSpan, levels: Levels) -> None:
        frame_bytes = self._header.frame_bytes
        flat, position = levels.reshape(-1), span.start * frame_bytes
        if self._header.bits != 12:
            self._files.read(self._path, position, flat.view(np.uint8))
            return
        packed = np.empty(len(span) * frame_bytes, np.uint8)
        self._files.read(self._path, position, packed)
        _unpack_12_bits(packed, flat.view(np.uint16))


def open_recording(path: Path) -> tuple[Path, Header]:
    """Return the .mraw file and the header of a recording, named by either; raises an `InputError` if one is unfit."""
    refuse_mdat(path)
    if not path.exists():
        raise InputError(missing_file(path))
    suffix = path.suffix.lower()
    if suffix == ".mraw":
        header_path = header_beside(path)
        if header_path is None:
            raise InputError(
                f"{path} has no .cihx or .cih file beside it, with the size and the bits of its frames; copy it too"
            )
        mraw = path
    elif suffix in (".cih", ".cihx"):
        header_path, beside = path, mraw_beside(path)
        if beside is None:
            raise InputError(f"{path} has no .mraw file beside it, which holds the frames; copy it from the camera too")
        mraw = beside
    else:
        raise InputError(f"{path} is not a recording of a FASTCAM: name its .cih, .cihx or .mraw file")
    header = read_header(header_path)
    needed, size = header.n_frames * header.frame_bytes, mraw.stat().st_size
    if size < needed:
        raise InputError(
            f"{mraw} is cut short: {header.n_frames} frames of {header.height}x{header.width} pixels of {header.bits} bits, as "
            f"{header_path.name} promises, are {needed} bytes, the file has {size}; copy or record it again"
        )
    return mraw, header


@compiled
def _unpack_12_bits(packed: NDArray[np.uint8], levels: NDArray[np.uint16]) -> None:
    """Unpack two levels from every three bytes, the higher bits first: (3 n,) to (2 n,)."""
    for pair in range(len(levels) // 2):
        first, middle, last = packed[3 * pair], packed[3 * pair + 1], packed[3 * pair + 2]
        levels[2 * pair] = np.uint16(first) << 4 | np.uint16(middle) >> 4
        levels[2 * pair + 1] = (np.uint16(middle) & 15) << 8 | np.uint16(last)


@dataclass(frozen=True, slots=True)
class Header:
    """The header of a recording."""

    n_frames: int  # frames in the .mraw file
    height: int
    width: int
    bits: int  # bits of a pixel in the file: 8, 12 or 16
    encoding: Encoding  # meaning of the levels; it has fewer bits than the file if the camera has
    frame_rate_hz: float | None  # frames per second in the file, without frames that were skipped when it was saved

    @property
    def frame_bytes(self) -> int:
        """Bytes of a frame in the .mraw file."""
        return self.height * self.width * self.bits // 8


def read_header(path: Path) -> Header:
    """Read a .cih or .cihx file; raises an `InputError` if it is missing or something else, or frames cannot be read."""
    with reading(path), path.open("rb") as file:
        content = file.read(_MOST_BYTES + 1)
    if len(content) > _MOST_BYTES:
        raise InputError(f"{path} is too large for a header of a Photron camera")
    return _header(path, _of_xml(path, content) if path.suffix.lower() == ".cihx" else _of_text(content))


def _of_text(content: bytes) -> Callable[[str], str | None]:
    """Return a function that looks up a value of a .cih file."""
    lines = (line.partition(":") for line in content.decode("utf-8", errors="replace").splitlines())
    values: dict[str, str] = {}
    for key, _, value in lines:
        values.setdefault(key.strip(), value.strip())
    return lambda what: values.get(_KEYS[what][0])


def _of_xml(path: Path, content: bytes) -> Callable[[str], str | None]:
    """Return a function that looks up a value of a .cihx file from `<cih>` on, so that no entities are expanded."""
    start, end = content.find(b"<cih>"), content.rfind(b"</cih>")
    if not 0 <= start < end:
        raise InputError(f"{path} is no header of a Photron camera: it has no part between <cih> and </cih>")
    try:
        root = ElementTree.fromstring(content[start : end + len(b"</cih>")].decode("utf-8", errors="replace"))
    except (ElementTree.ParseError, ValueError) as error:
        raise InputError(f"{path} is damaged: {error}; copy it again") from error
    return lambda what: root.findtext(_KEYS[what][1])


def _header(path: Path, value_of: Callable[[str], str | None]) -> Header:
    name = path.suffix.lower() == ".cihx"

    def value(what: str) -> str:
        found = (value_of(what) or "").strip()
        if not found:
            raise InputError(f"{path} lacks {_KEYS[what][name]!r}; check that it is the header of a recording, and complete")
        return found

    def count(what: str) -> int:
        found = value(what)
        if not (_COUNT.fullmatch(found) and int(found)):
            raise InputError(f"{path}: {_KEYS[what][name]!r} must be a whole number above 0, got {found:.40}")
        return int(found)

    if value("format").lower() != "mraw":
        raise InputError(
            f"{path} belongs to a recording of the format {value('format'):.40}, not MRaw; "
            "read .avi files with the source video, .tif and .png files with image-folder"
        )
    bits = count("bits")
    if bits not in _BITS:
        colour = "; colour is not supported: save the recording as raw or monochrome" if bits in (24, 36, 48) else ""
        raise InputError(f"{path}: pixels of {bits} bits cannot be read, only of 8, 12 or 16{colour}")
    height, width = count("height"), count("width")
    if height * width * bits % 8:
        raise InputError(f"{path}: frames of {height}x{width} pixels of {bits} bits are not a whole number of bytes")
    effective = count("effective bits")
    if effective > bits:
        raise InputError(f"{path}: pixels of {bits} bits cannot hold {effective} effective ones")
    rate, step = (value_of("rate") or "").strip(), (value_of("step") or "").strip()
    rate_hz = float(rate) if _RATE.fullmatch(rate) else 0.0
    every = int(step) if _COUNT.fullmatch(step) else 1
    side = value("effective side").lower()
    if side not in ("lower", "higher"):
        raise InputError(f"{path}: {_KEYS['effective side'][name]!r} must be Lower or Higher, got {side:.40}")
    white = 2**effective - 1
    # Levels of more than a byte keep two bytes, even if at most 8 bits are effective.
    low = Encoding(max(effective, min(bits, 9)), 0.0, white)
    encoding = low if side == "lower" else Encoding(bits, 0.0, white << (bits - effective))
    return Header(count("frames"), height, width, bits, encoding, rate_hz / max(every, 1) or None)
