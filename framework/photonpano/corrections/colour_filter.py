"""Read the pattern of a colour filter array: keep the pixels of some colours, or see the capture as grey and in each colour."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal, get_args

import numpy as np
from pydantic import Field, model_validator

from photonpano.capture import Capture, Colours, LinearCorrection, capture_of
from photonpano.corrections.geometry import Correction
from photonpano.errors import InputError
from photonpano.photometry.images import sums_of_blocks
from photonpano.plugins.contributions import SpecPath
from photonpano.reading import COLOURS, bayer_array, read_filter_array
from photonpano.text import listed
from photonpano.values import Bayer, Decision

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from photonpano.contracts.protocols import Source
    from photonpano.corrections.geometry import Decide, Pixels
    from photonpano.values import BoolArray, Counts, FloatArray, FluxImage, Response

Colour = Literal["red", "green", "blue", "clear"]
_ALL = "all"
_SPANS, _SPAN_FRAMES = 16, 256  # gains are measured in 16 spans of 256 frames all over the capture
_CELL_PX = 16  # side of the squares of the sensor in which clear and coloured pixels are compared
_MOSTLY = 0.5  # share of clear pixels from which on the motion is estimated from them alone
_LEAST_GAIN = 0.05  # a colour is brightened by 20 at most: in the light of a red lamp, blue pixels see noise
_MIX_STD = 0.3  # prior standard deviation of the factors of a clear pixel, relative to their mean
_MANY_FRAMES = 1e6


class ColourFilter(Correction):
    """Makes the panorama in colour, or keeps the pixels of some colours, so that the pattern of the filters does not show."""

    name: ClassVar[str] = "colour-filter"
    pattern: Bayer | SpecPath | None = Field(
        None,
        description="the filter array, at this place of the list: rggb, bggr, grbg or gbrg for the two rows and columns of "
        "a Bayer array that repeat; or a file of the size of the frames, which is a .png picture, or a .npy file "
        "(height, width, 3) of uint8 in the order red, green, blue, where clear pixels are white, the others pure red, "
        "green or blue; by default the Bayer array that the capture gives",
    )
    keep: Literal["all"] | tuple[Colour, ...] = Field(
        ("clear",),
        description="the colours whose pixels are used; all makes the panorama in colour, and estimates the motion from all "
        "pixels",
    )
    others: Literal["mask", "interpolate"] = Field(
        "mask",
        description="the pixels of other colours: mask masks them, and the motion fills them; interpolate takes the mean of "
        "the kept pixels that touch them",
    )

    @model_validator(mode="after")
    def _some_others(self) -> ColourFilter:
        if self.keep == _ALL and self.others == "interpolate":
            raise ValueError("keep: all leaves no other colours to interpolate; leave out others, or list the colours to keep")
        return self

    @property
    def changes_sums(self) -> bool:
        """See `Correction`."""
        return self.others == "interpolate"

    @property
    def in_colour(self) -> bool:
        """Whether the panorama is in colour."""
        return self.keep == _ALL

    def applied(self, pixels: Pixels, capture: Capture, decide: Decide | None) -> Pixels:
        """Mark the colour of each pixel, or mask or interpolate those of other colours; see `Correction`."""
        del decide
        colour, what = self._pattern(pixels, capture)
        there = [name for place, name in enumerate(COLOURS) if (colour == place).any()]
        wanted = ("red", "green", "blue") if self.keep == _ALL else self.keep
        lacking = [name for name in wanted if name not in there]
        if lacking and (self.in_colour or len(lacking) == len(wanted)):
            keep = _ALL if self.keep == _ALL else f"[{', '.join(self.keep)}]"
            raise InputError(
                f"keep: {keep} needs {listed(lacking)} pixels, and {what} has {listed(there)} ones only; "
                f"keep: [{', '.join(there)}] makes a grey panorama of them"
            )
        if self.in_colour:
            return replace(pixels, colour=colour)
        kept = np.isin(colour, [place for place, name in enumerate(COLOURS) if name in wanted])
        if self.others == "mask":
            return pixels.without(~kept)
        return replace(pixels, interpolated=pixels.interpolated | ~kept)

    def _pattern(self, pixels: Pixels, capture: Capture) -> tuple[NDArray[np.int8], str]:
        """Return the place in `COLOURS` of the colour of each pixel, (H, W), and what to call the pattern in messages."""
        if isinstance(self.pattern, Path):
            pattern = read_filter_array(self.pattern)
            pixels.require(pattern.shape, f"pattern: {self.pattern}")
            return pattern, f"{self.pattern}"
        if self.pattern is not None:
            return bayer_array(self.pattern, pixels.shape), f"pattern: {self.pattern}"
        if capture.info.bayer is None:
            raise InputError(
                f"pattern is missing, and the capture does not give it; set it to a file, or to {', '.join(get_args(Bayer))}"
            )
        as_read = bayer_array(capture.info.bayer, capture.info.frame_shape)
        return as_read.ravel()[pixels.index], f"the array of the capture, {capture.info.bayer},"


def with_colours(source: Source, places: NDArray[np.int8], look: bool = True) -> Capture:
    """Return the grey capture, with its colours, of one whose pixels have colours.

    A pixel whose colour has the gain g is lit with the probability `p = 1 - exp(-g f)`, and the best pixel with
    `q = 1 - (1 - p)^(1 / g)`. Sums are corrected from p to q, linearly around the mean of the colour. Such a pixel has seen g
    times the photons, and so carries the information of g frames of the best one.

    If half of the pixels are clear, the others are left out of the grey capture: they see few photons, and what is red or blue
    would draw a pattern that stands still in the frame.

    Args:
        source: the capture, as it is corrected so far. The gains of the colours are added to its decisions.
        places: (H, W) the place in `COLOURS` of the colour of each pixel.
        look: whether to measure the gains, in frames all over the capture. If not, all colours are as bright.
    """
    capture = capture_of(source)
    pixels = [capture.valid & (places == place) for place in range(len(COLOURS))]
    for each in pixels:
        each.flags.writeable = False
    parts = {
        name: replace(capture, valid=each, decisions=())
        for place, (name, each) in enumerate(zip(COLOURS, pixels, strict=True))
        if (places == place).any()
    }
    shape = capture.info.frame_shape
    weight, slope, offset = np.ones(shape, np.float32), np.ones(shape, np.float32), np.zeros(shape, np.float32)
    decisions, mix = list(capture.decisions), np.ones(3)
    if look:
        spans = capture.info.spread(_SPANS, _SPAN_FRAMES)
        sums = np.stack([np.asarray(capture.corrected_counts(span), np.float32) for span in spans])
        n_frames, n_seen = len(spans[0]), sum(map(len, spans))
        mean = sums.sum(axis=0) / np.float32(n_seen)
        means = np.array([mean[each].mean() if each.any() else np.nan for each in pixels], np.float32)
        flux = capture.response.flux(means, _MANY_FRAMES).astype(np.float64)
        gains = np.clip(flux / max(np.nanmax(flux), 1e-9), _LEAST_GAIN, None)
        mostly_clear = float((places == list(COLOURS).index("clear")).mean()) >= _MOSTLY
        for place, name in enumerate(COLOURS):
            if not np.isfinite(gains[place]):
                continue
            mask = places == place
            weight[mask] = 0 if mostly_clear and name != "clear" else gains[place]
            slope[mask], offset[mask] = _line(capture.response, float(means[place]), float(gains[place]))
            reason = f"flux of {name} pixels, relative to the brightest colour, from {n_seen} frames"
            decisions.append(Decision(f"{name}_gain", round(float(gains[place]), 4), reason))
        mix = _clear_mix(sums, n_frames, pixels, capture.response)
    return replace(
        capture,
        steps=(*capture.steps, _as_float32, LinearCorrection(slope, offset)),
        weight=capture.weights() * weight,
        colour=Colours(parts, mix),
        decisions=tuple(decisions),
    )


def _as_float32(counts: Counts | FluxImage, n_frames: int) -> FluxImage:
    """Convert a sum, so that it is corrected in single precision."""
    del n_frames
    return np.asarray(counts, np.float32)


def _line(response: Response, mean: float, gain: float) -> tuple[float, float]:
    """Return slope and offset of the line that turns mean counts of a colour into those of the brightest one, near a mean."""
    at = np.array([0.95, 1.05], np.float32) * np.float32(max(mean, 1e-6))
    low, high = response.mean_count(np.asarray(response.flux(at, _MANY_FRAMES) / gain, np.float32)).astype(np.float64)
    slope = (high - low) / (float(at[1]) - float(at[0]))
    return slope, (low + high) / 2 - slope * float(at.mean(dtype=np.float64))


def _clear_mix(sums: NDArray[np.float32], n_frames: int, pixels: list[BoolArray], response: Response) -> FloatArray:
    """Estimate the factors of red, green and blue in clear pixels, from squares of the sensor: least squares with a prior.

    `sums` (S, H, W) are of `n_frames` each; `pixels` (H, W) are masks of the colours.
    """
    if not pixels[3].any():
        return np.ones(3)
    area = np.stack([sums_of_blocks(each.astype(np.float32), _CELL_PX) for each in pixels])
    photons = np.stack([sums_of_blocks(sums * each, _CELL_PX) for each in pixels])
    seen = (area > 0).all(axis=0)
    if not seen.any():
        return np.ones(3)
    n = area[:, seen][:, None] * n_frames
    flux = response.flux((photons[:, :, seen] / n).astype(np.float32), _MANY_FRAMES).astype(np.float64).reshape(4, -1)
    *parts, clear = flux
    equal = clear.sum() / max(float(np.sum(parts)), 1e-9)
    if not equal:
        return np.ones(3)
    # Photon noise of the two sides of the equation.
    shares = np.broadcast_to(n, (4, sums.shape[0], int(seen.sum()))).reshape(4, -1)
    variance = np.maximum(flux, 1e-6) / shares
    weight = 1 / (variance[3] + equal**2 * variance[:3].sum(axis=0))
    design = np.stack(parts, axis=1)
    normal = design.T @ (weight[:, None] * design) + np.eye(3) / (_MIX_STD * equal) ** 2
    right = design.T @ (weight * (clear - equal * design.sum(axis=1)))
    return np.asarray(np.maximum(equal + np.linalg.solve(normal, right), 0), np.float64)
