"""Write packed binary frames as a zarr array."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonpano import StreamInfo
from photonpano.reading import library
from photonpano_zarr.metadata import written

_CHUNK_BYTES = 4 * 1024**2  # most bytes of a chunk before compression, unless a frame has more
_LEVEL = 1  # of zstd: higher ones take longer, and gain little on photon noise


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
    for index, chunk in enumerate(_chunks(frames, n_frames, frame_shape)):
        path = metadata.chunk(folder, index)
        assert isinstance(path, Path)
        path.write_bytes(encode(chunk))
    (folder / "zarr.json").write_text(metadata.model_dump_json(indent=2), encoding="utf-8")


def _chunks(frames: Iterable[NDArray[np.uint8]], n_frames: int, frame_shape: tuple[int, int]) -> Iterator[NDArray[np.uint8]]:
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
