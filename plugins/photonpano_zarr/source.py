"""Open a zarr array of packed binary frames, and write one: its file `zarr.json`, and its chunks."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

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

_VERSION = 1  # of the attributes
_FILE = "zarr.json"
_MOST_METADATA_BYTES = 1024**2  # the longest metadata that are read
_CODECS = ("bytes", "zstd", "blosc", "gzip", "crc32c")
_BITS = "write holds: bits"
_CHECKED = 16  # frames whose values are checked before a run
_AGAIN = "write it again with photonpano convert"


class _Attributes(BaseModel):
    """Description of the capture in an array, so that it opens without further keys."""

    model_config = ConfigDict(frozen=True)

    version: int = _VERSION  # the version of these attributes
    kind: Literal["binary"] = "binary"  # kind of frames; others than binary ones are not written yet
    width: int = Field(ge=1)  # columns of a frame, in px
    bit_order: Literal["big", "little"] = "big"  # "big" if the first of eight pixels is the highest bit of its byte
    frame_rate_hz: float | None = Field(None, gt=0)  # frames a second, in Hz; None if unknown


class _Named(BaseModel):
    name: str
    configuration: dict[str, Any] = {}


class _Metadata(BaseModel):
    """The metadata of an array of zarr version 3 that captures need."""

    zarr_format: Literal[3]
    node_type: Literal["array"]
    shape: tuple[int, ...]  # frames, height, bytes of a row
    data_type: Any
    chunk_grid: _Named  # how it is cut into chunks
    chunk_key_encoding: _Named  # how the chunks are named
    fill_value: Any = 0
    codecs: tuple[_Named, ...]  # how the bytes of a chunk are stored, in the order of writing
    attributes: dict[str, Any] = {}  # added by the writer

    @property
    def chunk_shape(self) -> tuple[int, int, int]:
        """Frames, rows and bytes of a row in a chunk; the last chunk is stored whole, too."""
        frames, rows, columns = self.chunk_grid.configuration["chunk_shape"]
        return frames, rows, columns

    @property
    def compressors(self) -> tuple[_Named, ...]:
        """The codecs after the first, which only lays out the bytes."""
        return self.codecs[1:]

    @property
    def has_whole_frames(self) -> bool:
        """Whether a chunk contains whole frames."""
        return self.chunk_shape[1:] == self.shape[1:]

    @property
    def chunks_of_frames(self) -> int:
        """Chunks along the axis of the frames."""
        return math.ceil(self.shape[0] / self.chunk_shape[0])

    def tiles(self) -> list[tuple[int, int]]:
        """Return the places of the chunks of a frame: rows and columns of the grid."""
        sizes = zip(self.shape[1:], self.chunk_shape[1:], strict=True)
        down, across = (range(math.ceil(size / chunk)) for size, chunk in sizes)
        return list(product(down, across))

    def chunk(self, array: Location, frames: int, row: int = 0, column: int = 0) -> Location:
        """Return where a chunk is."""
        default = self.chunk_key_encoding.name == "default"
        separator = self.chunk_key_encoding.configuration.get("separator", "/" if default else ".")
        key = separator.join(map(str, (frames, row, column)))
        return array / (f"c{separator}{key}" if default else key)


def _written(info: StreamInfo, frames_of_chunk: int, compressors: Sequence[Mapping[str, Any]]) -> _Metadata:
    """Describe an array of packed frames."""
    shape = info.n_frames, info.height, -(-info.width // 8)
    attributes = _Attributes(width=info.width, frame_rate_hz=info.frame_rate_hz)
    return _Metadata(
        zarr_format=3,
        node_type="array",
        shape=shape,
        data_type="uint8",
        chunk_grid=_Named(name="regular", configuration={"chunk_shape": [frames_of_chunk, *shape[1:]]}),
        # All chunks lie in one folder.
        chunk_key_encoding=_Named(name="default", configuration={"separator": "."}),
        codecs=(_Named(name="bytes"), *map(_Named.model_validate, compressors)),
        attributes={"photonpano": attributes.model_dump()},
    )


def _read_metadata(array: Location) -> _Metadata:
    """Read the metadata of an array of packed frames; raises an `InputError` if there are none, or of something else."""
    text = _read(array)
    try:
        found = _Metadata.model_validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        if first["loc"] == ("node_type",):
            raise InputError(f"{array} is a zarr group, not an array; name the array in it{_members(array)}") from error
        where = ".".join(map(str, first["loc"])) or "its JSON"
        raise InputError(f"{array / _FILE} is wrong at {where}: {first['msg']}; {_AGAIN}, or copy it again") from error
    _require_frames(array, found)
    return found


def _read_attributes(array: Location, metadata: _Metadata) -> _Attributes | None:
    """Return the attributes of photonpano in an array, if any; raises an `InputError` if they are newer or damaged."""
    own = metadata.attributes.get("photonpano")
    if own is None:
        return None
    version = own.get("version") if isinstance(own, dict) else None
    if isinstance(version, int) and version > _VERSION:
        raise InputError(f"{array} was written by a newer photonpano, as version {version}; update this one")
    try:
        return _Attributes.model_validate(own)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(("attributes.photonpano", *map(str, first["loc"])))
        raise InputError(f"{array / _FILE} is wrong at {where}: {first['msg']}; correct it, or {_AGAIN}") from error


def _read(array: Location) -> bytes:
    if isinstance(array, Url):
        try:
            return read_range(array / _FILE, 0, _MOST_METADATA_BYTES)
        except InputError as error:
            if _has(array / ".zarray"):
                raise _old(array) from error
            raise
    if not array.exists():
        raise InputError(f"there is no folder {array}; check the path")
    if not (array / _FILE).exists():
        if (array / ".zarray").exists() or (array / ".zgroup").exists():
            raise _old(array)
        raise InputError(f"{array} is no zarr array: there is no {_FILE} in it; name the folder of an array")
    with reading(array / _FILE), (array / _FILE).open("rb") as file:
        return file.read(_MOST_METADATA_BYTES)


def _has(url: Url) -> bool:
    try:
        read_range(url, 0, 1)
    except InputError:
        return False
    return True


def _old(array: Location) -> InputError:
    return InputError(f"{array} is zarr version 2, and captures are version 3; convert it with: zarr migrate v3 {array}")


def _members(array: Location) -> str:
    if isinstance(array, Url):
        return ""
    names = sorted(path.parent.name for path in array.glob(f"*/{_FILE}"))
    return f": {', '.join(names[:5])}" if names else ""


def _require_frames(array: Location, found: _Metadata) -> None:
    shape, layout = found.shape, "a capture is uint8 (frames, height, bytes of a row), as from numpy.packbits(cube, axis=-1)"
    if found.data_type not in ("uint8", "bool"):
        raise InputError(f"{array} holds {found.data_type} values, not bytes of eight pixels; {layout}")
    if len(shape) != 3:
        raise InputError(f"{array} has the shape {shape}; {layout}")
    if min(shape) < 1:
        raise InputError(f"{array} is empty: its shape is {shape}")
    codecs = [codec.name for codec in found.codecs]
    if found.chunk_grid.name != "regular" or codecs[:1] != ["bytes"] or not set(codecs) <= {*_CODECS}:
        known = f"regular chunks with the codecs {', '.join(_CODECS)}"
        raise InputError(
            f"{array} has chunks that are {found.chunk_grid.name}, with the codecs {', '.join(codecs)}; captures are read from "
            f"{known}: write it again without others, such as shards"
        )
    chunk = found.chunk_grid.configuration.get("chunk_shape")
    if not isinstance(chunk, list) or len(chunk) != 3 or not all(type(size) is int and size > 0 for size in chunk):
        raise InputError(f"{array / _FILE} is wrong at chunk_grid: expected three sizes of a chunk; {_AGAIN}, or copy it again")


_MOST_BYTES = 2 * 1024**3  # the largest chunk that is read: a larger one is a mistake, or damage
_CHUNK_BYTES = 4 * 1024**2  # most bytes of a chunk before compression that is written, unless a frame has more
_LEVEL = 1  # of zstd: higher ones take longer, and gain little on photon noise


def opened(config: ZarrConfig) -> Source:
    """Open an array; raises an `InputError` if it is missing, incomplete, something else, or does not agree with the config."""
    array, (metadata, layout, frame_rate_hz) = config.path, _read_layout(config)
    if metadata.compressors or not metadata.has_whole_frames:
        return _Chunks(array, metadata, layout, frame_rate_hz)
    # Without compression, a chunk is a file of frames.
    step, n_frames = metadata.chunk_shape[0], metadata.shape[0]
    files = [
        FrameFile(metadata.chunk(array, index), min(step, n_frames - index * step))
        for index in range(metadata.chunks_of_frames)
    ]
    return PackedFileSource(files, layout, frame_rate_hz)


def _read_layout(config: ZarrConfig) -> tuple[_Metadata, FrameLayout, float | None]:
    """Return the metadata of an array, the layout of its frames, and their rate in Hz; raises as `opened`."""
    array, metadata = config.path, _read_metadata(config.path)
    own = _read_attributes(array, metadata)
    _, height, row_bytes = metadata.shape
    if config.holds == "bits":
        _require_whole(array, metadata)
        return metadata, FrameLayout((height, row_bytes), (height, row_bytes), to_rows=_packed_bits), config.frame_rate_hz
    if metadata.data_type == "bool":
        raise InputError(f"{array} is not packed: its values are bool; {_BITS}")
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


def _packed_bits(stored: NDArray[np.uint8]) -> NDArray[np.uint8]:
    if np.any((stored > 1) & (stored < 255)):
        raise InputError("the array has values other than 0 and 1, or 0 and 255, so that it does not hold bits")
    return np.packbits(stored != 0, axis=-1)


def require_layout(config: ZarrConfig) -> None:
    """Refuse an array that `opened` refuses, or that others wrote and whose frames show that they are packed in another way."""
    array, (metadata, _, _) = config.path, _read_layout(config)
    if config.bit_order is not None or _read_attributes(array, metadata) is not None:
        return
    with opened(config) as source:
        assert isinstance(source, BinarySource)
        if config.holds == "bits":
            for span in source.info.spread(_CHECKED, 1):
                source.packed(span)
            return
        spans = sampled_spans(source.info.n_frames, metadata.shape[1] * metadata.shape[2])
        samples = [source.packed(span) for span in spans]
    if content := unpacked_content(samples):
        raise InputError(
            f"{array} is not packed: its values are {'0 and ' if content.holds == 'bits' else 'sums up to '}{content.highest}; "
            + (_BITS if content.holds == "bits" else "save sums as .npy, and read them with npy")
        )
    if other := other_order(samples):
        along_width = other.order.packed_along == "width"
        remedy = f"write bit_order: {other.order.bit_order}" if along_width else "pack frames along the width"
        raise InputError(f"{array} is packed in another order: {other}; {remedy}, or write bit_order: big if it is right")


def _require_whole(array: Location, metadata: _Metadata) -> None:
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

    def __init__(self, array: Location, metadata: _Metadata, layout: FrameLayout, frame_rate_hz: float | None) -> None:
        super().__init__(metadata.shape[0], layout, frame_rate_hz)
        self._array, self._metadata = array, metadata
        self._decoders = [_decoder(array, codec.name) for codec in reversed(metadata.compressors)]
        starts = range(0, metadata.shape[0], metadata.chunk_shape[0])
        self._pieces = Pieces([*starts, metadata.shape[0]], self._frames, in_parts=False)

    def pieces(self, span: FrameSpan) -> Iterator[tuple[slice, NDArray[np.uint8]]]:
        """Yield the frames of a span, chunk by chunk: see `BinarySource`."""
        yield from ((place, self.layout.rows(stored)) for place, stored in self._pieces.of(span))

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
    metadata = _written(info, n_frames, codecs)
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
