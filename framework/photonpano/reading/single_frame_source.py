"""Base class of sources whose frames are made or read one by one."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from photonpano.protocols import Closing
from photonpano.values import Counts, Frames, FrameSpan, StreamInfo


class SingleFrameSource(Closing, ABC):
    """Sums and spans of single frames. A subclass gives a frame, and what is missing for a `photonpano.Source`.

    Attributes:
        info: frames, size, rate; the subclass sets it.
    """

    info: StreamInfo

    @abstractmethod
    def frame(self, index: int) -> NDArray[np.bool_] | Frames:
        """Return a frame of the capture, (H, W), whose values fit into the bits of `info`.

        Raises:
            InputError: the frame cannot be read.
        """

    def counts(self, span: FrameSpan) -> Counts:
        """Sum the frames of a span: (H, W) uint32."""
        self.info.require(span)
        counts = np.zeros(self.info.frame_shape, np.uint32)
        for index in range(span.start, span.stop):
            counts += self.frame(index)
        return counts

    def frames(self, span: FrameSpan) -> Frames:
        """Return the frames of a span: (n, H, W) uint8, or uint16 of more than eight bits."""
        self.info.require(span)
        shape = len(span), *self.info.frame_shape
        frames: Frames = np.empty(shape, np.uint8) if self.info.bit_depth <= 8 else np.empty(shape, np.uint16)
        for place, index in enumerate(range(span.start, span.stop)):
            frames[place] = self.frame(index)
        return frames
