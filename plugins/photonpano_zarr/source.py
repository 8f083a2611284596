"""Open a zarr array of packed binary frames, and write one."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonpano import FrameSpan, InputError, Location, Source, StreamInfo, Url
from photonpano.reading import (
    BinarySource,
    FrameFile,
    FrameLayout,
    PackedFileSource,
    Pieces,
    library,
    other_order,
    read_range,
    reading,
    sampled_spans,
    unpacked_content,
)
from photonpano_zarr.configs import ZarrConfig
from photonpano_zarr.metadata import Metadata, read_attributes, read_metadata, written

_MOST_BYTES = 2 * 1024**3  # the largest chunk that is read: a larger one is a mistake, or damage
_CHUNK_BYTES = 4 * 1024**2  # most bytes of a chunk before compression that is written, unless a frame has more
_LEVEL = 1  # of zstd: higher ones take longer, and gain little on photon noise


def opened(config: ZarrConfig) -> Source:
    """Open an array; raises an `InputError` if it is missing, incomplete, something else, or does not agree with the config."""
    array, (metadata, layout, frame_rate_hz) = config.path, read_layout(config)
    if metadata.compressors or not metadata.has_whole_frames:
        return _Chunks(array, metadata, layout, frame_rate_hz)
    # Without compression, a chunk is a file of frames.
    step, n_frames = metadata.chunk_shape[0], metadata.shape[0]
    files = [
        FrameFile(metadata.chunk(array, index), min(step, n_frames - index * step))
        for index in range(metadata.chunks_of_frames)
    ]
    return PackedFileSource(files, layout, frame_rate_hz)


def read_layout(config: ZarrConfig) -> tuple[Metadata, FrameLayout, float | None]:
    """Return the metadata of an array, the layout of its frames, and their rate in Hz; raises as `opened`."""
    array, metadata = config.path, read_metadata(config.path)
    own = read_attributes(array, metadata)
    _, height, row_bytes = metadata.shape
    width = config.width or (own.width if own else 8 * row_bytes)
    if -(-width // 8) != row_bytes:
        remedy = "correct the width" if config.width else "write the right width in the spec"
        raise InputError(
            f"{array} has rows of {row_bytes} bytes, which hold a width of {8 * row_bytes - 7} to {8 * row_bytes}, not "
            f"{width}; {remedy}"
        )
    _require_whole(array, metadata)
    layout = FrameLayout((height, width), (height, row_bytes), config.bit_order or (own.bit_order if own else "big"))
    return metadata, layout, config.frame_rate_hz or (own.frame_rate_hz if own else None)


def require_layout(config: ZarrConfig) -> None:
    """Refuse an array that `opened` refuses, or that others wrote and whose frames show that they are packed in another way."""
    array, (metadata, _, _) = config.path, read_layout(config)
    if config.bit_order is not None or read_attributes(array, metadata) is not None:
        return
    with opened(config) as source:
        assert isinstance(source, BinarySource)
        spans = sampled_spans(source.info.n_frames, metadata.shape[1] * metadata.shape[2])
        samples = [source.packed(span) for span in spans]
    if content := unpacked_content(samples):
        raise InputError(
            f"{array} is not packed: its values are {'0 and ' if content.holds == 'bits' else 'sums up to '}{content.highest}; "
            "pack frames of zeros and ones with numpy.packbits(cube, axis=-1)"
        )
    if other := other_order(samples):
        along_width = other.order.packed_along == "width"
        remedy = f"write bit_order: {other.order.bit_order}" if along_width else "pack frames along the width"
        raise InputError(f"{array} is packed in another order: {other}; {remedy}, or write bit_order: big if it is right")


def _require_whole(array: Location, metadata: Metadata) -> None:
    """Refuse an array in a folder that lacks a chunk. Zarr itself would give zeros for it."""
    if isinstance(array, Url):
        return
    sizes = None if metadata.compressors else int(np.prod(metadata.chunk_shape))
    for index in range(metadata.chunks_of_frames):
        for tile in metadata.tiles():
            path = metadata.chunk(array, index, *tile)
            assert isinstance(path, Path)
            try:
                size = path.stat().st_size
            except OSError as error:
                raise InputError(
                    f"{array} is incomplete: there is no chunk {path.relative_to(array)}; copy it again, or write it with all "
                    "chunks (write_empty_chunks)"
                ) from error
            if sizes not in (None, size):
                raise InputError(f"{path} has {size:,} bytes, and a chunk has {sizes:,}; copy the array again")


class _Chunks(BinarySource):
    """Frames in chunks that are compressed, or contain parts of frames. A chunk is read whole, and the last ones are kept."""

    def __init__(self, array: Location, metadata: Metadata, layout: FrameLayout, frame_rate_hz: float | None) -> None:
        super().__init__(metadata.shape[0], layout, frame_rate_hz)
        self._array, self._metadata = array, metadata
        self._decoders = [_decoder(array, codec.name) for codec in reversed(metadata.compressors)]
        starts = range(0, metadata.shape[0], metadata.chunk_shape[0])
        self._pieces = Pieces([*starts, metadata.shape[0]], self._frames, in_parts=False)

    def pieces(self, span: FrameSpan) -> Iterator[tuple[slice, NDArray[np.uint8]]]:
        """Yield the frames of a span, chunk by chunk: see `BinarySource`."""
        return self._pieces.of(span)

    def _frames(self, span: FrameSpan) -> NDArray[np.uint8]:
        """Return the frames of one chunk along the axis of the frames: (n, rows, bytes of a row)."""
        index, (_, height, width) = span.start // self._metadata.chunk_shape[0], self._metadata.chunk_shape
        if self._metadata.has_whole_frames:
            return self._chunk(index)[: len(span)]
        frames = np.empty((len(span), *self._metadata.shape[1:]), np.uint8)
        for row, column in self._metadata.tiles():
            part = frames[:, row * height : (row + 1) * height, column * width : (column + 1) * width]
            part[...] = self._chunk(index, row, column)[: part.shape[0], : part.shape[1], : part.shape[2]]
        return frames

    def _chunk(self, *place: int) -> NDArray[np.uint8]:
        path, shape = self._metadata.chunk(self._array, *place), self._metadata.chunk_shape
        data: Any
        if isinstance(path, Url):
            data = read_range(path, 0, _MOST_BYTES)
        else:
            with reading(path):
                data = path.read_bytes()
        try:
            for decode in self._decoders:
                data = decode(data)
            return np.frombuffer(data, np.uint8).reshape(shape)
        except Exception as error:  # codecs raise nearly anything for damaged data
            raise InputError(f"{path} is damaged: it cannot be decompressed to a chunk of {shape}; copy it again") from error

    def close(self) -> None:
        super().close()
        self._pieces.close()


def _decoder(array: Location, name: str) -> Any:
    """Return a function that takes back what a codec did to bytes, which contain its settings."""
    if name == "gzip":
        return lambda data: zlib.decompress(data, wbits=31)
    if name == "crc32c":
        return lambda data: memoryview(data)[:-4]  # without the checksum, which no small library computes
    library("numcodecs", "photonpano[zarr]", f"{array}, compressed with {name},")
    import numcodecs.blosc
    import numcodecs.zstd

    return numcodecs.blosc.Blosc().decode if name == "blosc" else numcodecs.zstd.Zstd().decode


def write(folder: Path, info: StreamInfo, frames: Iterable[NDArray[np.uint8]], *, compressed: bool) -> None:
    """Write an array of version 3 into an empty folder; the metadata come last.

    `frames` are packed, in order, a few at a time: (n, height, bytes of a row). They are `compressed` with zstd, for which
    numcodecs must be installed, or an `InputError` is raised.
    """
    frame_shape = info.height, -(-info.width // 8)
    n_frames = min(info.n_frames, max(1, _CHUNK_BYTES // math.prod(frame_shape)))
    codecs = [{"name": "zstd", "configuration": {"level": _LEVEL, "checksum": True}}] if compressed else []
    metadata = written(info, n_frames, codecs)
    encode: Any = bytes
    if compressed:
        library("numcodecs", "photonpano[zarr]", f"compressing {folder.name}")
        import numcodecs.zstd

        encode = numcodecs.zstd.Zstd(level=_LEVEL, checksum=True).encode
    for index, chunk in enumerate(_filled(frames, n_frames, frame_shape)):
        path = metadata.chunk(folder, index)
        assert isinstance(path, Path)
        path.write_bytes(encode(chunk))
    (folder / "zarr.json").write_text(metadata.model_dump_json(indent=2), encoding="utf-8")


def _filled(frames: Iterable[NDArray[np.uint8]], n_frames: int, frame_shape: tuple[int, int]) -> Iterator[NDArray[np.uint8]]:
    """Yield whole chunks; the last one is filled up with zeros, as zarr stores it."""
    chunk, filled = np.zeros((n_frames, *frame_shape), np.uint8), 0
    for block in frames:
        taken = 0
        while taken < len(block):
            n = min(n_frames - filled, len(block) - taken)
            chunk[filled : filled + n] = block[taken : taken + n]
            filled, taken = filled + n, taken + n
            if filled == n_frames:
                yield chunk
                filled = 0
    if filled:
        chunk[filled:] = 0
        yield chunk
