"""Base classes of sources: one that closes itself, and one around another source."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Self, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from photonpano.protocols import (
    ColouredSource,
    KnowsSharpViews,
    KnowsTruth,
    LensedSource,
    LinearlyCorrectedSource,
    LitSource,
    PackedSource,
    Source,
    WeightedSource,
)
from photonpano.values import BoolArray, Counts, FloatArray, FluxImage, Frames, FrameSpan, Light, Response, StreamInfo

if TYPE_CHECKING:
    from photonpano.geometry import Camera

ArrayT = TypeVar("ArrayT", bound="NDArray[Any]")
WrapperT = TypeVar("WrapperT", bound="SourceWrapper")


class Closing:
    """Closes itself at the end of a `with` block."""

    def close(self) -> None:
        """Release files; by default there are none."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


class SourceWrapper(Closing):
    """A source around another source, to which it passes every call. Subclasses override what they change.

    The optional members `packed`, `corrected`, `weights`, `light`, `camera`, `colours`, `truth` and `sharp_view` come from
    the classes `PackedWrapper`, `LinearlyCorrectedWrapper`, `WeightedWrapper`, `LitWrapper`, `LensedWrapper`,
    `ColouredWrapper`, `TruthWrapper` and `SharpViewsWrapper`: see `with_capabilities`.

    A wrapper can be pickled if what it wraps can: see `photonpano.execution`.

    Attributes:
        wrapped: the other source.
    """

    made_of: ClassVar[tuple[type[SourceWrapper], tuple[type[SourceWrapper], ...]] | None] = None

    def __init__(self, wrapped: Source) -> None:
        self.wrapped = wrapped

    def __reduce__(self) -> tuple[Any, ...]:
        return _unpickled, self.made_of or (type(self), ()), self.__getstate__()

    @property
    def info(self) -> StreamInfo:
        """Frames, size, rate."""
        return self.wrapped.info

    @property
    def response(self) -> Response:
        """How flux becomes counts."""
        return self.wrapped.response

    @property
    def valid(self) -> BoolArray:
        """(H, W) mask."""
        return self.wrapped.valid

    def counts(self, span: FrameSpan) -> Counts:
        """Sum the frames of a span: (H, W) uint32."""
        return self.read(self.wrapped.counts, span, self.info.frame_shape)

    def frames(self, span: FrameSpan) -> Frames:
        """Return the frames of a span one by one: (n, H, W)."""
        return self.read(self.wrapped.frames, span, (len(span), *self.info.frame_shape))

    def close(self) -> None:
        """Close the wrapped source."""
        self.wrapped.close()

    def read(self, method: Callable[[FrameSpan], ArrayT], span: FrameSpan, shape: tuple[int, ...]) -> ArrayT:
        """Read a span with a method of the wrapped source, which promises an array of this shape."""
        del shape
        return method(span)


