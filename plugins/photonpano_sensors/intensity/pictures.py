"""Source `image-folder`: a picture for each frame, or a TIFF file with a page for each frame."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from pathlib import Path
from threading import Lock
from typing import NamedTuple

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from photonpano import FrameSpan, InputError
from photonpano.reading import read_picture, reading, require_readable
from photonpano_sensors.intensity.contributions import ImageFolderConfig, pictures_in
from photonpano_sensors.intensity.source import Encoding, IntensitySource, Levels

Image = NDArray[np.generic]

_PNG = b"\x89PNG\r\n\x1a\n"
_PNG_COLOURS = {2: "colours", 3: "a palette", 4: "transparency", 6: "colours"}  # colour types other than grey
# bytes that a byte of a file may unpack to: 1,032 in PNG, more in other formats, for black frames
_MOST_SQUEEZED = 4096
_DAMAGED = "is damaged: it is not a TIFF file that can be read; copy it again"


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
        return levels

    def close(self) -> None:
        """Do nothing: no file stays open."""


class _Pages:
    """A page of a TIFF file for each frame."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = Lock()
        self._file = _tiff(path)
        try:
            with reading(path, _DAMAGED):
                self.n_frames = len(self._file.pages)
                pages = enumerate(self._file.pages)
                self.form = _common((f"page {number} of {path}", _form_of_page(path, page)) for number, page in pages)
        except BaseException:
            self.close()
            raise

    def read(self, index: int) -> Image:
        with reading(self._path, f"is damaged: page {index} cannot be read; copy it again"), self._lock:
            levels = np.asarray(self._file.pages[index].asarray())
        if levels.shape != self.form[:2] or 8 * levels.itemsize != self.form.bits:
            raise InputError(
                f"{self._path} is damaged: page {index} is not of {self.form}, as its header promises; copy it again"
            )
        return levels

    def close(self) -> None:
        self._file.close()


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


def _is_png(file: Path) -> bool:
    return file.suffix.lower() == ".png"


def _form_of(file: Path) -> _Form:
    """Return the form of a picture from its header."""
    if not _is_png(file):
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
