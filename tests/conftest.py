"""Small captures and motions that many tests need, so that those of the framework need no plugin."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from photonpano import FrameSpan, StreamInfo
from photonpano.geometry import translation
from photonpano.photometry import BinaryResponse

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import TracebackType

    from numpy.typing import ArrayLike


class MemorySource:
    """Binary frames (n, H, W) held in memory: a `photonpano.Source`."""

    def __init__(self, frames: np.ndarray, valid: np.ndarray | None = None) -> None:
        self._frames = np.asarray(frames, dtype=np.uint8)
        self.info = StreamInfo(*self._frames.shape, frame_rate_hz=None)
        self.response = BinaryResponse()
        self.valid = np.ones(self.info.frame_shape, bool) if valid is None else valid

    def counts(self, span: FrameSpan) -> np.ndarray:
        return self.frames(span).sum(axis=0, dtype=np.uint32)

    def frames(self, span: FrameSpan) -> np.ndarray:
        self.info.require(span)
        return self._frames[span.start : span.stop]

    def close(self) -> None: ...

    def __enter__(self) -> MemorySource:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None: ...


class KnownMotion:
    """A `photonpano.Trajectory` that a function of one instant gives."""

    def __init__(self, at: Callable[[float], np.ndarray], first: float = -np.inf, last: float = np.inf) -> None:
        self._at, self._first, self._last = at, first, last

    def at(self, frame_indices: ArrayLike) -> np.ndarray:
        return np.array([self._at(frame) for frame in np.atleast_1d(frame_indices)]).reshape(-1, 3, 3)

    def located(self, frame_indices: ArrayLike) -> np.ndarray:
        frames = np.atleast_1d(frame_indices)
        return (self._first <= frames) & (frames <= self._last)


@pytest.fixture(scope="session")
def memory_source() -> type[MemorySource]:
    return MemorySource


@pytest.fixture(scope="session")
def known_motion() -> type[KnownMotion]:
    return KnownMotion


@pytest.fixture(scope="session")
def pan() -> Callable[..., KnownMotion]:
    """Make a motion of so many pixels a frame."""

    def make(x_px: float, y_px: float = 0.0, first: float = -np.inf, last: float = np.inf) -> KnownMotion:
        return KnownMotion(lambda frame: translation(x_px * frame, y_px * frame), first, last)

    return make
