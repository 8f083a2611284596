"""A source as its plugin gives it: errors name the plugin, and properties and arrays are checked."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonpano.contracts.attribution import attributing
from photonpano.contracts.protocols import ColouredSource, KnowsSharpViews, KnowsTruth, PackedSource, Source
from photonpano.contracts.requirements import (
    require_info,
    require_mask,
    require_range,
    require_read,
    require_response,
    require_sharp_view,
    require_truth,
)
from photonpano.errors import PluginError
from photonpano.geometry import Camera
from photonpano.text import listed
from photonpano.values import BoolArray, Counts, FloatArray, FluxImage, Frames, FrameSpan, Light, Response, StreamInfo

logger = logging.getLogger(__name__)

_OPTIONAL: dict[str, Any] = {
    "packed": PackedSource,
    "colours": ColouredSource,
    "truth": KnowsTruth,
    "sharp_view": KnowsSharpViews,
}


class PluginSource:
    """A source as its plugin gives it.

    Reading a span raises a `PluginError` if the source failed with an exception that is not for users, or broke its contract:
    if an array has another shape or type, or at the first read values that frames of this depth cannot have.

    Attributes:
        given: what the plugin has built.
        info: frames, size, rate.
        valid: (H, W) mask.
        response: how flux becomes counts.
        opener: opens the source in another process, where it travels as this; None for a source that travels as it is.
    """

    opener: Callable[[], PluginSource] | None = None

    def __init__(self, source: Source, origin: str | None) -> None:
        """Take the source, and who provides it; None for a source that is neither checked nor named.

        Raises a `PluginError` if `info`, `valid` or `response` is not what it should be.
        """
        self.given: Any = source
        self._origin = origin
        self._read_before: set[str] = set()
        self._of: tuple[PluginSource, str] | None = None
        with self._attributing("opening"):
            self._warn_of_removed()
            self._offered = [name for name, protocol in _OPTIONAL.items() if isinstance(source, protocol)]
            checked = origin is not None
            self.info: StreamInfo = require_info(source.info) if checked else source.info
            self.valid: BoolArray = require_mask(source.valid, self.info.frame_shape) if checked else source.valid
            self.response: Response = require_response(source.response) if checked else source.response

    def __reduce__(self) -> Any:
        """Travel as what opens it; the source of a colour as a colour of the capture."""
        if self._of is not None:
            return _colour_of, self._of
        return (PluginSource, (self.given, self._origin)) if self.opener is None else (_opened, (self.opener,))

    def offers(self, name: str) -> bool:
        """Return whether the source has an optional method."""
        return name in self._offered

    def counts(self, span: FrameSpan) -> Counts:
        """Sum the frames of a span: (H, W) uint32."""
        return self._read("counts", span, self.info.frame_shape, len(span) * self._highest)

    def frames(self, span: FrameSpan) -> Frames:
        """Return the frames of a span one by one: (n, H, W)."""
        return self._read("frames", span, (len(span), *self.info.frame_shape), self._highest)

    def packed(self, span: FrameSpan) -> NDArray[np.uint8]:
        """Return the frames of a span, eight pixels to a byte: see `photonpano.PackedSource`."""
        height, width = self.info.frame_shape
        return self._read("packed", span, (len(span), height, -(-width // 8)), 255)

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
            return require_truth(self.given.truth())

    def sharp_view(self, frame: int) -> FluxImage:
        """Return the flux of a frame without noise: see `photonpano.KnowsSharpViews`."""
        with self._attributing("sharp_view()"):
            return require_sharp_view(self.given.sharp_view(frame), self.info.frame_shape)

    def close(self) -> None:
        """Close the source; a failure is logged, since what was read from it is not affected."""
        try:
            with self._attributing("closing"):
                self.given.close()
        except PluginError as error:
            logger.warning("%s", error)

    def _warn_of_removed(self) -> None:
        """Warn of what sources offered until 0.2: a run would miss a correction without a word."""
        given = self.given
        used = {name: callable(getattr(given, name, None)) for name in ("corrected", "weights")}
        used |= {"light": isinstance(getattr(given, "light", None), Light)}
        used |= {"camera": isinstance(getattr(given, "camera", None), Camera)}
        if names := [name for name, is_used in used.items() if is_used]:
            logger.warning(
                "%s: no longer used of a source: %s; correct its frames, or write `corrections` or `light` in the spec",
                self._origin or type(given).__name__,
                listed(names),
            )

    @property
    def _highest(self) -> int:
        return 1 if self.info.kind == "binary" else 2**self.info.bit_depth - 1

    def _attributing(self, where: str) -> AbstractContextManager[None]:
        return nullcontext() if self._origin is None else attributing(self._origin, where)

    def _read(self, what: str, span: FrameSpan, shape: tuple[int, ...], highest: int) -> NDArray[Any]:
        """Read a span with a method of the source, and check the array."""
        method: Callable[[FrameSpan], NDArray[Any]] = getattr(self.given, what)
        if self._origin is None:
            return method(span)
        with self._attributing(str(span)):
            found = require_read(method(span), what, shape)
            if what not in self._read_before:
                require_range(found, what, highest)
                self._read_before.add(what)
            return found


@lru_cache(maxsize=1)
def _opened(opener: Callable[[], PluginSource]) -> PluginSource:
    """Open a source, once in a process as long as tasks of one run come; openers of one run are equal."""
    return opener()


def _colour_of(capture: PluginSource, name: str) -> PluginSource:
    return capture.colours()[name]
