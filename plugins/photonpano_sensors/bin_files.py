"""Sources of files without a header: packed frames in .bin files, addresses of lit pixels, and .dat files of spike cameras."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from itertools import accumulate
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from photonpano import (
    Arrived,
    Config,
    FrameSpan,
    InputError,
    Location,
    Recognised,
    SourceContribution,
    SpecLocation,
    SpecPath,
    Url,
)
from photonpano.photometry import IntensityResponse
from photonpano.reading import (
    BinarySource,
    FrameFile,
    FrameLayout,
    OpenFiles,
    PackedFileSource,
    as_written,
    files_in,
    objections,
    read_start,
    reading,
    size_of,
)

Pixels = TypeVar("Pixels", bound=np.generic)

_ZONES = 4
_FILE_BYTES = 512 * 256 * 64  # of 512 frames of the half array, or 256 of the full one
_SUMS = 8  # parts of a file whose frames are summed, to tell the half from the full array
_STRIP = 4  # columns beside a border of zones that are averaged
_CLIP_QUANTILE = 0.9  # brightness is clipped at this quantile: hot pixels must not outweigh the scene
_STANDARD_ERRORS = 5.0  # minimum difference of the two correlations
_SPAD512 = FrameLayout((512, 512), (512, 64))
_FOOTER_BYTES = 4
# Sizes by which a file is recognised. 256 frames without a footer have the size of files of SwissSPAD2.
_SPAD512_FILES = {
    1000 * _SPAD512.stored_bytes: "1000 frames",
    256 * _SPAD512.stored_bytes + _FOOTER_BYTES: "256 frames and a footer",
}
# Rows and columns of the cameras and simulators whose files are public.
_SHAPES = ((250, 400), (1000, 1000), (480, 640), (360, 640), (396, 640))
# The flux is spikes per pixel per frame. A pixel keeps the light that is left when it fires, so that spikes are proportional
# to the light. Their variance is taken to be their number, as of single photons, which is too large: that of a visit of many
# may be a fifth. In the dark, what is left at the ends of a visit counts: 1/6 spike squared, here in 200 frames.
RESPONSE = IntensityResponse(photons_per_level=1.0, black_level=0.0, saturation_level=1.0, read_noise=(1 / 6 / 200) ** 0.5)
_COMPARED_ROWS = 16  # frames at the beginning of a file that are compared to recognise its shape, at most
_SURE = 5.0  # standard errors by which the correlations of a shape exceed those of all others
_SIZE = 512
_PIXELS = _SIZE**2
_END = _PIXELS  # the address that ends a frame
_WORD = np.dtype("<u4")
_MOST_FRAMES = 32  # frames unpacked at once
_BLOCK_WORDS = 1024**2


class BinConfig(Config):
    """A capture in .bin files."""

    path: SpecLocation = Field(
        description="a .bin file, or a folder of them, or the URL of either; nested or not, in natural order (0, 2, 10)"
    )
    frame_rate_hz: float | None = Field(None, gt=0, description="frames a second, in Hz; leave it out if unknown")


def bin_source(
    name: str,
    summary: str,
    config: type[BinConfig],
    *,
    layout: FrameLayout,
    recognise: Callable[[Path], Recognised | None],
    footer_bytes: int = 0,
) -> SourceContribution:
    """Return the contribution of a source of .bin files; `footer_bytes` may follow the frames of a file."""

    def arrived(config: BinConfig) -> Arrived:
        """Open the frames that are there of a capture that is still being written: files appear, and the last one grows."""
        path = config.path
        if isinstance(path, Url):
            raise InputError(f"{path} is a URL, which cannot be followed: follow a folder, or a pipe")
        if not path.exists() or (path.is_dir() and not sizes_of(path)):
            return Arrived(None)
        files = frame_files(path, layout, footer_bytes, growing=True)
        return Arrived(PackedFileSource(files, layout, config.frame_rate_hz) if files else None)

    return SourceContribution(
        name=name,
        summary=summary,
        config=config,
        build=lambda config, _: PackedFileSource(frame_files(config.path, layout, footer_bytes), layout, config.frame_rate_hz),
        check=lambda config: objections(frame_files, config.path, layout, footer_bytes),
        recognise=recognise,
        arrived=arrived,
        suffixes=(".bin",),
    )


def frame_files(path: Location, layout: FrameLayout, footer_bytes: int = 0, *, growing: bool = False) -> list[FrameFile]:
    """Return the files of a capture with the number of frames that follows from their sizes.

    If it is `growing`, the last file counts with its whole frames. Raises an `InputError` if there is no file, a size is not a
    whole number of frames, or a file is larger than the first, or smaller and not the last: frames are missing, or the order is
    wrong.
    """
    files = files_in(path, ".bin")
    sizes = [size_of(file) for file in files]
    found = []
    for file, size in zip(files, sizes, strict=True):
        n_frames, rest = divmod(size, layout.stored_bytes)
        if growing and file is files[-1]:
            found += [FrameFile(file, n_frames)] if n_frames else []
            continue
        if not n_frames or rest not in (0, footer_bytes):
            allowed = f", with or without {footer_bytes} more" if footer_bytes else ""
            raise InputError(
                f"{file} has {size:,} bytes, which is not a whole number of frames of {layout.stored_bytes:,} bytes{allowed}; "
                "it is cut short, or of another camera: copy it again, or choose another source"
            )
        found.append(FrameFile(file, n_frames))
    for each in found[1:]:
        if each.n_frames > found[0].n_frames or (each.n_frames < found[0].n_frames and each is not found[-1]):
            raise InputError(
                f"{each.path} holds {each.n_frames:,} frames and {found[0].path.name}, the first, {found[0].n_frames:,}; only "
                "the last file of a capture may hold fewer: copy it again, or take out the files of other captures"
            )
    return found


def sizes_of(path: Location) -> list[int]:
    """Return the sizes in bytes of the .bin files at a path, in order; an empty list if there are none."""
    try:
        files = files_in(path, ".bin")
        return [size_of(file) for file in files if file.suffix.lower() == ".bin"]
    except (InputError, OSError):
        return []


class SwissSpadHalfConfig(BinConfig):
    """A capture of half of SwissSPAD2, 256 x 512 px."""


class SwissSpadFullConfig(BinConfig):
    """A capture of all of SwissSPAD2, 512 x 512 px."""


def _joined(images: NDArray[Pixels]) -> NDArray[Pixels]:
    """Join the zones of the full array: each holds a quarter of the columns of the top half, then of the bottom half.

    The bottom half is read out from the outside to the inside, as the top half is.
    """
    *lead, rows, columns = images.shape
    zones = images.reshape(*lead, rows, _ZONES, 2, columns // (2 * _ZONES))
    joined = np.empty((*lead, 2 * rows, columns // 2), images.dtype)
    halves = joined.reshape(*lead, 2, rows, _ZONES, columns // (2 * _ZONES))
    halves[..., 0, :, :, :] = zones[..., 0, :]
    halves[..., 1, :, :, :] = zones[..., ::-1, :, 1, :]
    return joined


HALF = FrameLayout((256, 512), (256, 64), "little")
FULL = FrameLayout((512, 512), (256, 128), "little", arranged=_joined)


def _recognise_swissspad(path: Path, array: Literal["half", "full"]) -> Recognised | None:
    sizes = sizes_of(path)
    if not sizes or {*sizes[:-1], max(sizes)} != {_FILE_BYTES}:  # the last may be shorter
        return None
    try:
        found, because = _array_of(files_in(path, ".bin")[0])
    except OSError:
        return None
    if found is not None and found != array:
        return None
    return Recognised({"path": str(path)}, f"files of {_FILE_BYTES:,} bytes, {because}")


def _array_of(path: Path) -> tuple[Literal["half", "full"] | None, str]:
    """Decide which array a file is of, by the correlation of pixels, and give the reason.

    A frame of the full array has the size of two frames of the half array. In a file of the half array, the two halves of these
    bytes are the same pixels at nearly the same time, which correlate most. In a file of the full array they are 128 rows
    apart, and pixels two rows apart correlate more. (Not one row, because odd and even rows may differ systematically.) Where
    that does not decide, as of a smooth scene, the sides of the borders between zones do: in the wrong layout they are 128
    columns apart, in sums of few frames, which motion does not blur as much.
    """
    frames = np.memmap(path, np.uint8, "r").reshape(_SUMS, -1, *FULL.stored_shape)
    parts = np.stack([np.unpackbits(each, axis=-1, bitorder="little").sum(axis=0, dtype=np.float64) for each in frames])
    sums = parts.sum(axis=0)
    first, second = np.split(np.minimum(sums, np.quantile(sums, _CLIP_QUANTILE)), 2)
    blocks = np.minimum(parts, np.quantile(parts, _CLIP_QUANTILE)).reshape(*parts.shape[:2], 2 * _ZONES, -1)
    right, left = (side.mean(axis=-1) for side in (blocks[..., -_STRIP:], blocks[..., :_STRIP]))
    inside = [0, 1, 2, 4, 5, 6]  # blocks of 128 columns that do not end a row of the half array
    tests = {
        "between the halves of their frames, {:.2f} between rows": (
            (first, second),
            (np.stack([first[:-2], second[:-2]]), np.stack([first[2:], second[2:]])),
        ),
        "across zones in the layout of the half array, {:.2f} in that of the full one": (
            (right[..., inside], left[..., [1 + block for block in inside]]),
            (right[..., :-2], left[..., 2:]),
        ),
    }
    for words, (of_half, of_full) in tests.items():
        half, full = correlation(*of_half), correlation(*of_full)
        numbers = f"correlations of {np.tanh(half):.2f} {words.format(np.tanh(full))}"
        if abs(half - full) >= _STANDARD_ERRORS * np.sqrt(2 / of_half[0].size):
            return ("half" if half > full else "full"), numbers
    return None, f"which the half and the full array have; {numbers} do not decide it"


def correlation(first: NDArray[Any], second: NDArray[Any]) -> float:
    """Return the Fisher transform of the correlation, whose standard error is 1 / sqrt(pixels); 0 if one does not vary."""
    if not first.size or not first.std() or not second.std():
        return 0.0
    return float(np.arctanh(min(np.corrcoef(first.ravel(), second.ravel())[0, 1], 0.999999)))


SWISSSPAD_HALF = bin_source(
    "swissspad-half",
    "Binary frames of half of SwissSPAD2, 256 x 512 px, in .bin files of 512",
    SwissSpadHalfConfig,
    layout=HALF,
    recognise=lambda path: _recognise_swissspad(path, "half"),
)
SWISSSPAD_FULL = bin_source(
    "swissspad-full",
    "Binary frames of all of SwissSPAD2, 512 x 512 px, in .bin files of 256",
    SwissSpadFullConfig,
    layout=FULL,
    recognise=lambda path: _recognise_swissspad(path, "full"),
)


class Spad512Config(BinConfig):
    """A capture of the SPAD512, 512 x 512 px."""


def _recognise_spad512(path: Path) -> Recognised | None:
    sizes = sizes_of(path)
    if not sizes or sizes[0] not in _SPAD512_FILES or objections(frame_files, path, _SPAD512, _FOOTER_BYTES):
        return None
    return Recognised({"path": str(path)}, f"{sizes[0]:,} bytes a file, which are {_SPAD512_FILES[sizes[0]]} of 512 x 512 px")


SPAD512 = bin_source(
    "spad512",
    "Binary frames of the SPAD512, 512 x 512 px, in .bin files of 1000, or of 256 with a footer",
    Spad512Config,
    layout=_SPAD512,
    recognise=_recognise_spad512,
    footer_bytes=_FOOTER_BYTES,
)


class SpikeDatConfig(Config):
    """Frames one after the other: a bit for each pixel, the lowest bit of a byte first, without gaps between rows or frames."""

    path: SpecLocation = Field(description="the .dat file, or its URL")
    frame_shape: tuple[int, int] = Field(description="rows and columns of a frame, in px, such as [250, 400]")
    frame_rate_hz: float | None = Field(None, gt=0, description="frames a second, in Hz; leave it out if unknown")

    @field_validator("frame_shape")
    @classmethod
    def _whole_bytes(cls, shape: tuple[int, int]) -> tuple[int, int]:
        if min(shape) < 1 or max(shape) > 65535 or shape[0] * shape[1] % 8:
            raise ValueError("rows and columns are from 1 to 65535, and a frame has a multiple of eight pixels")
        return shape


def layout_of(shape: tuple[int, int]) -> FrameLayout:
    """Return the layout of frames of (rows, columns); rows that are no whole bytes are repacked."""
    n_rows, n_columns = shape

    def to_rows(stored: NDArray[np.uint8]) -> NDArray[np.uint8]:
        pixels = np.unpackbits(stored, axis=1, bitorder="little").reshape(-1, n_rows, n_columns)
        return np.packbits(pixels, axis=2, bitorder="little")

    if n_columns % 8:
        return FrameLayout(shape, (n_rows * n_columns // 8,), "little", to_rows=to_rows)
    return FrameLayout(shape, (n_rows, n_columns // 8), "little")


def _open(config: SpikeDatConfig) -> PackedFileSource:
    """Open a capture; raises an `InputError` if it is missing, or its size is no whole number of frames."""
    size, frame_bytes = size_of(config.path), layout_of(config.frame_shape).stored_bytes
    n_frames, rest = divmod(size, frame_bytes)
    if n_frames and not rest:
        return _source(config, n_frames)
    shape, fitting = "x".join(map(str, config.frame_shape)), [f"[{h}, {w}]" for h, w in _fitting(size)]
    known = f"of the usual shapes, {' and '.join(fitting)} would fit" if fitting else "none of the usual shapes would fit"
    raise InputError(
        f"{config.path} has {size:,} bytes, and a frame of {shape} px takes {frame_bytes:,}: after {n_frames:,} frames, "
        f"{rest:,} bytes are left over; {known}: correct frame_shape, or copy the file again"
    )


def _source(config: SpikeDatConfig, n_frames: int) -> PackedFileSource:
    source = PackedFileSource([FrameFile(config.path, n_frames)], layout_of(config.frame_shape), config.frame_rate_hz)
    source.response = RESPONSE
    return source


def _arrived(config: SpikeDatConfig) -> Arrived:
    """Open the frames that are there of a file that is still being written."""
    path = config.path
    if isinstance(path, Url):
        raise InputError(f"{path} is a URL, which cannot be followed: follow a file, or a pipe")
    n_frames = size_of(path) // layout_of(config.frame_shape).stored_bytes if path.exists() else 0
    return Arrived(_source(config, n_frames) if n_frames else None)


def _fitting(size: int) -> Iterator[tuple[int, int]]:
    """Yield the usual shapes of which a file holds whole frames."""
    return (shape for shape in _SHAPES if size and size % layout_of(shape).stored_bytes == 0)


def _recognise_spikes(path: Location) -> Recognised | None:
    """Take a .dat file if neighbouring rows, and earlier and later frames, are most alike in one of the usual shapes."""
    if isinstance(path, Url) or path.suffix.lower() != ".dat" or not path.is_file():
        return None
    found = sorted(((_likeness(path, shape), shape) for shape in _fitting(size_of(path))), reverse=True)
    if not found or found[0][0] - max([0.0, *(score for score, _ in found[1:])]) < _SURE:
        return None
    shape = found[0][1]
    because = f"a .dat file of whole frames of {shape[0]}x{shape[1]} px, in which neighbouring rows and frames are alike"
    return Recognised({"path": as_written(path), "frame_shape": list(shape)}, because)


def _likeness(path: Location, shape: tuple[int, int]) -> float:
    """Return the smaller correlation, of neighbouring rows or of neighbouring frames, in standard errors."""
    layout = layout_of(shape)
    start = np.frombuffer(read_start(path, _COMPARED_ROWS * layout.stored_bytes), np.uint8)
    frames = layout.unpacked(layout.rows(start.reshape(-1, *layout.stored_shape)))
    total = frames.sum(axis=0, dtype=np.float32)
    neighbours = (total[1:], total[:-1]), (frames[1:], frames[:-1])
    return min(correlation(first, second) * math.sqrt(first.size) for first, second in neighbours)


SPIKE_DAT = SourceContribution(
    name="spike-dat",
    summary="Binary frames of a spike camera in a .dat file, as SpikeCV and Spike-Zoo read it",
    config=SpikeDatConfig,
    build=lambda config, _: _open(config),
    check=lambda config: objections(_open, config),
    recognise=_recognise_spikes,
    arrived=_arrived,
    suffixes=(".dat",),
)


class Spad512SparseConfig(Config):
    """A sparse capture of the SPAD512, 512 x 512 px. It is read once when it is opened, to find its frames."""

    path: SpecPath = Field(
        description="a file with addresses of lit pixels, or a folder of such .bin files, nested or not, in natural order"
    )
    frame_rate_hz: float | None = Field(None, gt=0, description="frames a second, in Hz; leave it out if unknown")


class Spad512SparseSource(BinarySource):
    """Little-endian uint32 addresses, 512 y + x, of lit pixels; 512 x 512 ends a frame."""

    def __init__(self, config: Spad512SparseConfig) -> None:
        self._paths, self._read = _files(config.path), OpenFiles()
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
                self._read.read(path, int(begin) * _WORD.itemsize, words.view(np.uint8))
                at = slice(offset + first - span.start, offset + stop - span.start)
                yield at, _places(words)

    def close(self) -> None:
        """Close the files."""
        self._read.close()


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


def _recognise_sparse(path: Path) -> Recognised | None:
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
    recognise=_recognise_sparse,
    suffixes=(".bin",),
)
