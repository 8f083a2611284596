"""See a capture behind a colour filter array as one grey source, and as one source for each colour."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from photonpano.protocols import LinearlyCorrectedSource
from photonpano.reading import COLOURS
from photonpano.source_wrapper import (
    LensedWrapper,
    LinearlyCorrectedWrapper,
    PackedWrapper,
    SourceWrapper,
    TruthWrapper,
    capabilities_of,
    with_capabilities,
)
from photonpano.threads import Guard
from photonpano.values import Decision

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from photonpano.protocols import Source
    from photonpano.values import BoolArray, Counts, FloatArray, FluxImage, Response

_SPANS, _SPAN_FRAMES = 16, 256
"""The gains are measured in 16 spans of 256 frames all over the capture."""
_CELL_PX = 16
"""Side of the squares of the sensor whose clear and coloured pixels are compared, px."""
_MOSTLY = 0.5
"""Share of clear pixels from which on the motion is estimated from them alone."""
_LEAST_GAIN = 0.05
"""A colour is brightened by 20 at most: in the light of a red lamp, blue pixels see noise."""
_MIX_STD = 0.3
"""Prior standard deviation of the factors of a clear pixel, relative to their mean."""
_MANY_FRAMES = 1e6


class FilteredSource(SourceWrapper):
    """A source behind a colour filter array: a `ColouredSource` and a `WeightedSource`, made by `filtered`.

    A pixel whose colour has the gain g is lit with the probability `p = 1 - exp(-g f)`, and the best pixel with
    `q = 1 - (1 - p)^(1 / g)`. Sums are corrected from p to q, linearly around the mean of the colour. Such a pixel has seen g
    times the photons, and so carries the information of g frames of the best one.

    If half of the pixels are clear, the others are left out of the grey source: they see few photons, and as they show what is
    red or blue, they draw a pattern that stands still in the frame.
    """

    def __init__(self, source: Source, colour: Callable[[], NDArray[np.int8]], decisions: list[Decision]) -> None:
        """Take the source, the place in `COLOURS` of the colour of its pixels, (H, W), and the decisions taken so far."""
        super().__init__(source)
        self._colour, self._decisions = colour, decisions
        self._lock = Guard()
        self._balance: _Balance | None = None

    @property
    def decisions(self) -> list[Decision]:
        """What was chosen because of what the capture shows."""
        self._balanced()
        return self._decisions

    def corrected(self, counts: Counts, n_frames: int) -> FluxImage:
        """Make the sums of all colours alike: see `LinearlyCorrectedSource`."""
        summed = _corrected(self.wrapped, counts, n_frames)
        balance = self._balanced()
        return np.asarray(summed * balance.slope + np.float32(n_frames) * balance.offset, np.float32)

    def weights(self) -> FluxImage:
        """See `WeightedSource`."""
        return self._balanced().weight

    def colours(self) -> Mapping[str, Source]:
        """See `ColouredSource`."""
        colour = self._colour()
        masks = {name: colour == place for place, name in enumerate(COLOURS)}
        return {name: of_pixels(self.wrapped, mask) for name, mask in masks.items() if mask.any()}

    def clear_mix(self) -> FloatArray:
        """See `ColouredSource`."""
        return self._balanced().clear_mix

    def __getstate__(self) -> dict[str, Any]:
        """Travel with what is known of the colours, so that no frames are read for it again."""
        self._balanced()
        return {**self.__dict__, "_colour": partial(_same, self._colour())}

    def _balanced(self) -> _Balance:
        with self._lock:
            if self._balance is None:
                self._balance = _Balance.of(self.wrapped, self._colour(), self._decisions)
            return self._balance


def _same(colour: NDArray[np.int8]) -> NDArray[np.int8]:
    return colour


def filtered(source: Source, colour: Callable[[], NDArray[np.int8]], decisions: list[Decision]) -> FilteredSource:
    """Return the grey source, and the colours, of a capture whose pixels have colours.

    Args:
        source: the capture.
        colour: returns the place in `COLOURS` of the colour of each pixel, (H, W).
        decisions: what was chosen because of what the capture shows; the gains of the colours are added.
    """
    kept = PackedWrapper, TruthWrapper, LensedWrapper
    capabilities: list[type[SourceWrapper]] = [each for each in capabilities_of(source) if each in kept]
    return with_capabilities(FilteredSource, capabilities)(source, colour, decisions)


def of_pixels(source: Source, pixels: BoolArray) -> OnePart:
    """Return the same frames, in which only some of the pixels are valid.

    Args:
        source: the capture; closing it closes the part.
        pixels: (H, W), those to keep.
    """
    kept = PackedWrapper, LinearlyCorrectedWrapper, LensedWrapper
    return with_capabilities(OnePart, [each for each in capabilities_of(source) if each in kept])(source, pixels)


class OnePart(SourceWrapper):
    """Some pixels of a source: made by `of_pixels`."""

    def __init__(self, source: Source, pixels: BoolArray) -> None:
        super().__init__(source)
        self._valid = source.valid & pixels
        self._valid.flags.writeable = False

    @property
    def valid(self) -> BoolArray:
        """(H, W) mask."""
        return self._valid


@dataclass(frozen=True, slots=True, eq=False)
class _Balance:
    """What makes the sums of all colours alike.

    Attributes:
        weight: (H, W) float32, what a frame of each pixel is worth: the flux of its colour, relative to the brightest one; 0
            beside clear pixels, if most pixels are clear.
        slope: (H, W) float32, factor of the counts.
        offset: (H, W) float32, added for each frame.
        clear_mix: (3,) factors of red, green and blue in clear pixels.
    """

    weight: FluxImage
    slope: FluxImage
    offset: FluxImage
    clear_mix: FloatArray

    @classmethod
    def of(cls, source: Source, colour: NDArray[np.int8], decisions: list[Decision]) -> _Balance:
        """Measure the brightness of the colours in frames all over the capture; add it to the decisions."""
        spans = source.info.spread(_SPANS, _SPAN_FRAMES)
        n_frames, valid = len(spans[0]), source.valid
        sums = np.stack([_corrected(source, source.counts(span), n_frames) for span in spans])
        n_seen = n_frames * len(spans)
        mean, pixels = sums.sum(axis=0) / np.float32(n_seen), [valid & (colour == place) for place in range(len(COLOURS))]
        means = np.array([mean[each].mean() if each.any() else np.nan for each in pixels], np.float32)
        flux = source.response.flux(means, _MANY_FRAMES).astype(np.float64)
        gains = np.clip(flux / max(np.nanmax(flux), 1e-9), _LEAST_GAIN, None)
        weight, slope, offset = (
            np.ones(mean.shape, np.float32),
            np.ones(mean.shape, np.float32),
            np.zeros(mean.shape, np.float32),
        )
        clear = colour == list(COLOURS).index("clear")
        mostly_clear = float(clear.mean()) >= _MOSTLY
        for place, name in enumerate(COLOURS):
            if not np.isfinite(gains[place]):
                continue
            mask = colour == place
            weight[mask] = 0 if mostly_clear and name != "clear" else gains[place]
            slope[mask], offset[mask] = _line(source.response, float(means[place]), float(gains[place]))
            reason = f"flux of {name} pixels, relative to the brightest colour, from {n_seen} frames"
            decisions.append(Decision(f"{name}_gain", round(float(gains[place]), 4), reason))
        return cls(weight, slope, offset, _clear_mix(sums, n_frames, pixels, source.response))


def _corrected(source: Source, counts: Counts, n_frames: int) -> FluxImage:
    summed = source.corrected(counts, n_frames) if isinstance(source, LinearlyCorrectedSource) else counts
    return np.asarray(summed, np.float32)


def _line(response: Response, mean: float, gain: float) -> tuple[float, float]:
    """Return slope and offset of the line that turns mean counts of a colour into those of the brightest one, near a mean."""
    at = np.array([0.95, 1.05], np.float32) * np.float32(max(mean, 1e-6))
    low, high = response.mean_count(np.asarray(response.flux(at, _MANY_FRAMES) / gain, np.float32)).astype(np.float64)
    slope = (high - low) / (float(at[1]) - float(at[0]))
    return slope, (low + high) / 2 - slope * float(at.mean(dtype=np.float64))


def _clear_mix(sums: NDArray[np.float32], n_frames: int, pixels: list[BoolArray], response: Response) -> FloatArray:
    """Estimate the factors of red, green and blue in clear pixels, from squares of the sensor: least squares with a prior.

    Args:
        sums: (S, H, W) of spans.
        n_frames: of a span.
        pixels: (H, W) masks of the colours.
        response: the camera's response.
    """
    if not pixels[3].any():
        return np.ones(3)
    area = np.stack([_cells(each[None].astype(np.float32))[0] for each in pixels])
    photons = np.stack([_cells(sums * each) for each in pixels])
    seen = (area > 0).all(axis=0)
    if not seen.any():
        return np.ones(3)
    n = area[:, seen][:, None] * n_frames
    flux = response.flux((photons[:, :, seen] / n).astype(np.float32), _MANY_FRAMES).astype(np.float64).reshape(4, -1)
    *parts, clear = flux
    equal = clear.sum() / max(float(np.sum(parts)), 1e-9)
    # Photon noise of the two sides of the equation.
    shares = np.broadcast_to(n, (4, sums.shape[0], int(seen.sum()))).reshape(4, -1)
    variance = np.maximum(flux, 1e-6) / shares
    weight = 1 / (variance[3] + equal**2 * variance[:3].sum(axis=0))
    design = np.stack(parts, axis=1)
    normal = design.T @ (weight[:, None] * design) + np.eye(3) / (_MIX_STD * equal) ** 2
    right = design.T @ (weight * (clear - equal * design.sum(axis=1)))
    return np.asarray(np.maximum(equal + np.linalg.solve(normal, right), 0), np.float64)


def _cells(images: NDArray[np.float32]) -> NDArray[np.float32]:
    """Sum squares of pixels: (S, H, W) to (S, h, w); those that the border cuts are left out."""
    n, height, width = images.shape
    h, w = height // _CELL_PX, width // _CELL_PX
    cut = images[:, : h * _CELL_PX, : w * _CELL_PX].reshape(n, h, _CELL_PX, w, _CELL_PX)
    return np.asarray(cut.sum(axis=(2, 4)), np.float32)
