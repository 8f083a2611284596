"""Base class of sources of binary frames."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from photonpano.photometry import BinaryResponse
from photonpano.protocols import Closing
from photonpano.reading.files import OpenFiles
from photonpano.reading.packed_layout import FrameLayout
from photonpano.values import Counts, FrameSpan, StreamInfo


class BinarySource(Closing, ABC):
    """Binary frames, eight pixels to a byte: a `photonpano.PackedSource`. A subclass reads the bytes.

    Attributes:
        info: frames, size, rate.
        response: that of binary frames.
        valid: (H, W) mask, True everywhere: files do not mark bad pixels.
        layout: order of the pixels of a frame in its bytes.
        files: reads pieces of files.
    """

    def __init__(self, n_frames: int, layout: FrameLayout, frame_rate_hz: float | None = None) -> None:
        self.info = StreamInfo(n_frames, *layout.frame_shape, frame_rate_hz)
        self.response = BinaryResponse()
        self.valid = np.ones(layout.frame_shape, np.bool_)
        self.valid.flags.writeable = False
        self.layout = layout
        self.files = OpenFiles()

    @abstractmethod
    def pieces(self, span: FrameSpan) -> Iterator[tuple[slice, NDArray[np.uint8]]]:
        """Yield the frames of a span, a few at a time.

        Returns:
            The place of these frames in the span, and their packed rows, (n, rows, bytes of a row), which the next step may
            overwrite.

        Raises:
            InputError: the frames cannot be read.
        """

    def counts(self, span: FrameSpan) -> Counts:
        """Sum the frames of a span: (H, W) uint32."""
        self.info.require(span)
        sums = None
        for _, rows in self.pieces(span):
            sums = self.layout.add_counts(rows, sums)
        assert sums is not None, "a span is never empty"
        return self.layout.image(sums)

    def frames(self, span: FrameSpan) -> NDArray[np.uint8]:
        """Return the frames of a span: (n, H, W) of zeros and ones."""
        self.info.require(span)
        frames = np.empty((len(span), *self.info.frame_shape), np.uint8)
        for place, rows in self.pieces(span):
            frames[place] = self.layout.unpacked(rows)
        return frames

    def packed(self, span: FrameSpan) -> NDArray[np.uint8]:
        """Return the frames of a span, eight pixels to a byte: see `photonpano.PackedSource`."""
        self.info.require(span)
        frames = np.empty((len(span), self.info.height, -(-self.info.width // 8)), np.uint8)
        for place, rows in self.pieces(span):
            frames[place] = self.layout.packed(rows)
        return frames

    def close(self) -> None:
        """Close the files."""
        self.files.close()
