"""Sources of grey levels in files of frames: pictures, pages of TIFF files, and raw frames of Photron FASTCAM cameras.

The headers of raw frames are .cih, text, or .cihx, which contains XML.
"""

from __future__ import annotations

import logging
import re
import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import NamedTuple
from xml.etree import ElementTree

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from photonpano import FrameSpan, InputError
from photonpano.compiling import compiled
from photonpano.reading import OpenFiles, missing_file, read_picture, reading, require_readable
from photonpano_sensors.intensity.contributions import (
    FastcamMrawConfig,
    ImageFolderConfig,
    header_beside,
    mraw_beside,
    pictures_in,
    refuse_mdat,
)
from photonpano_sensors.intensity.source import Encoding, IntensitySource, Levels

Image = NDArray[np.generic]

_PNG = b"\x89PNG\r\n\x1a\n"
_PNG_COLOURS = {2: "colours", 3: "a palette", 4: "transparency", 6: "colours"}  # colour types other than grey
# bytes that a byte of a file may unpack to: 1,032 in PNG, more in other formats, for black frames
_MOST_SQUEEZED = 4096
_DAMAGED = "is damaged: it is not a TIFF file that can be read; copy it again"
_MOST_BYTES = 4 * 1024**2  # headers have a few kB; larger files are something else
_BITS = (8, 12, 16)
logger = logging.getLogger("photonpano.fastcam-mraw")
_COUNT = re.compile(r"\d{1,9}")
_RATE = re.compile(r"\d{1,9}(\.\d{1,9})?(e\+?\d)?", re.IGNORECASE)
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


class _Form(NamedTuple):
    """Size and bits, which all frames of a capture share."""

    height: int
    width: int
    bits: int

    def __str__(self) -> str:
        return f"{self.height}x{self.width} pixels of {self.bits} bits"


class ImageFolderSource(IntensitySource):
    """Pictures of grey levels of 8 or 16 bits, all of one size; anything else raises an `InputError`."""

    def __init__(self, config: ImageFolderConfig) -> None:
        self._pictures: _Folder | _Pages = _Folder(config.path) if config.path.is_dir() else _Pages(config.path)
        form = self._pictures.form
        shape = self._pictures.n_frames, form.height, form.width
        super().__init__(config, shape, None, Encoding.full(form.bits))
        pictures = f'tifffile.imread("{config.path}")'
        if config.path.is_dir():
            files = f'sorted(pathlib.Path("{config.path}").iterdir(), key=lambda file: (len(file.name), file.name))'
            pictures = f"[cv2.imread(str(file), -1) for file in {files}]"
        self.refuse_binary(config.path, pictures)

    def close(self) -> None:
        """Close files."""
        self._pictures.close()

    def _read(self, span: FrameSpan, levels: Levels) -> None:
        for target, index in zip(levels, range(span.start, span.stop), strict=True):
            target[...] = self._pictures.read(index)


class _Folder:
    def __init__(self, path: Path) -> None:
        require_readable(path)
        self._files = pictures_in(path)
        if not self._files:
            raise InputError(f"{path} holds no .png or .tif files; name the folder that the frames are in")
        self.n_frames = len(self._files)
        self.form = _common((f"{file}", _form_of(file)) for file in self._files)

    def read(self, index: int) -> Image:
        file = self._files[index]
        levels = read_picture(file, f"is damaged: frame {index} cannot be read; copy it again", cv2.IMREAD_UNCHANGED)
        if levels.shape != self.form[:2] or 8 * levels.itemsize != self.form.bits:
            raise InputError(f"{file} has changed: it had {self.form} when the capture was opened")
        return _not_negative(levels, f"{file}")

    def close(self) -> None:
        """Do nothing: no file stays open."""


