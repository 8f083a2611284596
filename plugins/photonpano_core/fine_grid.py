"""Estimate the flux of a fine grid from the photons of its cells: expectation-maximisation, and denoising in between.

An image is denoised by collaborative filtering of similar patches (Dabov et al., "BM3D", IEEE TIP 2007, its first stage):
they are stacked, transformed together, and coefficients below the noise are set to 0. Compiled.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct

from photonpano import FloatArray, FluxImage
from photonpano.compiling import compiled
from photonpano.merging import LitFrames

# Noise that each round removes, in standard deviations of the photon noise of a cell: details come in from round to round.
STRENGTHS = (4.0, 3.0, 2.25, 1.7, 1.27, 0.95)
_STEPS = 6  # steps of expectation-maximisation in a round
_MATCHED_ROUNDS = 3  # rounds for which similar patches are looked for once
_FEWEST_FRAMES = 0.25  # frames of a cell, smoothed, below which its noise grows no more
_KEPT_PX = 8.0  # standard deviation of the Gaussian over which denoising preserves the mean flux
_DARKEST = 1e-5  # the flux stays above this share of its mean: expectation-maximisation cannot leave 0
_BRIGHTEST = 1.55  # largest value on the stabilised scale, below pi / 2: a flux of 7.7 photons per frame


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """The photons of the cells of a grid."""

    lit: FluxImage  # (H, W), sums of counts
    seen: FluxImage  # (H, W), frames in these sums; in changing light the sum of their gains, in frames of mean light
    kernel: FluxImage  # (2 r + 1,), the area of a pixel along x and along y: see `pixel_area`
    binary: bool  # whether a count is 1 for one photon or more; otherwise counts are photons
    light: LitFrames | None = None  # frames and gains by the class of their light; None in steady light

    @property
    def frames(self) -> FluxImage:
        """Frames in the sums: (H, W)."""
        return self.seen if self.light is None else np.asarray(self.light.frames.sum(axis=0), np.float32)

    def weight(self) -> FluxImage:
        """Return the frames of a cell, on average over the area of a pixel: (H, W)."""
        found = np.empty_like(self.seen)
        expected(self.seen, self.kernel, np.empty_like(found), found)
        return found

    def log_likelihood(self, flux: FluxImage) -> FluxImage:
        """Return the log-likelihood of the counts of each cell, but for a constant: (H, W)."""
        mean, found = np.empty_like(flux), np.empty_like(flux)
        expected(flux, self.kernel, found, mean)
        if self.light is None or not self.binary:
            log_likelihood(self.lit, self.seen, mean, self.binary, found)
            return found
        lit, dark = self._counts(mean)
        n = np.maximum(self.frames, 1)
        return np.asarray(self.lit * np.log(lit / n) + (n - self.lit) * np.log(dark / n), np.float32) * (self.seen > 0)

    def photon_ratio(self, mean: FluxImage, into: FluxImage) -> None:
        """Write the photons that each cell detected, given its counts, for each expected photon of the flux: (H, W).

        In changing light it is `k sum_c n_c g_c / sum_c n_c (1 - exp(-g_c mean))` of counts k in n_c frames of gain g_c.
        """
        if self.light is None or not self.binary:
            _photon_ratio(self.lit, self.seen, mean, self.binary, into)
        else:
            np.divide(self.lit * self.seen, self._counts(mean)[0], out=into)

    def _counts(self, mean: FluxImage) -> tuple[FluxImage, FluxImage]:
        """Return the expected lit and dark frames of each cell, at least a tiny number."""
        assert self.light is not None
        lit, dark = np.empty_like(mean), np.empty_like(mean)
        counts_in_light(np.maximum(mean, np.float32(1e-9)), self.light.frames, self.light.gains, lit, dark)
        return np.maximum(lit, np.float32(1e-12)), np.maximum(dark, np.float32(1e-12))


def pixel_area(width: float) -> FluxImage:
    """Return the share of each pixel of a grid in the light of a pixel of the sensor of a width in px, along one axis.

    The light falls on a box. Its middle may lie anywhere within a cell, and the flux is constant within each pixel: the weights
    are the integrals of two boxes, convolved with each other.
    """
    radius = int(np.ceil(width / 2 + 1))
    offsets = np.arange(-radius, radius + 1)
    weights = np.zeros(len(offsets))
    for signs in np.ndindex(2, 2, 2):
        a, b, c = 1 - 2 * np.array(signs)
        weights += a * b * c * np.maximum(offsets + (a * width + b + c) / 2, 0) ** 2 / 2
    weights = np.maximum(weights, 0)
    inside = weights > 1e-7 * weights.max()
    return np.asarray(weights[inside] / weights.sum(), np.float32)


def rounds_of(observed: Observations, n_rounds: int) -> list[FluxImage]:
    """Estimate the flux, round by round; the last image is the best of the most rounds.

    Each round increases the likelihood of the flux by some steps of expectation-maximisation, `x <- x B'[k / (1 - exp(-B x))] /
    B'[n]` with the area B of a pixel, counts k and frames n, and then removes what looks like noise: a plug-and-play prior
    (Venkatakrishnan et al. 2013).
    """
    seen = observed.weight()
    noise = 0.5 / np.sqrt(np.maximum(cv2.blur(seen, (_PATCH, _PATCH)), _FEWEST_FRAMES))
    flux = _initial_flux(observed)
    floor = np.float32(_DARKEST * max(float(flux.mean()), 1e-9))
    known = seen > 1e-3 * max(float(seen.max()), 1e-9)
    per_frame = np.divide(1, seen, out=np.zeros_like(seen), where=known)
    mean, ratio, scratch = np.empty_like(flux), np.empty_like(flux), np.empty_like(flux)
    patches, results = Patches.over(flux.shape), []
    for number, strength in enumerate(STRENGTHS[:n_rounds]):
        for _ in range(_STEPS):
            expected(flux, observed.kernel, scratch, mean)
            observed.photon_ratio(mean, ratio)
            expected(ratio, observed.kernel, scratch, mean)
            flux = np.maximum(np.where(known, flux * mean * per_frame, flux), floor)
        stabilised = _stabilised(flux, observed.binary)
        if number % _MATCHED_ROUNDS == 0:
            find_similar(stabilised, patches)
        total, weights = np.zeros_like(flux), np.zeros_like(flux)
        filter_groups(stabilised, np.asarray(strength * noise, np.float32), patches, total, weights)
        denoised = np.maximum(_flux_of(total / weights, observed.binary), floor)
        # Denoising on the stabilised scale lowers the mean, which is kept around each pixel.
        wanted, found = (cv2.GaussianBlur(each, (0, 0), _KEPT_PX) for each in (flux, denoised))
        flux = np.asarray(denoised * (wanted / found), np.float32)
        results.append(flux)
    return results


def _initial_flux(observed: Observations) -> FluxImage:
    """Return the flux of smoothed sums; where nothing was seen, that of the surroundings."""
    sigma = 0.25 * len(observed.kernel)
    lit = cv2.GaussianBlur(observed.lit, (0, 0), sigma) + 1e-3 * cv2.GaussianBlur(observed.lit, (0, 0), 8 * sigma)
    seen = cv2.GaussianBlur(observed.seen, (0, 0), sigma) + 1e-3 * cv2.GaussianBlur(observed.seen, (0, 0), 8 * sigma)
    share = float(observed.lit.sum()) / max(float(observed.seen.sum()), 1.0)
    mean = (lit + 1e-6 * share) / (seen + 1e-6)
    if not observed.binary:
        return np.asarray(np.maximum(mean, 1e-9), np.float32)
    gain = float(observed.seen.sum()) / max(float(observed.frames.sum()), 1.0)
    lit_share = np.clip(mean * gain, 1e-9, 1 - 0.5 / np.maximum(seen, 1))
    return np.asarray(-np.log1p(-lit_share) / gain, np.float32)


def _stabilised(flux: FluxImage, binary: bool) -> FluxImage:
    """Map flux to a scale on which the noise of n frames is 0.5 / sqrt(n) (Anscombe 1948)."""
    return np.asarray(np.arcsin(np.sqrt(-np.expm1(-flux))) if binary else np.sqrt(flux), np.float32)


def _flux_of(stabilised: FluxImage, binary: bool) -> FluxImage:
    if binary:
        return np.asarray(-2 * np.log(np.cos(np.clip(stabilised, 0, _BRIGHTEST))), np.float32)
    return np.asarray(np.maximum(stabilised, 0) ** 2, np.float32)


def coarser(flux: FluxImage) -> FluxImage:
    """Return an image with the detail of a grid half as fine: averaged, and interpolated again."""
    height, width = flux.shape
    small = cv2.resize(flux, (max(1, width // 2), max(1, height // 2)), interpolation=cv2.INTER_AREA)
    return np.asarray(np.maximum(cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC), 1e-9), np.float32)


def gain_of(better: FluxImage, worse: FluxImage) -> tuple[float, float]:
    """Return the sum of the differences of two log-likelihoods, cell by cell, and its standard error."""
    apart: FloatArray = better.astype(np.float64) - worse
    return float(apart.sum()), float(np.sqrt((apart**2).sum()))


@compiled
def expected(flux: FluxImage, kernel: FluxImage, scratch: FluxImage, into: FluxImage) -> None:
    """Average the flux, (H, W), over the areas of pixels that are centred at each cell; the border is repeated.

    `kernel` (2 r + 1,) are symmetric weights along x and y with the sum 1, so that this is its own adjoint; `scratch` is
    overwritten.
    """
    height, width = flux.shape
    radius = len(kernel) // 2
    for y in range(height):
        row, out = flux[y], scratch[y]
        for x in range(width):
            if radius <= x < width - radius:
                continue
            total = np.float32(0)
            for i in range(-radius, radius + 1):
                total += kernel[i + radius] * row[min(max(x + i, 0), width - 1)]
            out[x] = total
        inner = out[radius : width - radius]
        for t in range(len(inner)):
            inner[t] = np.float32(0)
        for i in range(2 * radius + 1):
            weight, part = kernel[i], row[i : i + len(inner)]
            for t in range(len(inner)):
                inner[t] += weight * part[t]
    for y in range(height):
        out = into[y]
        for x in range(width):
            out[x] = np.float32(0)
        for i in range(-radius, radius + 1):
            weight, part = kernel[i + radius], scratch[min(max(y + i, 0), height - 1)]
            for x in range(width):
                out[x] += weight * part[x]


@compiled
def _lit_share(light: np.float32) -> np.float32:
    """Return `1 - exp(-light)`, exact in float32 for a faint light too."""
    half = np.float32(0.5)
    return light - half * light * light if light < np.float32(2e-3) else np.float32(1) - np.exp(-light)


@compiled
def _photon_ratio(lit: FluxImage, seen: FluxImage, mean: FluxImage, binary: bool, into: FluxImage) -> None:
    """Write `k / (1 - exp(-mean))` of the counts k of each cell, (H, W), or k / mean of counts that are not binary."""
    least = np.float32(1e-9)
    for y in range(lit.shape[0]):
        k, n, m, out = lit[y], seen[y], mean[y], into[y]
        for x in range(len(k)):
            light = max(m[x], least)
            if k[x] <= 0 or n[x] <= 0:
                out[x] = np.float32(0)
            elif binary:
                out[x] = k[x] / _lit_share(light)
            else:
                out[x] = k[x] / light


@compiled
def log_likelihood(lit: FluxImage, seen: FluxImage, mean: FluxImage, binary: bool, into: FluxImage) -> None:
    """Write the log-likelihood of the counts of each cell, but for a constant: see `_photon_ratio` for the arguments."""
    least = np.float32(1e-9)
    for y in range(lit.shape[0]):
        k, n, m, out = lit[y], seen[y], mean[y], into[y]
        for x in range(len(k)):
            light = max(m[x], least)
            if n[x] <= 0:
                out[x] = np.float32(0)
            elif binary:
                out[x] = k[x] * np.log(_lit_share(light)) - (n[x] - k[x]) * light
            else:
                out[x] = k[x] * np.log(light) - n[x] * light


@compiled
def counts_in_light(mean: FluxImage, frames: FluxImage, gains: FluxImage, lit: FluxImage, dark: FluxImage) -> None:
    """Write the expected frames of each cell with and without photons in changing light, (H, W), from the mean flux.

    `frames` and `gains` are (C, H, W): the frames of each class of light, and the sums of their gains.
    """
    for y in range(mean.shape[0]):
        for x in range(mean.shape[1]):
            lit[y, x] = dark[y, x] = np.float32(0)
            for c in range(len(frames)):
                n = frames[c, y, x]
                if n > 0:
                    share = _lit_share(gains[c, y, x] / n * mean[y, x])
                    lit[y, x] += n * share
                    dark[y, x] += n * (np.float32(1) - share)


Image = NDArray[np.float32]

_PATCH = 8  # side of a patch, px
GROUP = 16  # similar patches that are filtered together; a power of 2
_SEARCH = 10  # similar patches are looked for at this distance at most along x and y, px
STEP = 4  # distance of reference patches, px
_THRESHOLD = np.float32(2.7)  # coefficients below this many standard deviations of the noise are set to 0
_DCT: Image = dct(np.eye(_PATCH), axis=0, norm="ortho").astype(np.float32)


class Patches(NamedTuple):
    """Reference patches on a regular grid, and the patches that are similar to each."""

    rows: NDArray[np.int32]  # (R,) first rows of the reference patches
    columns: NDArray[np.int32]  # (C,) their first columns
    similar: NDArray[np.int32]  # (R, C, GROUP, 2) first row and column of the similar patches, the reference first

    @classmethod
    def over(cls, shape: tuple[int, ...]) -> Patches:
        """Return patches that cover an image of a (height, width), without similar ones."""
        rows, columns = (_places(length) for length in shape)
        return cls(rows, columns, np.empty((len(rows), len(columns), GROUP, 2), np.int32))


def _places(length: int) -> NDArray[np.int32]:
    """Return where reference patches begin along a side, so that they cover it."""
    return np.unique(np.append(np.arange(0, length - _PATCH + 1, STEP), length - _PATCH)).astype(np.int32)


@compiled
def find_similar(image: Image, patches: Patches) -> None:
    """Find the patches of an image, (H, W), that differ least from each reference patch."""
    rows, columns, found = patches
    height, width = image.shape
    side = 2 * _SEARCH + 1
    best = np.empty(GROUP, np.float32)
    distances = np.empty(side, np.float32)
    for r in range(len(rows)):
        for c in range(len(columns)):
            y0, x0 = rows[r], columns[c]
            places = found[r, c]
            n = 0
            top, bottom = max(0, y0 - _SEARCH), min(height - _PATCH, y0 + _SEARCH)
            left, right = max(0, x0 - _SEARCH), min(width - _PATCH, x0 + _SEARCH)
            size = right - left + 1
            for y in range(top, bottom + 1):
                row = distances[:size]
                for t in range(size):
                    row[t] = np.float32(0)
                for i in range(_PATCH):
                    line = image[y + i]
                    for j in range(_PATCH):
                        value, part = image[y0 + i, x0 + j], line[left + j : left + j + size]
                        for t in range(size):
                            apart = part[t] - value
                            row[t] += apart * apart
                for t in range(size):
                    distance = row[t]
                    if y == y0 and left + t == x0:
                        distance = np.float32(-1)
                    if n == GROUP and distance >= best[GROUP - 1]:
                        continue
                    k = n if n < GROUP else GROUP - 1
                    n = min(n + 1, GROUP)
                    while k > 0 and best[k - 1] > distance:
                        best[k] = best[k - 1]
                        places[k, 0], places[k, 1] = places[k - 1, 0], places[k - 1, 1]
                        k -= 1
                    best[k] = distance
                    places[k, 0], places[k, 1] = y, left + t
            for k in range(n, GROUP):
                places[k, 0], places[k, 1] = y0, x0


@compiled
def _transformed(patch: Image, matrix: Image, scratch: Image) -> None:
    """Multiply a patch with a matrix from the left and with its transpose from the right, in place."""
    for i in range(_PATCH):
        for j in range(_PATCH):
            scratch[i, j] = np.float32(0)
        for k in range(_PATCH):
            weight, row, out = matrix[i, k], patch[k], scratch[i]
            for j in range(_PATCH):
                out[j] += weight * row[j]
    for i in range(_PATCH):
        for j in range(_PATCH):
            patch[i, j] = np.float32(0)
        for k in range(_PATCH):
            weight, out = scratch[i, k], patch[i]
            for j in range(_PATCH):
                out[j] += weight * matrix[j, k]


@compiled
def _mixed(stack: Image) -> None:
    """Apply the orthonormal Walsh-Hadamard transform along the patches of a (GROUP, PATCH * PATCH) stack; it inverts itself."""
    half = 1
    while half < GROUP:
        for start in range(0, GROUP, 2 * half):
            for k in range(start, start + half):
                a, b = stack[k], stack[k + half]
                for t in range(_PATCH * _PATCH):
                    p, q = a[t], b[t]
                    a[t], b[t] = p + q, p - q
        half *= 2
    scale = np.float32(1 / np.sqrt(GROUP))
    for k in range(GROUP):
        row = stack[k]
        for t in range(_PATCH * _PATCH):
            row[t] *= scale


@compiled
def filter_groups(image: Image, noise: Image, patches: Patches, total: Image, weights: Image) -> None:
    """Filter each group of similar patches, and add its patches where they lie, weighted by how few coefficients are left.

    `noise` is (H, W), the standard deviation to remove; `total` and `weights`, (H, W), are added to.
    """
    rows, columns, found = patches
    stack = np.empty((GROUP, _PATCH, _PATCH), np.float32)
    flat = stack.reshape(GROUP, _PATCH * _PATCH)
    scratch = np.empty((_PATCH, _PATCH), np.float32)
    forth, back = _DCT, np.ascontiguousarray(_DCT.T)
    half = _PATCH // 2
    for r in range(len(rows)):
        for c in range(len(columns)):
            places = found[r, c]
            for k in range(GROUP):
                y, x = places[k, 0], places[k, 1]
                for i in range(_PATCH):
                    for j in range(_PATCH):
                        stack[k, i, j] = image[y + i, x + j]
                _transformed(stack[k], forth, scratch)
            _mixed(flat)
            sigma = noise[rows[r] + half, columns[c] + half]
            limit, kept = _THRESHOLD * sigma, 0
            for k in range(GROUP):
                row = flat[k]
                for t in range(_PATCH * _PATCH):
                    if abs(row[t]) < limit and k + t > 0:
                        row[t] = np.float32(0)
                    else:
                        kept += 1
            _mixed(flat)
            weight = np.float32(1) / (np.float32(kept) * sigma * sigma)
            for k in range(GROUP):
                _transformed(stack[k], back, scratch)
                y, x = places[k, 0], places[k, 1]
                for i in range(_PATCH):
                    for j in range(_PATCH):
                        total[y + i, x + j] += weight * stack[k, i, j]
                        weights[y + i, x + j] += weight