class PackedWrapper(SourceWrapper):
    """A wrapper of a `PackedSource`."""

    wrapped: PackedSource

    def packed(self, span: FrameSpan) -> NDArray[np.uint8]:
        """Return the frames of a span, eight pixels to a byte: see `PackedSource`."""
        height, width = self.info.frame_shape
        return self.read(self.wrapped.packed, span, (len(span), height, -(-width // 8)))


class LinearlyCorrectedWrapper(SourceWrapper):
    """A wrapper of a `LinearlyCorrectedSource`."""

    wrapped: LinearlyCorrectedSource

    def corrected(self, counts: Counts, n_frames: int) -> FluxImage:
        """Take everything but the flux out of a sum of frames: see `LinearlyCorrectedSource`."""
        return self.wrapped.corrected(counts, n_frames)


class WeightedWrapper(SourceWrapper):
    """A wrapper of a `WeightedSource`."""

    def weights(self) -> FluxImage:
        """Return what a frame of each pixel is worth: see `WeightedSource`."""
        return cast("WeightedSource", self.wrapped).weights()


class LitWrapper(SourceWrapper):
    """A wrapper of a `LitSource`."""

    @property
    def light(self) -> Light:
        """The gain of each frame."""
        return cast("LitSource", self.wrapped).light


class LensedWrapper(SourceWrapper):
    """A wrapper of a `LensedSource`."""

    @property
    def camera(self) -> Camera:
        """The camera of all frames."""
        return cast("LensedSource", self.wrapped).camera


class ColouredWrapper(SourceWrapper):
    """A wrapper of a `ColouredSource`, whose sources it wraps as well.

    Attributes:
        around: returns the same wrapper around the source of one colour; the class that inherits has this method.
    """

    around: Callable[[Source], Source]

    def colours(self) -> Mapping[str, Source]:
        """Return a source for each colour: see `ColouredSource`."""
        return {name: self.around(each) for name, each in cast("ColouredSource", self.wrapped).colours().items()}

    def clear_mix(self) -> FloatArray:
        """Return the flux of a clear pixel: see `ColouredSource`."""
        return cast("ColouredSource", self.wrapped).clear_mix()


class TruthWrapper(SourceWrapper):
    """A wrapper of a source that `KnowsTruth`."""

    def truth(self) -> Mapping[str, NDArray[np.generic]]:
        """Return what the frames show: see `KnowsTruth`."""
        return cast("KnowsTruth", self.wrapped).truth()


class SharpViewsWrapper(SourceWrapper):
    """A wrapper of a source that `KnowsSharpViews`."""

    def sharp_view(self, frame: int) -> FluxImage:
        """Return the flux of a frame: see `KnowsSharpViews`."""
        return cast("KnowsSharpViews", self.wrapped).sharp_view(frame)


def capabilities_of(source: Source) -> list[type[SourceWrapper]]:
    """Return the classes with which a wrapper gets the optional methods that a source has."""
    known: Any = source
    wrappers = {
        PackedSource: PackedWrapper,
        LinearlyCorrectedSource: LinearlyCorrectedWrapper,
        WeightedSource: WeightedWrapper,
        LitSource: LitWrapper,
        LensedSource: LensedWrapper,
        ColouredSource: ColouredWrapper,
        KnowsTruth: TruthWrapper,
        KnowsSharpViews: SharpViewsWrapper,
    }
    return [wrapper for protocol, wrapper in wrappers.items() if isinstance(known, protocol)]


def with_capabilities(wrapper: type[WrapperT], capabilities: list[type[SourceWrapper]]) -> type[WrapperT]:
    """Return a subclass of a wrapper that inherits from these classes too.

    `isinstance` with `PackedSource` and the other protocols is then decided by the class of an object.
    """
    return type(wrapper.__name__, (*capabilities, wrapper), {"made_of": (wrapper, tuple(capabilities))})


def _unpickled(wrapper: type[SourceWrapper], capabilities: tuple[type[SourceWrapper], ...]) -> SourceWrapper:
    """Return a wrapper without attributes."""
    made = with_capabilities(wrapper, list(capabilities))
    return made.__new__(made)


def seen_through(source: Source, camera: Camera) -> SeenThrough:
    """Return a capture with its camera: a `LensedSource`. It replaces a camera that the source has."""
    capabilities = [each for each in capabilities_of(source) if each is not LensedWrapper]
    return with_capabilities(SeenThrough, capabilities)(source, camera)


class SeenThrough(SourceWrapper):
    """A source whose camera is known: made by `seen_through`. Its counts stay as they are; what warps frames uses the lens."""

    def __init__(self, source: Source, camera: Camera) -> None:
        super().__init__(source)
        self._camera = camera

    def around(self, source: Source) -> Source:
        """Return the source of one colour, with the same camera."""
        return seen_through(source, self._camera)

    @property
    def camera(self) -> Camera:
        """The camera of all frames."""
        return self._camera
