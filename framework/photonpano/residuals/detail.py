"""Find the finest detail of a panorama that is more than noise, from what pictures of two halves of the frames share.

The measure is the Fourier ring correlation of electron microscopy: both pictures show one scene with independent noise, so
that their correlation at a spatial frequency says how much of the picture is scene there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from photonpano.values import BoolArray, FloatArray, FluxImage

_SQUARE_PX = 64  # side of the squares in which spectra are taken, half of which overlap; less on a small canvas
_SMALLEST_PX = 16
_LEAST_SEEN = 0.5  # of the window of a square
REAL = 0.5  # correlation with the scene down to which detail counts as real: at 1/2, the halves correlate by 1/7
_PARTS = 3  # into which squares are divided by the frames that saw them
_FEWEST_SQUARES = 27  # of which such parts are made
_LOWEST = 2  # ring of the lowest frequency that counts: below, the window smears the mean


@dataclass(frozen=True, slots=True, eq=False)
class Detail:
    """The correlation of the pictures of two halves of the frames, by spatial frequency.

    The first row is that of all squares of the panorama; others are of thirds of them, from those that few frames saw.
    """

    frequencies: FloatArray  # (K,) cycles per px of a frame
    halves: FloatArray  # (R, K) correlation; no row where the halves share no square
    frames: FloatArray  # (R,) mean number of frames that saw a pixel
    # from 0 to 1: 1 where the frames in which a place is in view show it at one place of the grid of the sensor, along an axis
    phase: float = 0.0
    # root mean square difference of the halves, in units of what the part of `panorama-std` by photons explains; NaN where
    # they share no pixel
    noise: float = 1.0

    @property
    def scene(self) -> FloatArray:
        """The expected correlation of the picture of all frames with the scene: (R, K).

        Where the halves correlate by c, a picture with the light of both correlates with the scene by `sqrt(2 c / (1 + c))`.
        Beyond 1/2 period per px, both may also show coarser structure, that of frequency 1 - f, at a place of the grid that
        they share: natural scenes, and the area of a pixel, pass it on `(f / (1 - f))^2` times as strongly.
        """
        common, beyond = np.clip(self.halves, 0, 1), np.clip(self.frequencies, 0.5, 0.999)
        aliased = np.where(self.frequencies > 0.5, self.phase * (beyond / (1 - beyond)) ** 2, 0)
        return np.asarray(np.sqrt(2 * common / (1 + common) / (1 + aliased**2)))

    @property
    def finest_px(self) -> list[float | None]:
        """The period of the finest real detail of each row, in px of a frame; None if there is none."""
        return [finest_period(self.frequencies, each) for each in self.scene]


def finest_period(frequencies: FloatArray, correlation: FloatArray) -> float | None:
    """Return the period at which a correlation falls below what is real; that of the last frequency if it does not fall."""
    below = np.flatnonzero(correlation[_LOWEST:] < REAL) + _LOWEST
    if not len(below):
        return float(1 / frequencies[-1])
    ring = int(below[0])
    if ring == _LOWEST:
        return None
    share = (correlation[ring - 1] - REAL) / (correlation[ring - 1] - correlation[ring])
    return float(1 / (frequencies[ring - 1] + share * (frequencies[ring] - frequencies[ring - 1])))


def detail_of(first: FluxImage, last: FluxImage, frames: FluxImage, seen: BoolArray, scale: float = 1, **rest: float) -> Detail:
    """Correlate pictures of two halves of the frames: (H, W, C) each, on a canvas of `scale` px for one of a frame.

    `frames` (H, W, C) are those of both that saw a pixel, `seen` (H, W, C) where both did; `rest` are `noise` and `phase`.
    """
    side = _SQUARE_PX
    while side > min(seen.shape[:2]):
        side //= 2
    frequencies = np.arange(side // 2 + 1) / side * scale
    nothing = Detail(frequencies, np.zeros((0, len(frequencies))), np.zeros(0), **rest)
    if side < _SMALLEST_PX:
        return nothing
    rows = range(0, seen.shape[0] - side + 1, side // 2)
    strips = (slice(top, top + side) for top in rows)
    found = [_spectra(first[each], last[each], frames[each], seen[each]) for each in strips]
    spectra, weights = (np.concatenate(each) for each in zip(*found, strict=True))
    if not len(weights):
        return nothing
    order = np.argsort(weights)
    parts = np.array_split(order, _PARTS) if len(order) >= _FEWEST_SQUARES else []
    sums = np.array([spectra[part].sum(axis=0) for part in (order, *parts)])
    wide = np.pad(sums, ((0, 0), (0, 0), (1, 1)), mode="edge")
    sums = wide[..., :-2] + wide[..., 1:-1] + wide[..., 2:]  # single rings have few samples
    halves = sums[:, 0] / np.sqrt(np.maximum(sums[:, 1] * sums[:, 2], 1e-30))
    return Detail(frequencies, halves, np.array([weights[part].mean() for part in (order, *parts)]), **rest)


def _spectra(first: FluxImage, last: FluxImage, frames: FluxImage, seen: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Return what the squares of a strip have in rings of frequency: (N, 3, K), and the frames that saw them, (N,).

    The three are the product of the spectra of both pictures, and the power of each.
    """
    side = len(seen)
    hann = np.hanning(side + 1)[:-1].astype(np.float32)
    window = np.multiply.outer(hann, hann)

    def squares(image: FluxImage | BoolArray) -> FluxImage:
        there = np.lib.stride_tricks.sliding_window_view(image, side, axis=1)[:, :: side // 2]
        return np.asarray(there.transpose(1, 2, 0, 3).reshape(-1, side, side), np.float32)  # of each colour, (N, side, side)

    windows = window * squares(seen)
    shown = windows.sum(axis=(1, 2)) >= _LEAST_SEEN * window.sum()
    windows = windows[shown]
    area = windows.sum(axis=(1, 2))
    means = [(squares(image)[shown] * windows).sum(axis=(1, 2)) / area for image in (first, last, frames)]
    lit, other = (
        np.fft.rfft2((squares(image)[shown] - mean[:, None, None]) * windows)
        for image, mean in zip((first, last), means[:2], strict=True)
    )
    down, across = np.fft.fftfreq(side)[:, None] * side, np.fft.rfftfreq(side) * side
    rings = np.rint(np.hypot(down, across)).astype(int).ravel()
    # Half of the plane is left out, that of negative frequencies across.
    both = np.where((across > 0) & (across < side / 2), 2.0, 1.0) * np.ones_like(down)
    in_rings = (rings[:, None] == np.arange(side // 2 + 1)) * both.ravel()[:, None]
    products = np.stack([(lit * other.conj()).real, abs(lit) ** 2, abs(other) ** 2], axis=1)
    return products.reshape(len(area), 3, rings.size) @ in_rings, np.asarray(means[2], np.float64)
