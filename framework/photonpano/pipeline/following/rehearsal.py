"""Run the first level on a made-up capture, so that what is loaded or compiled once does not delay the first frames."""

from __future__ import annotations

import logging
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from photonpano.context import Context
from photonpano.errors import PhotonpanoError
from photonpano.pipeline.following.located import LocatedSoFar
from photonpano.pipeline.following.picture import PictureSoFar
from photonpano.reading import BinarySource, FrameLayout
from photonpano.specs.plan import Plan
from photonpano.values import FrameSpan

logger = logging.getLogger(__name__)

_SHAPE, _BLOCK_PX = (64, 96), 8
_N_FRAMES = 2048
_LENGTH_PX = 32


def rehearse(plan: Plan, context: Context) -> None:
    """Locate some groups of random blocks that the camera pans over, and make their picture. Problems do not matter."""
    located, picture = LocatedSoFar(plan, context), PictureSoFar()
    try:
        with _Blocks() as source:
            if window := located.next_window(source, last=True):
                picture.add(window)
        picture.png()
    except PhotonpanoError as error:  # as with frames of another kind; the capture itself tells what is wrong
        logger.debug("the rehearsal failed: %s", error)


class _Blocks(BinarySource):
    """Frames of random blocks."""

    def __init__(self) -> None:
        height, width = _SHAPE
        super().__init__(_N_FRAMES, FrameLayout(_SHAPE, (height, width // 8)))
        self._rng = np.random.default_rng(0)
        blocks = self._rng.random((height // _BLOCK_PX, (width + _LENGTH_PX) // _BLOCK_PX))
        self._scene = np.kron(blocks, np.ones((_BLOCK_PX, _BLOCK_PX)))

    def pieces(self, span: FrameSpan) -> Iterator[tuple[slice, NDArray[np.uint8]]]:
        """Yield the frames of a span: see `BinarySource`."""
        for frame in range(span.start, span.stop):
            left = frame * _LENGTH_PX // _N_FRAMES
            lit = self._rng.random(_SHAPE) < self._scene[:, left : left + _SHAPE[1]]
            yield slice(frame - span.start, frame - span.start + 1), np.packbits(lit, axis=-1)[None]
