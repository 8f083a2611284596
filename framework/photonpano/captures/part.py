"""A part of a capture: some of its frames, numbered from 0."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from photonpano.protocols import Source
from photonpano.source_wrapper import ArrayT, SharpViewsWrapper, SourceWrapper, TruthWrapper, capabilities_of, with_capabilities
from photonpano.values import FluxImage, FrameSpan, StreamInfo

_OF_FRAMES = ("homographies", "rotations", "camera_from_world", "light", "taken")
"""Arrays of a truth that have an entry for each frame."""


def part_of(source: Source, span: FrameSpan) -> Source:
    """Return the frames of a span as a capture of its own, whose first frame has the index 0.

    Args:
        source: the whole capture.
        span: frames that it has.
    """
    own: dict[type[SourceWrapper], type[SourceWrapper]] = {TruthWrapper: _PartOfTruth, SharpViewsWrapper: _PartOfViews}
    capabilities = [own.get(each, each) for each in capabilities_of(source)]
    return with_capabilities(Part, capabilities)(source, span)


class Part(SourceWrapper):
    """A part of a capture: made by `part_of`."""

    def __init__(self, source: Source, span: FrameSpan) -> None:
        super().__init__(source)
        self._span = span
        self._info = replace(source.info, n_frames=len(span))

    def around(self, source: Source) -> Source:
        """See `SourceWrapper`."""
        return part_of(source, self._span)

    @property
    def info(self) -> StreamInfo:
        """Frames of the part, size, rate."""
        return self._info

    def read(self, method: Callable[[FrameSpan], ArrayT], span: FrameSpan, shape: tuple[int, ...]) -> ArrayT:
        """Read the frames of the whole capture."""
        self.info.require(span)
        start = self._span.start
        return super().read(method, FrameSpan(start + span.start, start + span.stop), shape)


class _PartOfTruth(TruthWrapper):
    """A part of a source that `KnowsTruth`."""

    _span: FrameSpan

    def truth(self) -> Mapping[str, NDArray[np.generic]]:
        """Return what the frames of the part show."""
        truth = super().truth()
        of_frames = {name: truth[name][self._span.start : self._span.stop] for name in _OF_FRAMES if name in truth}
        return {**truth, **of_frames}


class _PartOfViews(SharpViewsWrapper):
    """A part of a source that `KnowsSharpViews`."""

    _span: FrameSpan

    def sharp_view(self, frame: int) -> FluxImage:
        """Return the flux of a frame of the part."""
        self.info.require(FrameSpan(frame, frame + 1))
        return super().sharp_view(self._span.start + frame)
