"""The record of a capture: what its source gives, and what was found about it, such as pixels that are rearranged."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from photonpano.capture.plugin_source import PluginSource
from photonpano.contracts.protocols import Closing
from photonpano.photometry import MAX_FRAMES, packed_counts
from photonpano.values import Background, BoolArray, Counts, Decision, FluxImage, Frames, FrameSpan, Light, Still, StreamInfo

if TYPE_CHECKING:
    from photonpano.contracts.protocols import Source
    from photonpano.geometry import Camera
    from photonpano.values import FloatArray, Response

Index: TypeAlias = NDArray[np.intp]
MISSING = -1  # the index of a pixel that the sensor does not have
_PER_FRAME = ("homographies", "rotations", "camera_from_world", "light", "taken")  # arrays of a truth, one entry a frame


def numbered(shape: tuple[int, ...]) -> Index:
    """Number the pixels of a frame along its rows, from 0: (H, W) intp."""
    return np.arange(np.prod(shape), dtype=np.intp).reshape(shape)


@dataclass(frozen=True, slots=True, eq=False)
class MaskedSpan:
    """Pixels that must not be used in some frames, such as those that a hand hides for a second."""

    span: FrameSpan  # frames of the source
    valid: BoolArray  # (H, W) mask, False for these pixels


class Gather:
    """Gathers the pixels of an index from frames; as a slice if the index is a contiguous part of the frame."""

    def __init__(self, index: Index, frame_shape: tuple[int, int]) -> None:
        """Take the (H, W) numbers of the pixels in frames of (h, w), or `MISSING`."""
        self.index = index
        self._missing = index == MISSING
        self._places = np.where(self._missing, 0, index)
        top, left = divmod(int(index[0, 0]), frame_shape[1])
        part = slice(top, top + index.shape[0]), slice(left, left + index.shape[1])
        self._slices = part if np.array_equal(numbered(frame_shape)[part], index) else None

    def __call__(self, frames: NDArray[Any]) -> NDArray[Any]:
        """Gather the pixels of (..., h, w) frames: (..., H, W), 0 where the sensor has none."""
        if self._slices is not None:
            return np.ascontiguousarray(frames[..., self._slices[0], self._slices[1]])
        *n, _, _ = frames.shape
        gathered = np.take(frames.reshape(*n, -1), self._places, axis=-1)
        gathered[..., self._missing] = 0
        return gathered


@dataclass(frozen=True, slots=True, eq=False)
class LinearCorrection:
    """Corrects sums of frames, `slope * counts + n * offset` for n frames, and fills pixels from their neighbours."""

    slope: FluxImage  # (H, W) float32
    offset: FluxImage  # (H, W) float32, added for each frame
    # (P,) numbers of the pixels that are replaced, (P, N) those of the neighbours of each, and (P, N) float32, the weights of
    # these, which sum to 1; None if no pixel is replaced
    filling: tuple[Index, Index, FluxImage] | None = None

    def __call__(self, counts: Counts | FluxImage, n_frames: int) -> FluxImage:
        """Correct the sum of a number of frames: (H, W) float32."""
        summed = np.asarray(counts * self.slope + np.float32(n_frames) * self.offset, np.float32)
        if self.filling is not None:
            filled, neighbours, shares = self.filling
            flat = summed.reshape(-1)
            flat[filled] = (flat[neighbours] * shares).sum(axis=1)
        return summed


@dataclass(frozen=True, slots=True, eq=False)
class Colours:
    """The colours of a capture behind a filter array, or in three channels."""

    # a capture for each of "red", "green", "blue" and, if there are pixels without filter, "clear", in this order: see
    # `photonpano.ColouredSource`
    parts: Mapping[str, Capture]
    # (3,) the flux of a clear pixel is the sum of these factors times the flux of red, green and blue ones
    clear_mix: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Capture(Closing):
    """A capture as components see it. It is a `photonpano.Source`; methods may be called from several threads at once.

    A correction, a light, a camera or a part makes another record, with `dataclasses.replace`. A capture in colour is grey by
    itself: motion is estimated from the grey capture, and the panorama is rendered from those of `colours()`.

    It can be pickled for another process, where the source is opened anew: see `photonpano.execution`.
    """

    source: PluginSource  # the source as its plugin gives it
    info: StreamInfo  # frames, size, rate; of the frames as they are seen here
    valid: BoolArray  # (H, W) mask, False for pixels that must not be used in any frame
    masks: tuple[MaskedSpan, ...] = ()  # more of them, each for some frames
    first: int = 0  # the frame of the source that is frame 0 here
    gather: Gather | None = None  # rearranges the pixels of frames; None for frames as they are read
    # take everything but the flux out of sums of frames, one after the other
    steps: tuple[Callable[[Any, int], FluxImage], ...] = ()
    # (H, W) float32, not negative: statistical weight of a frame of each pixel; None for 1. That of the best pixel behind a
    # filter is 1, and that of a pixel of gain 1 of a sensor whose pixels differ in gain.
    weight: FluxImage | None = None
    # the gain of each frame; None for steady light. Frames are weighted by it, and predicted flux is multiplied by it.
    light: Light | None = None
    # frames are warped through its lens, and homographies map ideal pixels; None if it is not known
    camera: Camera | None = None
    colour: Colours | None = None  # its colours; None for a grey capture
    # which parts of frames show the background; None if all do. Others are left out of merging, and of what is compared with
    # the panorama.
    background: Background | None = None
    copies: BoolArray | None = None  # (T,) True for frames that are copies of the one before; None if there are none
    still: Still = field(default_factory=Still)  # what stands still in the frames
    decisions: tuple[Decision, ...] = ()  # what was decided because of what the frames show

    @property
    def response(self) -> Response:
        """How flux becomes counts."""
        return self.source.response

    @property
    def is_packed(self) -> bool:
        """Whether the source gives packed frames, so that `packed` costs little."""
        return self.source.offers("packed")

    @property
    def corrects_sums(self) -> bool:
        """Whether sums of frames contain more than the flux, such as dark counts."""
        return bool(self.steps)

    def counts(self, span: FrameSpan) -> Counts:
        """Sum the frames of a span: (H, W) uint32."""
        return self._gathered(self.source.counts(self._read(span)))

    def chunk(self, span: FrameSpan) -> Counts:
        """Sum the frames of a span: (H, W) uint32, or uint8 if it is cheaper and holds the sum."""
        if not self.is_packed or len(span) > MAX_FRAMES:
            return self.counts(span)
        packed, width = self.source.packed(self._read(span)), self.source.info.width
        return self._gathered(packed_counts(packed, width, small=True))

    def chunks(self, spans: Iterable[FrameSpan]) -> Iterator[Counts]:
        """Yield the sum of the frames of each span, see `chunk`. Reads a span when its sum is asked for."""
        return map(self.chunk, spans)

    def frames(self, span: FrameSpan) -> Frames:
        """Return the frames of a span one by one: (n, H, W)."""
        return self._gathered(self.source.frames(self._read(span)))

    def packed(self, span: FrameSpan) -> NDArray[np.uint8]:
        """Return the binary frames of a span, eight pixels to a byte, as `numpy.packbits` does: (n, H, ceil(W / 8))."""
        if self.is_packed and self.gather is None:
            return self.source.packed(self._read(span))
        return np.packbits(self.frames(span), axis=-1)

    def corrected(self, counts: Counts, n_frames: int) -> FluxImage:
        """Correct a sum of frames, so that on average it is the sum of frames of the flux alone.

        The sum is (H, W), from `counts` or `chunk`. The correction is linear, so that the average is right; the result, (H, W)
        float32, may be negative. It is `counts` itself if there is nothing to correct.
        """
        summed: Any = np.asarray(counts, np.uint32) if self.steps else counts
        for step in self.steps:
            summed = step(summed, n_frames)
        corrected: FluxImage = summed
        return corrected

    def corrected_counts(self, span: FrameSpan) -> FluxImage:
        """Return the corrected sum of the frames of a span: see `corrected`."""
        return self.corrected(self.counts(span), len(span))

    def shown(self, spans: Iterable[FrameSpan]) -> list[FrameSpan]:
        """Return the spans that hold a frame that is not left out, as one without light is: its gain is 0."""
        return [span for span in spans if self.light is None or self.light.shown[span.start : span.stop].any()]

    def times_counted(self, span: FrameSpan) -> float:
        """Return how often the photons of a span are counted, where frames are copies: the factor of the variance of its sum.

        A frame that occurs k times adds k squared times the variance of one.
        """
        if self.copies is None:
            return 1.0
        first = np.flatnonzero(~self.copies[span.start + 1 : span.stop]) + 1
        return float((np.diff([0, *first, len(span)]) ** 2).sum() / len(span))

    def shown_pixels(self, span: FrameSpan) -> NDArray[np.uint8] | None:
        """Return which pixels count in a span, beside `valid`: (H, W), 1, others 0; None if all do.

        Others are those in which something hides the background, or that a mask leaves out, at any time of the span.
        """
        shown = None if self.background is None else self.background.pixels(span)
        start, stop = self.first + span.start, self.first + span.stop
        for mask in self.masks:
            if mask.span.start < stop and start < mask.span.stop:
                shown = mask.valid.view(np.uint8) if shown is None else shown & mask.valid
        return shown

    def masked_in(self, span: FrameSpan) -> Capture:
        """Return the capture with one mask for a span: of all pixels that do not count at any time of it."""
        shown = self.shown_pixels(span)
        return self if shown is None else replace(self, valid=self.valid & (shown > 0), masks=(), background=None)

    def pieces(self, span: FrameSpan) -> list[FrameSpan]:
        """Divide a span where a mask of some frames begins or ends."""
        ends = {end - self.first for mask in self.masks for end in (mask.span.start, mask.span.stop)}
        inside = sorted(end for end in ends if span.start < end < span.stop)
        return [FrameSpan(*ends) for ends in pairwise([span.start, *inside, span.stop])]

    def weights(self) -> FluxImage:
        """Return the statistical weight of a frame of each pixel: (H, W) float32, 1 for an ordinary pixel."""
        return np.ones(self.info.frame_shape, np.float32) if self.weight is None else self.weight

    def colours(self) -> Mapping[str, Capture]:
        """Return a capture for each colour, see `Colours`; none for a grey capture."""
        parts = {} if self.colour is None else self.colour.parts
        seen: dict[str, Any] = {"info": self.info, "first": self.first, "camera": self.camera, "masks": self.masks}
        seen |= {"background": self.background, "copies": self.copies}
        lights = [self.light and self.light.of_colour(index) for index in range(len(parts))]
        return {name: replace(part, light=light, **seen) for (name, part), light in zip(parts.items(), lights, strict=True)}

    def clear_mix(self) -> FloatArray:
        """Return the flux of a clear pixel, as factors of the flux of red, green and blue ones, whose sum it is: (3,)."""
        return np.ones(3) if self.colour is None else self.colour.clear_mix

    @property
    def knows_truth(self) -> bool:
        """Whether `truth` returns the ground truth."""
        return self.gather is None and self.source.offers("truth")

    def truth(self) -> Mapping[str, NDArray[np.generic]] | None:
        """Return the ground truth of a simulated capture, see `photonpano.KnowsTruth`; None if it is not known."""
        if not self.knows_truth:
            return None
        truth = self.source.truth()
        frames = slice(self.first, self.first + self.info.n_frames)
        return {**truth, **{name: truth[name][frames] for name in _PER_FRAME if name in truth and self._is_part}}

    @property
    def has_sharp_views(self) -> bool:
        """Whether `sharp_view` returns frames without noise."""
        return self.gather is None and self.colour is None and self.source.offers("sharp_view")

    def sharp_view(self, frame: int) -> FluxImage:
        """Return the flux of a frame of a simulated capture without noise; `InputError` if there is no such frame.

        See `photonpano.KnowsSharpViews`.
        """
        return self.source.sharp_view(self._read(FrameSpan(frame, frame + 1)).start)

    def close(self) -> None:
        """Close the source; it is not used afterwards."""
        self.source.close()

    @property
    def _is_part(self) -> bool:
        return self.info.n_frames != self.source.info.n_frames

    def _read(self, span: FrameSpan) -> FrameSpan:
        if not self._is_part:
            return span
        self.info.require(span)
        return FrameSpan(self.first + span.start, self.first + span.stop)

    def _gathered(self, frames: NDArray[Any]) -> NDArray[Any]:
        return frames if self.gather is None else self.gather(frames)


def capture_of(source: Source, origin: str | None = None) -> Capture:
    """Return the capture that a source gives; a capture as it is.

    Args:
        source: the source, with any of the optional methods.
        origin: who provides it, such as "source 'packed-npy' of photonpano 0.1.0": properties and arrays are checked, and
            errors name the plugin, whoever reads. None for a source that is neither checked nor named.

    Raises:
        PluginError: a property of the source is not what it should be.
    """
    return source if isinstance(source, Capture) else _capture_of(PluginSource(source, origin))


def in_light(source: Source, light: Light) -> Capture:
    """Return a capture with the gain of each of its frames. Counts stay as they are; what sums them divides by the gains."""
    return replace(capture_of(source), light=light)


def leaving_out(source: Source, shown: BoolArray) -> Capture:
    """Return a capture without the frames that are not `shown`, (T,): their gain is 0, so that they count in no sum."""
    capture = capture_of(source)
    if shown.all():
        return capture
    return replace(capture, light=(capture.light or Light.of_frames(np.ones(len(shown)))).leaving_out(shown))


def seen_through(source: Source, camera: Camera) -> Capture:
    """Return a capture with its camera. Counts stay as they are; what warps frames uses the lens."""
    return replace(capture_of(source), camera=camera)


def with_background(source: Source, background: Background | None) -> Capture:
    """Return a capture in which what hides the background is left out; None for nothing. Counts stay as they are."""
    return replace(capture_of(source), background=background)


def part_of(source: Source, span: FrameSpan) -> Capture:
    """Return the frames of a span as a capture of its own, whose first frame has the index 0."""
    whole = capture_of(source)
    light = None if whole.light is None else whole.light.part(span)
    background = None if whole.background is None else whole.background.part(span)
    copies = None if whole.copies is None else whole.copies[span.start : span.stop]
    info, first = replace(whole.info, n_frames=len(span)), whole.first + span.start
    return replace(whole, info=info, first=first, light=light, background=background, copies=copies)


def _capture_of(source: PluginSource) -> Capture:
    colour = None
    if source.offers("colours"):
        parts = {name: _capture_of(each) for name, each in source.colours().items()}
        colour = Colours(parts, source.clear_mix())
    return Capture(source, source.info, source.valid, colour=colour)