class _Pages:
    """A page of a TIFF file for each frame; or, as ImageJ writes large stacks, a single page and all frames behind it."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = Lock()
        self._file = _tiff(path)
        try:
            with reading(path, _DAMAGED):
                pages = enumerate(self._file.pages)
                self.form = _common((f"page {number} of {path}", _form_of_page(path, page)) for number, page in pages)
                self._stack = _stack_of(path, self._file, self.form) if len(self._file.pages) == 1 else None
                self.n_frames = len(self._file.pages if self._stack is None else self._stack)
        except BaseException:
            self.close()
            raise

    def read(self, index: int) -> Image:
        with reading(self._path, f"is damaged: page {index} cannot be read; copy it again"), self._lock:
            levels = np.asarray(self._file.pages[index].asarray() if self._stack is None else self._stack[index])
        if levels.shape != self.form[:2] or 8 * levels.itemsize != self.form.bits:
            raise InputError(
                f"{self._path} is damaged: page {index} is not of {self.form}, as its header promises; copy it again"
            )
        return _not_negative(levels, f"page {index} of {self._path}")

    def close(self) -> None:
        self._file.close()


def _stack_of(path: Path, file: tifffile.TiffFile, form: _Form) -> Image | None:
    """Return the frames behind the only page of a file, (T, H, W); None if there is the page alone."""
    stack = file.imagej_metadata or {}
    n_frames, n_channels = int(stack.get("images", 1)), int(stack.get("channels", 1))
    if 1 < n_channels < n_frames:
        raise InputError(f"{path} holds a stack of {n_channels} channels; save each channel, in grey, as a file of its own")
    if n_frames == 1:
        return None
    first = file.pages[0].dataoffsets[0]
    promised, there = first + n_frames * form.height * form.width * form.bits // 8, path.stat().st_size
    if there < promised:
        raise InputError(
            f"{path} is cut short: it promises {n_frames} frames, {promised:,} bytes, and has {there:,}; copy it again"
        )
    levels = np.dtype(file.pages[0].dtype).newbyteorder(file.byteorder)
    return np.memmap(path, levels, "r", first, (n_frames, form.height, form.width))


def _not_negative(levels: Image, name: str) -> Image:
    """Return levels, which may have a sign; an `InputError` says which are below zero: they are no photons."""
    if levels.dtype.kind == "i" and (lowest := int(levels.min())) < 0:
        raise InputError(
            f"{name} has values below zero, down to {lowest}: a black level was subtracted; save the frames without that, or "
            f"add {-lowest} or more to all of them"
        )
    return levels


def _common(forms: Iterable[tuple[str, _Form]]) -> _Form:
    """Return the form that all frames have; raises an `InputError` if they differ."""
    first: tuple[str, _Form] | None = None
    for name, form in forms:
        if first is None:
            first = name, form
        elif form != first[1]:
            raise InputError(
                f"{name} has {form}, and {first[0]} has {first[1]}; all frames must have one size: remove other pictures"
            )
    assert first is not None
    return first[1]


def _form_of(file: Path) -> _Form:
    """Return the form of a picture from its header."""
    if file.suffix.lower() != ".png":
        with _tiff(file) as tiff, reading(file, _DAMAGED):
            if len(tiff.pages) > 1:
                raise InputError(f"{file} has {len(tiff.pages)} pages; name the file itself if each is a frame")
            return _form_of_page(file, tiff.pages[0])
    with reading(file), file.open("rb") as opened:
        header = opened.read(26)
    if len(header) < 26 or not header.startswith(_PNG):
        raise InputError(f"{file} is not a PNG file, by its first bytes; remove it, or save it again")
    width, height, bits, colours = struct.unpack(">IIBB", header[16:])
    if colours:
        raise InputError(f"{file} has {_PNG_COLOURS.get(colours, 'colours')}; convert the frames to grey")
    return _grey(file, _Form(height, width, bits))


def _form_of_page(file: Path, page: tifffile.TiffPage | tifffile.TiffFrame) -> _Form:
    page = page.aspage()
    if page.samplesperpixel != 1 or page.photometric != tifffile.PHOTOMETRIC.MINISBLACK:
        raise InputError(f"{file} has colours, or white as 0; convert the frames to grey")
    if page.sampleformat not in (tifffile.SAMPLEFORMAT.UINT, tifffile.SAMPLEFORMAT.INT):
        raise InputError(f"{file} has numbers with fractions ({page.dtype}); convert the frames to 8 or 16 bits")
    orientation = page.tags.valueof("Orientation", default=1)
    if orientation != 1:
        raise InputError(
            f"{file} is to be turned or mirrored to be shown (orientation {orientation}); turn it, and save it again"
        )
    return _grey(file, _Form(page.imagelength, page.imagewidth, page.bitspersample))


def _grey(file: Path, form: _Form) -> _Form:
    if min(form.height, form.width) < 1:
        raise InputError(f"{file} has no pixels: it promises {form}; remove it, or copy it again")
    if form.bits not in (8, 16):
        raise InputError(f"{file} has {form}; convert the frames to 8 or 16 bits")
    n_bytes = file.stat().st_size
    if form.height * form.width * form.bits // 8 > n_bytes * _MOST_SQUEEZED:
        raise InputError(f"{file} is damaged: it promises {form}, and has {n_bytes:,} bytes; copy it again")
    return form


def _tiff(path: Path) -> tifffile.TiffFile:
    with reading(path, "is neither a folder nor a TIFF file that can be read; copy it again"):
        return tifffile.TiffFile(path)


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
            if (highest := int(flat.max())) >> self._header.encoding.bits:
                bits = f"the lower {self._header.encoding.bits} bits are used"
                raise InputError(
                    f"{self._path} has levels up to {highest}, and its header says that {bits}; correct the header"
                )
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
    if size >= needed + header.frame_bytes:
        promised = f"{header_path.name} promises {header.n_frames:,}, which are read"
        logger.warning(f"{mraw} holds {size // header.frame_bytes:,} frames, and {promised}; is it of another recording?")
    return mraw, header


@compiled
def _unpack_12_bits(packed: NDArray[np.uint8], levels: NDArray[np.uint16]) -> None:
    """Unpack two levels from every three bytes, the higher bits first: (3 n,) to (2 n,)."""
    for pair in range(len(levels) // 2):
        first, middle, last = packed[3 * pair], packed[3 * pair + 1], packed[3 * pair + 2]
        levels[2 * pair] = np.uint16(first) << 4 | np.uint16(middle) >> 4
        levels[2 * pair + 1] = (np.uint16(middle) & 15) << 8 | np.uint16(last)


@dataclass(frozen=True, slots=True, kw_only=True)
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
    rate, step = (value_of("rate") or "").strip().replace(",", ""), (value_of("step") or "").strip()
    rate_hz = float(rate) if _RATE.fullmatch(rate) else 0.0
    every = int(step) if _COUNT.fullmatch(step) else 1
    side = value("effective side").lower()
    if side not in ("lower", "higher"):
        raise InputError(f"{path}: {_KEYS['effective side'][name]!r} must be Lower or Higher, got {side:.40}")
    white = 2**effective - 1
    # Levels of more than a byte keep two bytes, even if at most 8 bits are effective.
    low = Encoding(max(effective, min(bits, 9)), 0.0, white)
    encoding = low if side == "lower" else Encoding(bits, 0.0, white << (bits - effective))
    return Header(
        n_frames=count("frames"),
        height=height,
        width=width,
        bits=bits,
        encoding=encoding,
        frame_rate_hz=rate_hz / max(every, 1) or None,
    )
