"""Source `image-folder`: a picture for each frame, or a TIFF file with a page for each frame."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from pathlib import Path
from threading import Lock
from typing import NamedTuple, Protocol

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from photonpano import FrameSpan, InputError
from photonpano.reading import missing_file, read_picture, reading
from photonpano_sensors.intensity.configs import ImageFolderConfig
from photonpano_sensors.intensity.levels import Encoding
from photonpano_sensors.intensity.recognition import pictures_in
from photonpano_sensors.intensity.source import IntensitySource, Levels

Image = NDArray[np.generic]

_PNG = b"\x89PNG\r\n\x1a\n"
_PNG_COLOURS = {2: "colours", 3: "a palette", 4: "transparency", 6: "colours"}
"""The colour types of PNG other than grey."""
_DAMAGED = (tifffile.TiffFileError, OSError, ValueError, KeyError, IndexError, struct.error)
"""Errors that tifffile raises for damaged files."""


class _Form(NamedTuple):
    """Size and bits, which all frames of a capture share."""

    height: int
    width: int
    bits: int

    def __str__(self) -> str:
        return f"{self.height}x{self.width} pixels of {self.bits} bits"


class _Pictures(Protocol):
    """Frames that are pictures.

    Attributes:
        n_frames: number of frames.
        form: size and bits of each.
    """

    n_frames: int
    form: _Form

    def read(self, index: int) -> Image:
        """Return a frame: (H, W)."""
        ...

    def close(self) -> None:
        """Close files."""
        ...


class ImageFolderSource(IntensitySource):
    """Pictures of grey levels of 8 or 16 bits.

    Raises:
        InputError: there is no picture, one cannot be read or is not grey, or pictures differ in size or bits.
    """

    def __init__(self, config: ImageFolderConfig) -> None:
        self._pictures: _Pictures = _Folder(config.path) if config.path.is_dir() else _Pages(config.path)
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
    """A file for each frame."""

    def __init__(self, path: Path) -> None:
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
            self.n_frames = len(self._file.pages)
            self.form = _common((f"page {k} of {path}", _form_of_page(path, page)) for k, page in enumerate(self._file.pages))
        except _DAMAGED as error:
            self.close()
            raise InputError(f"{path} is damaged: {error}; copy it again") from error
        except InputError:
            self.close()
            raise

    def read(self, index: int) -> Image:
        try:
            with self._lock:
                return np.asarray(self._file.pages[index].asarray())
        except _DAMAGED as error:
            raise InputError(f"page {index} of {self._path} cannot be read: {error}") from error

    def close(self) -> None:
        self._file.close()


def _common(forms: Iterable[tuple[str, _Form]]) -> _Form:
    """Return the form that all frames have.

    Raises:
        InputError: the frames differ.
    """
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
        with _tiff(file) as tiff:
            try:
                if len(tiff.pages) > 1:
                    raise InputError(f"{file} has {len(tiff.pages)} pages; name the file itself if each is a frame")
                return _form_of_page(file, tiff.pages[0])
            except _DAMAGED as error:
                raise InputError(f"{file} is damaged: {error}; copy it again") from error
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
    if form.bits not in (8, 16):
        raise InputError(f"{file} has {form}; convert the frames to 8 or 16 bits")
    return form


def _tiff(path: Path) -> tifffile.TiffFile:
    try:
        return tifffile.TiffFile(path)
    except FileNotFoundError as error:
        raise InputError(missing_file(path)) from error
    except _DAMAGED as error:
        raise InputError(f"{path} is neither a folder nor a TIFF file that can be read: {error}") from error
