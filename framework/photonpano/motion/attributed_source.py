"""Sources whose errors name their plugin, and whose properties and arrays are checked."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from itertools import count
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from photonpano.contracts.rules import BrokenContract, shown
from photonpano.errors import PluginError
from photonpano.motion.attribution import attributing
from photonpano.protocols import Source
from photonpano.source_wrapper import (
    ArrayT,
    LinearlyCorrectedWrapper,
    SharpViewsWrapper,
    SourceWrapper,
    TruthWrapper,
    capabilities_of,
    with_capabilities,
)
from photonpano.values import Bayer, BoolArray, Counts, FluxImage, Frames, FrameSpan, Response, StreamInfo

logger = logging.getLogger(__name__)

_ALWAYS, _EVERY = 16, 32
"""The values of the first reads are checked, and later those of every so many; looking at all takes as long as reading them."""
_FLUX = np.array([[0.0, 0.01, 0.3], [0.3, 0.01, np.nan]], np.float32)
"""Flux with which a response is tried."""


def attributed(source: Source, origin: str) -> AttributedSource:
    """Return a source whose errors name the plugin, whether a merger, the renderer or a preview reads it.

    It has the optional methods that the source has. Of a `ColouredSource`, the sources of the colours name the plugin, too.

    Args:
        source: the source.
        origin: who provides it, such as "source 'packed-npy' of photonpano 0.1.0".

    Raises:
        PluginError: `info`, `valid` or `response` is not what it should be.
    """
    named = {
        LinearlyCorrectedWrapper: _AttributedSums,
        TruthWrapper: _AttributedTruth,
        SharpViewsWrapper: _AttributedViews,
    }
    with attributing(origin, "opening"):
        capabilities = [named.get(each, each) for each in capabilities_of(source)]
    return with_capabilities(AttributedSource, capabilities)(source, origin)


class AttributedSource(SourceWrapper):
    """A source that names its plugin in errors: made by `attributed`.

    Reading a span raises a `PluginError` if the source failed with an exception that is not for users, or broke its contract:
    if an array has another shape or type, or values that frames of this depth cannot have, or changes after it was returned.
    """

    def __init__(self, source: Source, origin: str) -> None:
        super().__init__(source)
        self._origin = origin
        self._reads = count()
        self._own: set[str] = set()
        with attributing(origin, "opening"):
            self._info = _checked_info(source.info)
            self._valid = _checked_mask(source.valid, self._info.frame_shape)
            self._response = _checked_response(source.response)

    @property
    def info(self) -> StreamInfo:
        """Frames, size, rate."""
        return self._info

    @property
    def response(self) -> Response:
        """How flux becomes counts."""
        return self._response

    @property
    def valid(self) -> BoolArray:
        """(H, W) mask."""
        return self._valid

    def counts(self, span: FrameSpan) -> Counts:
        """Sum the frames of a span: (H, W) uint32."""
        return self._checked("counts", self.wrapped.counts, span, self._info.frame_shape, len(span) * self._highest)

    def frames(self, span: FrameSpan) -> Frames:
        """Return the frames of a span one by one: (n, H, W)."""
        return self._checked("frames", self.wrapped.frames, span, (len(span), *self._info.frame_shape), self._highest)

    def read(self, method: Callable[[FrameSpan], ArrayT], span: FrameSpan, shape: tuple[int, ...]) -> ArrayT:
        """See `SourceWrapper`: reads packed frames."""
        return self._checked("packed", method, span, shape, 255)

    def around(self, source: Source) -> AttributedSource:
        """See `ColouredWrapper`."""
        return attributed(source, self._origin)

    def close(self) -> None:
        """Close the source; a failure is logged, since what was read from it is not affected."""
        try:
            with attributing(self._origin, "closing"):
                self.wrapped.close()
        except PluginError as error:
            logger.warning("%s", error)

    @property
    def _highest(self) -> int:
        """The highest value of a pixel in a frame."""
        return 1 if self._info.kind == "binary" else 2**self._info.bit_depth - 1

    def _checked(
        self, what: str, method: Callable[[FrameSpan], ArrayT], span: FrameSpan, shape: tuple[int, ...], highest: int
    ) -> ArrayT:
        """Read a span, and check the array. `what` is the name of the method."""
        with attributing(self._origin, str(span)):
            found = method(span)
            if np.shape(found) != shape:
                raise BrokenContract(f"expected the shape {shape}, got {np.shape(found)}")
            if not isinstance(found, np.ndarray) or found.dtype.kind not in "uib":
                kind = f"an array of {found.dtype}" if isinstance(found, np.ndarray) else f"a {type(found).__name__}"
                raise BrokenContract(f"{what}() returns an array of whole numbers, got {kind}")
            read = next(self._reads)
            if read < _ALWAYS or read % _EVERY == 0:
                _require_range(what, found, highest)
            if what not in self._own:
                self._own.add(what)
                self._require_kept(what, method, span, found)
            return found

    def _require_kept(self, what: str, method: Callable[[FrameSpan], ArrayT], span: FrameSpan, found: ArrayT) -> None:
        """Refuse a source that changes an array after it has returned it, as one with a single buffer does."""
        kept = found.copy()
        last = self._info.n_frames - 1
        for frame in {min(span.stop, last), max(span.start - 1, 0)}:
            try:
                method(FrameSpan(frame, frame + 1))
            except Exception:
                return  # it is raised again where that frame is needed
        if not np.array_equal(kept, found):
            raise BrokenContract(f"the array that {what}() returned changed when other frames were read; return a new array")


class _AttributedSums(LinearlyCorrectedWrapper, AttributedSource):
    """A source that corrects sums of frames."""

    def corrected(self, counts: Counts, n_frames: int) -> FluxImage:
        """Take everything but the flux out of a sum of frames: see `LinearlyCorrectedSource`."""
        with attributing(self._origin, "correcting"):
            found: Any = self.wrapped.corrected(counts, n_frames)
            if not isinstance(found, np.ndarray) or found.dtype.kind != "f" or found.shape != counts.shape:
                raise BrokenContract(f"corrected() returns {counts.shape} of float32, got {shown(found)}")
            corrected: FluxImage = found
            return corrected


class _AttributedTruth(TruthWrapper, AttributedSource):
    """A source with ground truth."""

    def truth(self) -> Mapping[str, NDArray[np.generic]]:
        """Return what the frames show: see `KnowsTruth`."""
        with attributing(self._origin, "truth()"):
            found: Any = super().truth()
            if not isinstance(found, Mapping):
                raise BrokenContract(f"truth() returns a mapping of arrays by name, got {shown(found)}")
            truth: Mapping[str, NDArray[np.generic]] = found
            return truth


class _AttributedViews(SharpViewsWrapper, AttributedSource):
    """A source that can return its frames without noise."""

    def sharp_view(self, frame: int) -> FluxImage:
        """Return the flux of a frame: see `KnowsSharpViews`."""
        with attributing(self._origin, "sharp_view()"):
            found: Any = super().sharp_view(frame)
            if not isinstance(found, np.ndarray) or found.dtype.kind != "f" or found.shape != self.info.frame_shape:
                raise BrokenContract(f"sharp_view() returns {self.info.frame_shape} of float32, got {shown(found)}")
            view: FluxImage = found
            return view


def _checked_info(info: Any) -> StreamInfo:
    if not isinstance(info, StreamInfo):
        raise BrokenContract(f"info is a StreamInfo, got {shown(info)}")
    for name in ("n_frames", "height", "width", "bit_depth"):
        size = getattr(info, name)
        if not isinstance(size, int | np.integer) or size < 1:
            raise BrokenContract(f"info.{name} is a whole number of at least 1, got {size!r:.60}")
    if info.kind not in ("binary", "intensity"):
        raise BrokenContract(f"info.kind is binary or intensity, got {info.kind!r:.60}")
    if info.bayer not in (None, *get_args(Bayer)):
        raise BrokenContract(f"info.bayer is {', '.join(get_args(Bayer))} or None, got {info.bayer!r:.60}")
    rate: Any = info.frame_rate_hz
    if rate is not None and not (isinstance(rate, int | float | np.number) and 0 < rate < np.inf):
        raise BrokenContract(f"info.frame_rate_hz is a finite number above 0, or None if it is not known; got {rate!r:.60}")
    return info


def _checked_mask(valid: Any, frame_shape: tuple[int, int]) -> BoolArray:
    if not isinstance(valid, np.ndarray) or valid.dtype != np.bool_ or valid.shape != frame_shape:
        raise BrokenContract(f"valid is {frame_shape} of bool, got {shown(valid)}")
    mask: BoolArray = valid
    return mask


def _checked_response(response: Any) -> Response:
    """Try a response with a few values, NaN among them."""
    with np.errstate(all="ignore"):
        counts = response.mean_count(_FLUX)
        tried = {
            "mean_count": counts,
            "flux": response.flux(counts, 10_000.0),
            "stabilised": response.stabilised(_FLUX, np.full(_FLUX.shape, 100, np.float32)),
        }
    for name, found in tried.items():
        if not isinstance(found, np.ndarray) or found.dtype.kind != "f" or found.shape != _FLUX.shape:
            raise BrokenContract(f"response.{name}() of {_FLUX.shape} returns {_FLUX.shape} of float32, got {shown(found)}")
        if (np.isnan(found) != np.isnan(_FLUX)).any():
            raise BrokenContract(f"response.{name}() keeps NaN, and gives no other; {_FLUX.tolist()} became {found.tolist()}")
    if not np.allclose(tried["flux"], _FLUX, rtol=0.1, atol=0.01, equal_nan=True):
        raise BrokenContract(f"response.flux() inverts response.mean_count(); {_FLUX.tolist()} became {tried['flux'].tolist()}")
    response.stabilised_std(100.0)
    checked: Response = response
    return checked


def _require_range(what: str, found: NDArray[Any], highest: int) -> None:
    lowest = int(found.min()) if found.dtype.kind == "i" else 0
    if lowest < 0 or found.max() > highest:
        worst = lowest if lowest < 0 else int(found.max())
        raise BrokenContract(f"{what}() returns numbers from 0 to {highest} for these frames, got {worst}")
