"""A source as the content of a packed .npy file: its header, its frames, and how much of it a file holds already."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from photonpano.errors import PluginError
from photonpano.protocols import PackedSource, Source
from photonpano.values import FrameSpan

_BLOCK_BYTES = 8 * 1024**2
"""Bytes of the frames that are asked for at once, as the source gives them: packed or not."""
_COMPARED_PLACES, _COMPARED_FRAMES = 16, 16
"""Whether a file is of this source is told from so many frames at each of so many places."""


class PackedFrames:
    """The frames of a binary source, eight pixels to a byte."""

    def __init__(self, source: Source) -> None:
        self._source = source
        info = source.info
        self._frame = (info.height, -(-info.width // 8))
        self._unit = info.height * info.width
        if isinstance(source, PackedSource):
            self._unit = math.prod(self._frame)
        header = io.BytesIO()
        shape = (info.n_frames, *self._frame)
        np.lib.format.write_array_header_1_0(header, {"descr": "|u1", "fortran_order": False, "shape": shape})
        self.header = header.getvalue()

    @property
    def n_bytes(self) -> int:
        """The size of the whole file."""
        return self.position(self._source.info.n_frames)

    def position(self, frame: int) -> int:
        """Return where a frame begins in the file."""
        return len(self.header) + frame * math.prod(self._frame)

    def blocks(self, first: int) -> Iterator[FrameSpan]:
        """Yield the spans in which the frames from the first on are asked for."""
        n_frames, step = self._source.info.n_frames, max(1, _BLOCK_BYTES // self._unit)
        for start in range(first, n_frames, step):
            yield FrameSpan(start, min(start + step, n_frames))

    def of(self, span: FrameSpan) -> NDArray[np.uint8]:
        """Return the frames of a span: (n, H, ceil(W / 8)) uint8, contiguous.

        Raises:
            PluginError: the source gives something of another shape.
        """
        source = self._source
        packed = source.packed(span) if isinstance(source, PackedSource) else np.packbits(source.frames(span), axis=-1)
        expected = (len(span), *self._frame)
        if packed.shape != expected or packed.dtype != np.uint8:
            raise PluginError(
                f"the source broke its contract at {span}: expected packed frames of uint8 {expected}, "
                f"got {packed.dtype} {packed.shape}"
            )
        return np.ascontiguousarray(packed)

    def found_in(self, file: BinaryIO) -> int:
        """Return how many frames of this source a file begins with: 0 if it has another header or other frames.

        Some frames all over the file are compared, the last one among them.
        """
        file.seek(0)
        if file.read(len(self.header)) != self.header:
            return 0
        size = file.seek(0, io.SEEK_END)
        there = min((size - len(self.header)) // math.prod(self._frame), self._source.info.n_frames)
        length = min(_COMPARED_FRAMES, there)
        starts = np.linspace(0, there - length, _COMPARED_PLACES).astype(int).tolist() if there else []
        for start in dict.fromkeys(starts):
            file.seek(self.position(start))
            if file.read(self.position(length) - len(self.header)) != self.of(FrameSpan(start, start + length)).tobytes():
                return 0
        return there
