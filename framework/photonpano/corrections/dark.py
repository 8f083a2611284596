"""Dark counts, measured in dark frames, and subtracted; and masks of bad pixels, marked in a file or found in the capture."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from pydantic import Field

from photonpano.capture import capture_of
from photonpano.corrections.geometry import Correction
from photonpano.errors import InputError
from photonpano.plugins.contributions import FrameRange, SpecPath
from photonpano.reading import read_array, read_arrays, read_picture
from photonpano.robust import robust_std
from photonpano.values import FrameSpan

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

    from photonpano.capture import Capture
    from photonpano.contracts.protocols import Source
    from photonpano.corrections.geometry import Decide, Pixels
    from photonpano.values import BoolArray, FluxImage

DARK_FILE = "a file from `photonpano dark`, or a .npy file of rates, of the size of the frames at this place of the list"
_AT_ONCE = 1024  # frames summed between two reports of progress
THRESHOLD = 10.0  # default threshold, in robust standard deviations: it finds a few percent of the pixels of real sensors
_SPANS, _SPAN_FRAMES = 16, 256  # spans all over the capture, and frames of each; their sum blurs the scene
_REACH, _LONGEST_REACH = 2, 5  # neighbourhood radius, px; the longer one is for colours of which a filter array has few pixels
_ENOUGH = 6.5  # known neighbours, on average, from which on the neighbourhood is not widened
# A pixel is hot if it is brighter than the top 1/6 of its neighbours by the threshold. A straight edge or a line of the scene
# makes at least 1/6 of them bright, at the border of the frame as well. Where many pixels are hot, it is the share of the
# neighbours that are hot by chance, and two standard deviations of it.
_LINE_SHARE = 1 / 6
_MIN_KNOWN = 6  # least number of known neighbours of a pixel that is compared


@dataclass(frozen=True, slots=True, eq=False)
class DarkFrames:
    """Dark counts of each pixel, from frames taken with the lens covered."""

    rates: FluxImage  # (H, W) float32, dark counts per frame: photons of binary frames, grey values of others
    n_frames: int | None  # frames that they were measured in; None if unknown


class DarkCounts(Correction):
    """Subtracts dark counts from the flux, pixel by pixel."""

    name: ClassVar[str] = "dark-counts"
    dark: SpecPath = Field(description=f"dark counts per frame: {DARK_FILE}")
    limit: float = Field(
        0.1,
        gt=0,
        le=3,
        description="dark counts per frame above which a pixel of binary frames is masked, because it adds more noise "
        "than light",
    )

    @property
    def changes_sums(self) -> bool:
        """See `Correction`."""
        return True

    def applied(self, pixels: Pixels, capture: Capture, decide: Decide | None) -> Pixels:
        """Add the rates to subtract, and mask pixels where they exceed the limit; see `Correction`."""
        rates = read_dark(self.dark).rates
        pixels.require(rates.shape, self.dark)
        noted = replace(pixels, dark_rates=pixels.dark_rates + rates)
        if capture.info.kind != "binary":
            return noted
        high = noted.dark_rates > self.limit
        if decide is not None:
            n_masked = int((pixels.valid & high).sum())
            reason = f"pixels with more than limit = {self.limit:g} dark counts a frame are masked"
            decide("dark_counts_masked", n_masked, reason)
        # Masked pixels need no correction, whose factor would be large.
        return replace(noted, valid=pixels.valid & ~high, dark_rates=np.where(high, np.float32(0), noted.dark_rates))


def measure_dark(source: Source, advance: Callable[[int], object]) -> DarkFrames:
    """Measure the dark counts of a capture that was recorded with the lens covered; `advance` is given numbers of frames read.

    The rate of a binary pixel is `-ln(1 - k / n)` for k counts in n frames, as its flux is. The rate of other pixels is the
    mean of their grey values.
    """
    info, spans = source.info, list(source.info.span.blocks(_AT_ONCE))
    counts = np.zeros(info.frame_shape, np.uint64)
    for span, summed in zip(spans, capture_of(source).chunks(spans), strict=True):
        counts += summed
        advance(len(span))
    mean = (counts / info.n_frames).astype(np.float32)
    return DarkFrames(source.response.flux(mean, info.n_frames) if info.kind == "binary" else mean, info.n_frames)


def write_dark(path: Path, dark: DarkFrames) -> None:
    """Store dark counts as an .npz archive, which `read_dark` reads."""
    np.savez_compressed(path, rates=dark.rates, n_frames=np.array(dark.n_frames))


def read_dark(path: Path) -> DarkFrames:
    """Read dark counts: an .npz archive of `write_dark`, or a .npy file of rates. An `InputError` tells what is wrong."""
    arrays = read_arrays(path, "a file of dark counts", ("rates", "n_frames"))
    rates, n_frames = arrays.get("rates", arrays.get("")), arrays.get("n_frames")
    if rates is None:
        raise InputError(f"{path} is an archive without `rates`; name what `photonpano dark` wrote, or a .npy file of rates")
    if rates.ndim != 2 or rates.dtype.kind not in "fiu":
        raise InputError(f"{path} holds {rates.dtype} of shape {rates.shape}; dark counts are numbers of shape (height, width)")
    with np.errstate(over="ignore"):
        rates = rates.astype(np.float32)
    if not (np.isfinite(rates).all() and (rates >= 0).all()):
        row, column = np.argwhere(~(np.isfinite(rates) & (rates >= 0)))[0].tolist()
        raise InputError(
            f"{path} holds dark counts that are negative or not finite, first {rates[row, column]} at row {row}, "
            f"column {column}"
        )
    if n_frames is not None and (n_frames.shape != () or n_frames.dtype.kind not in "iu" or n_frames < 1):
        raise InputError(f"{path} is damaged: n_frames is not a positive integer; write it again with `photonpano dark`")
    return DarkFrames(rates, None if n_frames is None else int(n_frames))


class HotPixels(Correction):
    """Finds hot pixels and masks them; the motion fills them."""

    name: ClassVar[str] = "hot-pixels"
    dark: SpecPath | None = Field(
        None,
        description=f"dark counts per frame: {DARK_FILE}; by default, pixels of the capture that are much brighter or darker "
        "than their neighbours are masked, for which the camera has to move",
    )
    threshold: float = Field(
        THRESHOLD,
        gt=0,
        le=1000,
        description="smallest deviation of a hot pixel, in robust standard deviations of the other pixels",
    )

    def applied(self, pixels: Pixels, capture: Capture, decide: Decide | None) -> Pixels:
        """Mask the pixels that stand out; see `Correction`."""
        if self.dark is not None:
            dark = read_dark(self.dark)
            pixels.require(dark.rates.shape, self.dark)
            bad, limit = hot_in_the_dark(dark, self.threshold, pixels.valid)
            how = f"have more than {limit:.2g} dark counts a frame in {self.dark.name}"
        elif decide is not None:
            bad, n_frames = _standing_out(pixels, capture, self.threshold)
            how = f"stand out from their neighbours in {n_frames} frames sampled all over the capture"
        else:
            return pixels
        if decide is not None:
            n_bad, n_pixels = int((bad & pixels.valid).sum()), int(pixels.valid.sum())
            share = n_bad / max(n_pixels, 1)
            decide("hot_pixels", n_bad, f"{share:.2%} of {n_pixels} pixels {how}, by threshold = {self.threshold:g}")
        return pixels.without(bad)


def hot_in_the_dark(dark: DarkFrames, threshold: float, valid: BoolArray) -> tuple[BoolArray, float]:
    """Return the pixels (H, W) that have far more dark counts than most, and the rate above which pixels are hot.

    The limit lies `threshold` standard deviations above the median of the `valid` pixels. The standard deviation comes from the
    median absolute deviation, and is at least that of photon noise.
    """
    rates = dark.rates[valid]
    if not rates.size:
        return np.zeros(valid.shape, np.bool_), np.inf
    median = float(np.median(rates))
    std = robust_std(rates - median)
    if dark.n_frames is not None:
        # One count by chance must not make a pixel hot.
        std = max(std, float(np.sqrt(max(median, 1 / dark.n_frames) / dark.n_frames)))
    limit = median + threshold * std
    return dark.rates > limit, limit


def _standing_out(pixels: Pixels, capture: Capture, threshold: float) -> tuple[BoolArray, int]:
    """Return the pixels of a capture that are brighter or darker than their neighbours, and the number of frames compared."""
    spans = capture.info.spread(_SPANS, _SPAN_FRAMES)
    seen = sum(map(len, spans))
    counts = np.sum(list(capture.chunks(spans)), axis=0)
    response, frames = capture.response, float(seen)
    image = response.stabilised(response.flux(np.asarray(counts / seen, np.float32), frames), frames)
    usable = pixels.valid & ~pixels.interpolated
    image, noise_std = image.ravel()[pixels.index], float(np.max(response.stabilised_std(frames)))
    found = [outliers(np.where(usable & part, image, np.float32(np.nan)), noise_std, threshold) for part in pixels.alike()]
    return np.asarray(np.logical_or.reduce(found)), seen


def outliers(image: FluxImage, noise_std: float, threshold: float) -> BoolArray:
    """Return the pixels that are brighter or darker than their neighbours: (H, W) bool, False at unknown pixels, which are NaN.

    Photon noise is uniform in the image, of the standard deviation `noise_std`; the threshold is in robust standard deviations.
    """
    around = sorted_neighbours(image, reach_of(image))
    differences = np.abs(image - brightest(around, 0.5))
    known = differences[np.isfinite(differences)]
    if not known.size:
        return np.zeros(image.shape, np.bool_)
    limit = threshold * max(robust_std(known), noise_std)
    by_chance = float(np.mean(known > limit))
    share = max(_LINE_SHARE, by_chance + 2 * np.sqrt(by_chance * (1 - by_chance) / around.shape[-1]))
    outside = np.fmax(image - brightest(around, share), darkest(around, share) - image)
    return np.asarray(outside > limit)


def reach_of(image: FluxImage) -> int:
    """Return the radius, in px, within which a pixel has neighbours enough: 2, or more where most pixels are unknown."""
    known = float(np.isfinite(image).mean())
    reach = _REACH
    while reach < _LONGEST_REACH and ((2 * reach + 1) ** 2 - 1) * known < _ENOUGH:
        reach += 1
    return reach


def sorted_neighbours(image: FluxImage, reach: int = _REACH) -> FluxImage:
    """Return the neighbours of each pixel within `reach` px in ascending order, (H, W, N); unknown ones, NaN, come last."""
    side = 2 * reach + 1
    padded = np.pad(image, reach, constant_values=np.nan)
    windows = sliding_window_view(padded, (side, side)).reshape(*image.shape, side * side)
    return np.sort(np.delete(windows, side * side // 2, axis=-1), axis=-1)


def brightest(around: FluxImage, share: float) -> FluxImage:
    """Return the value that the brightest share of the neighbours (H, W, N) of each pixel reach; NaN with fewer than 6."""
    known = _n_known(around)
    return _picked(around, known, known - np.floor(known * share))


def darkest(around: FluxImage, share: float) -> FluxImage:
    """Return, for each pixel, the value that the darkest share of its neighbours do not exceed: see `brightest`."""
    known = _n_known(around)
    return _picked(around, known, np.floor(known * share) - 1)


def _n_known(around: FluxImage) -> NDArray[np.intp]:
    return np.asarray(np.isfinite(around).sum(axis=-1, keepdims=True))


def _picked(around: FluxImage, known: NDArray[np.intp], place: NDArray[Any]) -> FluxImage:
    """Return the neighbours at a place of their order: (H, W)."""
    place = np.clip(place, 0, around.shape[-1] - 1).astype(np.intp)
    found = np.take_along_axis(around, place, axis=-1)
    return np.where(known >= _MIN_KNOWN, found, np.float32(np.nan))[..., 0]


class Mask(Correction):
    """Masks the pixels that a file marks as bad, in all frames or in some; the motion fills them."""

    name: ClassVar[str] = "mask"
    file: SpecPath = Field(
        description="a bool .npy file, true for bad pixels, or a .png picture in which bad pixels are not black; of "
        "the size of the frames at this place of the list"
    )
    frames: FrameRange | None = Field(
        None,
        description="the frames in which they are bad, [start, stop]: frames start to stop - 1 of the recording, whatever part "
        "of it is read; all by default",
    )

    def applied(self, pixels: Pixels, capture: Capture, decide: Decide | None) -> Pixels:
        """Mask the bad pixels; see `Correction`."""
        del capture, decide
        bad = _read_mask(self.file)
        pixels.require(bad.shape, self.file)
        return pixels.without(bad, self.frames and FrameSpan(*self.frames))


def _read_mask(path: Path) -> BoolArray:
    """Return the bad pixels: (H, W), those of a picture of 8 or 16 bits that are not black."""
    expected = "a mask of bad pixels"
    if path.suffix.lower() == ".png":
        import cv2

        otherwise = f"is not {expected}: it is no picture that can be read"
        return np.asarray(read_picture(path, otherwise, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH).any(axis=-1))
    mask = read_array(path, expected)
    if mask.dtype != np.bool_:
        raise InputError(
            f"{path} holds {mask.dtype} values; a mask is a .npy file of bool, true for pixels that must not be used"
        )
    return mask
