"""Source `spad512-sparse`: addresses of lit pixels, a compact format for dark scenes."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import accumulate
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from photonpano import Config, FrameSpan, InputError, Recognised, SourceContribution, SpecPath
from photonpano.reading import BinarySource, FrameLayout, files_in, objections, read_start, reading

_SIZE = 512
_PIXELS = _SIZE**2
_END = _PIXELS  # the address that ends a frame
_WORD = np.dtype("<u4")
_MOST_FRAMES = 32  # frames unpacked at once
_BLOCK_WORDS = 1024**2


class Spad512SparseConfig(Config):
    """A sparse capture of the SPAD512, 512 x 512 px. It is read once when it is opened, to find its frames."""

    path: SpecPath = Field(
        description="a file with addresses of lit pixels, or a folder of such .bin files, nested or not, in natural order"
    )
    frame_rate_hz: float | None = Field(None, gt=0, description="frames a second, in Hz; leave it out if unknown")


class Spad512SparseSource(BinarySource):
    """Little-endian uint32 addresses, 512 y + x, of lit pixels; 512 x 512 ends a frame."""

    def __init__(self, config: Spad512SparseConfig) -> None:
        self._paths = _files(config.path)
        self._ends = [_frame_ends(path) for path in self._paths]
        self._starts = list(accumulate(map(len, self._ends), initial=0))
        super().__init__(self._starts[-1], FrameLayout((_SIZE, _SIZE), (_SIZE, _SIZE // 8)), config.frame_rate_hz)

    def counts(self, span: FrameSpan) -> NDArray[np.uint32]:
        """Sum the frames of a span: (H, W) uint32."""
        self.info.require(span)
        counts = np.zeros(_PIXELS, np.uint32)
        for _, lit in self._lit(span):
            counts += np.bincount(lit % _PIXELS, minlength=_PIXELS).astype(np.uint32)
        return counts.reshape(_SIZE, _SIZE)

    def pieces(self, span: FrameSpan) -> Iterator[tuple[slice, NDArray[np.uint8]]]:
        """Yield the frames of a span, a few at a time: see `BinarySource`."""
        for place, lit in self._lit(span):
            frames = np.zeros((place.stop - place.start) * _PIXELS, np.uint8)
            frames[lit] = 1
            yield place, np.packbits(frames).reshape(-1, _SIZE, _SIZE // 8)

    def _lit(self, span: FrameSpan) -> Iterator[tuple[slice, NDArray[np.int64]]]:
        """Yield the place of some frames in the span, and the indices of their lit pixels in (n, H, W), each once."""
        for path, ends, offset in zip(self._paths, self._ends, self._starts, strict=False):
            for first in range(max(0, span.start - offset), min(len(ends), span.stop - offset), _MOST_FRAMES):
                stop = min(first + _MOST_FRAMES, len(ends), span.stop - offset)
                begin = ends[first - 1] if first else 0
                words = np.empty(int(ends[stop - 1] - begin), _WORD)
                self.files.read(path, int(begin) * _WORD.itemsize, words.view(np.uint8))
                at = slice(offset + first - span.start, offset + stop - span.start)
                yield at, _places(words)


def _places(words: NDArray[np.uint32]) -> NDArray[np.int64]:
    """Return the indices of lit pixels in (n, H, W), from addresses that end with an `_END`."""
    end = words == _END
    places = (np.cumsum(end) * _PIXELS + words)[~end]
    # A pixel that is listed twice in a frame is lit once.
    return places if np.all(np.diff(places) > 0) else np.unique(places)


def _files(path: Path) -> list[Path]:
    """Return the files of a capture, once their sizes and last words are checked."""
    files = files_in(path, ".bin")
    for file in files:
        size = file.stat().st_size
        if not size or size % _WORD.itemsize or _words(file, size // _WORD.itemsize - 1)[0] != _END:
            raise InputError(
                f"{file} does not end with the end of a frame, the uint32 {_END}; it is cut short, or not sparse: copy it "
                "again, or choose another source"
            )
    return files


def _words(path: Path, start: int, n_words: int = 1) -> NDArray[np.uint32]:
    with reading(path):
        return np.fromfile(path, _WORD, n_words, offset=start * _WORD.itemsize)


def _frame_ends(path: Path) -> NDArray[np.int64]:
    """Return the number of words of a file up to the end of each frame."""
    found, start = [], 0
    while len(words := _words(path, start, _BLOCK_WORDS)):
        if words.max() > _END:
            place = int(np.argmax(words > _END))
            raise InputError(
                f"{path} names the pixel {words[place]} at byte {(start + place) * _WORD.itemsize:,}, and the last of a frame "
                f"is {_PIXELS - 1}; it is damaged, or not sparse: copy it again, or choose another source"
            )
        found.append(start + np.flatnonzero(words == _END) + 1)
        start += len(words)
    return np.concatenate(found)


def _recognise(path: Path) -> Recognised | None:
    try:
        files = _files(path)
    except InputError:
        return None
    start = np.frombuffer(read_start(files[0], _WORD.itemsize), _WORD)
    if files[0].suffix.lower() != ".bin" or start[0] > _END:
        return None
    return Recognised({"path": str(path)}, f"its last four bytes are the {_END} that ends a frame of addresses")


SPAD512_SPARSE = SourceContribution(
    name="spad512-sparse",
    summary="Binary frames of the SPAD512, 512 x 512 px, as the addresses of their lit pixels",
    config=Spad512SparseConfig,
    build=lambda config, _: Spad512SparseSource(config),
    check=lambda config: objections(_files, config.path),
    recognise=_recognise,
    suffixes=(".bin",),
)
