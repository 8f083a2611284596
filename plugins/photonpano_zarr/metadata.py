"""The file `zarr.json` of an array of packed binary frames."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from photonpano import InputError, Location, StreamInfo, Url
from photonpano.reading import read_range, reading

VERSION = 1  # of the attributes
_FILE = "zarr.json"
_MOST_BYTES = 1024**2  # the longest metadata that are read
_CODECS = ("bytes", "zstd", "blosc", "gzip", "crc32c")
_AGAIN = "write it again with photonpano convert"


class Attributes(BaseModel):
    """Description of the capture in an array, so that it opens without further keys."""

    model_config = ConfigDict(frozen=True)

    version: int = VERSION  # the version of these attributes
    kind: Literal["binary"] = "binary"  # kind of frames; others than binary ones are not written yet
    width: int = Field(ge=1)  # columns of a frame, in px
    bit_order: Literal["big", "little"] = "big"  # "big" if the first of eight pixels is the highest bit of its byte
    frame_rate_hz: float | None = Field(None, gt=0)  # frames a second, in Hz; None if unknown


class _Named(BaseModel):
    name: str
    configuration: dict[str, Any] = {}


class Metadata(BaseModel):
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


def written(info: StreamInfo, frames_of_chunk: int, compressors: Sequence[Mapping[str, Any]]) -> Metadata:
    """Describe an array of packed frames."""
    shape = info.n_frames, info.height, -(-info.width // 8)
    attributes = Attributes(width=info.width, frame_rate_hz=info.frame_rate_hz)
    return Metadata(
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


def read_metadata(array: Location) -> Metadata:
    """Read the metadata of an array of packed frames; raises an `InputError` if there are none, or of something else."""
    text = _read(array)
    try:
        found = Metadata.model_validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        if first["loc"] == ("node_type",):
            raise InputError(f"{array} is a zarr group, not an array; name the array in it{_members(array)}") from error
        where = ".".join(map(str, first["loc"])) or "its JSON"
        raise InputError(f"{array / _FILE} is wrong at {where}: {first['msg']}; {_AGAIN}, or copy it again") from error
    _require_frames(array, found)
    return found


def read_attributes(array: Location, metadata: Metadata) -> Attributes | None:
    """Return the attributes of photonpano in an array, if any; raises an `InputError` if they are newer or damaged."""
    own = metadata.attributes.get("photonpano")
    if own is None:
        return None
    version = own.get("version") if isinstance(own, dict) else None
    if isinstance(version, int) and version > VERSION:
        raise InputError(f"{array} was written by a newer photonpano, as version {version}; update this one")
    try:
        return Attributes.model_validate(own)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(("attributes.photonpano", *map(str, first["loc"])))
        raise InputError(f"{array / _FILE} is wrong at {where}: {first['msg']}; correct it, or {_AGAIN}") from error


def _read(array: Location) -> bytes:
    if isinstance(array, Url):
        try:
            return read_range(array / _FILE, 0, _MOST_BYTES)
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
        return file.read(_MOST_BYTES)


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


def _require_frames(array: Location, found: Metadata) -> None:
    shape, layout = found.shape, "a capture is uint8 (frames, height, bytes of a row), as from numpy.packbits(cube, axis=-1)"
    if found.data_type != "uint8":
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
