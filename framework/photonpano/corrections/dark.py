"""Dark counts: measure them in dark frames, store and read them, and subtract them from sums."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from pydantic import Field

from photonpano.capture import capture_of
from photonpano.corrections.pixels import Correction
from photonpano.errors import InputError
from photonpano.plugins.contributions import SpecPath
from photonpano.reading import read_arrays

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from photonpano.capture import Capture
    from photonpano.contracts.protocols import Source
    from photonpano.corrections.pixels import Decide, Pixels
    from photonpano.values import FluxImage

DARK_FILE = "a file from `photonpano dark`, or a .npy file of rates, of the size of the frames at this place of the list"
_AT_ONCE = 1024  # frames summed between two reports of progress


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
