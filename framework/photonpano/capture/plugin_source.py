"""A source as its plugin gives it: errors name the plugin, and properties and arrays are checked."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from functools import cached_property
from itertools import count
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from numpy.typing import NDArray

from photonpano.contracts.attribution import attributing
from photonpano.contracts.rules import BrokenContract, shown
from photonpano.errors import PluginError
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
from photonpano.values import Bayer, BoolArray, Counts, FloatArray, FluxImage, Frames, FrameSpan, Light, Response, StreamInfo

if TYPE_CHECKING:
    from photonpano.geometry import Camera

logger = logging.getLogger(__name__)

_ALWAYS, _EVERY = 16, 32  # values are checked in the first 16 reads, then in every 32nd: all would double reading time
_FLUX = np.array([[0.0, 0.01, 0.3], [0.3, 0.01, np.nan]], np.float32)  # with which a response is tried
_OPTIONAL: dict[str, Any] = {
    "packed": PackedSource,
    "corrected": LinearlyCorrectedSource,
    "weights": WeightedSource,
    "colours": ColouredSource,
    "light": LitSource,
    "camera": LensedSource,
    "truth": KnowsTruth,
    "sharp_view": KnowsSharpViews,
}


class PluginSource:
    """A source as its plugin gives it.

    Reading a span raises a `PluginError` if the source failed with an exception that is not for users, or broke its contract:
    if an array has another shape or type, or values that frames of this depth cannot have, or changes after it was returned.

    Attributes:
        given: what the plugin has built.
        info: frames, size, rate.
        valid: (H, W) mask.
        response: how flux becomes counts.
    """

    def __init__(self, source: Source, origin: str | None) -> None:
        """Take the source, and who provides it; None for a source that is neither checked nor named.

        Raises:
            PluginError: `info`, `valid` or `response` is not what it should be.
        """
        self.given: Any = source
        self._origin = origin
        self._reads = count()
        self._own: set[str] = set()
        self._of: tuple[PluginSource, str] | None = None
        with self._attributing("opening"):
            self._offered = [name for name, protocol in _OPTIONAL.items() if isinstance(source, protocol)]
            checked = origin is not None
            self.info: StreamInfo = _checked_info(source.info) if checked else source.info
            self.valid: BoolArray = _checked_mask(source.valid, self.info.frame_shape) if checked else source.valid
            self.response: Response = _checked_response(source.response) if checked else source.response

    def __reduce__(self) -> Any:
        """Travel as what was given; the source of a colour as a colour of the capture, which is opened in each process."""
        return (PluginSource, (self.given, self._origin)) if self._of is None else (_colour_of, self._of)

    def offers(self, name: str) -> bool:
        """Return whether the source has an optional method."""
        return name in self._offered

    def counts(self, span: FrameSpan) -> Counts:
        """Sum the frames of a span: (H, W) uint32."""
        counts: Counts = self._read("counts", span, self.info.frame_shape, len(span) * self._highest)
        return counts

    def frames(self, span: FrameSpan) -> Frames:
        """Return the frames of a span one by one: (n, H, W)."""
        frames: Frames = self._read("frames", span, (len(span), *self.info.frame_shape), self._highest)
        return frames

    def packed(self, span: FrameSpan) -> NDArray[np.uint8]:
        """Return the frames of a span, eight pixels to a byte: see `photonpano.PackedSource`."""
        height, width = self.info.frame_shape
        packed: NDArray[np.uint8] = self._read("packed", span, (len(span), height, -(-width // 8)), 255)
        return packed

    def corrected(self, counts: Counts, n_frames: int) -> FluxImage:
        """Take everything but the flux out of a sum of frames: see `photonpano.LinearlyCorrectedSource`."""
        with self._attributing("correcting"):
            return self._image("corrected", self.given.corrected(counts, n_frames), counts.shape)

    def weights(self) -> FluxImage:
        """Return what a frame of each pixel is worth: see `photonpano.WeightedSource`."""
        with self._attributing("weights()"):
            return self._image("weights", self.given.weights(), self.info.frame_shape)

    @property
    def light(self) -> Light:
        """The gain of each frame."""
        with self._attributing("light"):
            light: Light = self.given.light
            return light

    @property
    def camera(self) -> Camera:
        """The camera of all frames."""
        with self._attributing("camera"):
            camera: Camera = self.given.camera
            return camera

    def colours(self) -> Mapping[str, PluginSource]:
        """Return a source for each colour: see `photonpano.ColouredSource`."""
        return self._colours

    @cached_property
    def _colours(self) -> Mapping[str, PluginSource]:
        with self._attributing("colours()"):
            colours = {name: PluginSource(each, self._origin) for name, each in self.given.colours().items()}
        for name, each in colours.items():
            each._of = self, name
        return colours

    def clear_mix(self) -> FloatArray:
        """Return the flux of a clear pixel: see `photonpano.ColouredSource`."""
        with self._attributing("clear_mix()"):
            return np.asarray(self.given.clear_mix(), np.float64)

    def truth(self) -> Mapping[str, NDArray[np.generic]]:
        """Return the ground truth: see `photonpano.KnowsTruth`."""
        with self._attributing("truth()"):
            found: Any = self.given.truth()
            if not isinstance(found, Mapping):
                raise BrokenContract(f"truth() returns a mapping of arrays by name, got {shown(found)}")
            truth: Mapping[str, NDArray[np.generic]] = found
            return truth

    def sharp_view(self, frame: int) -> FluxImage:
        """Return the flux of a frame without noise: see `photonpano.KnowsSharpViews`."""
        with self._attributing("sharp_view()"):
            return self._image("sharp_view", self.given.sharp_view(frame), self.info.frame_shape)

    def close(self) -> None:
        """Close the source; a failure is logged, since what was read from it is not affected."""
        try:
            with self._attributing("closing"):
                self.given.close()
        except PluginError as error:
            logger.warning("%s", error)

    @property
    def _highest(self) -> int:
        """The highest value of a pixel in a frame."""
        return 1 if self.info.kind == "binary" else 2**self.info.bit_depth - 1

    def _attributing(self, where: str) -> AbstractContextManager[None]:
        return nullcontext() if self._origin is None else attributing(self._origin, where)

    def _image(self, what: str, found: Any, shape: tuple[int, ...]) -> FluxImage:
        """Check an image of numbers; `what` is the name of the method that returned it."""
        if self._origin is not None and not (
            isinstance(found, np.ndarray) and found.dtype.kind == "f" and found.shape == shape
        ):
            raise BrokenContract(f"{what}() returns {shape} of float32, got {shown(found)}")
        image: FluxImage = found
        return image

    def _read(self, what: str, span: FrameSpan, shape: tuple[int, ...], highest: int) -> Any:
        """Read a span with a method of the source, and check the array."""
        method: Callable[[FrameSpan], Any] = getattr(self.given, what)
        if self._origin is None:
            return method(span)
        with self._attributing(str(span)):
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

    def _require_kept(self, what: str, method: Callable[[FrameSpan], Any], span: FrameSpan, found: NDArray[Any]) -> None:
        """Refuse a source that changes an array after it has returned it, as one with a single buffer does."""
        kept = found.copy()
        last = self.info.n_frames - 1
        for frame in {min(span.stop, last), max(span.start - 1, 0)}:
            try:
                method(FrameSpan(frame, frame + 1))
            except Exception:
                return  # it is raised again where that frame is needed
        if not np.array_equal(kept, found):
            raise BrokenContract(f"the array that {what}() returned changed when other frames were read; return a new array")


def _colour_of(capture: PluginSource, name: str) -> PluginSource:
    return capture.colours()[name]


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
