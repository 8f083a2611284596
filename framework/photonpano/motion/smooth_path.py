"""The smooth path along which the photons of all frames fit together best, where pairs of exposures hold too few of them.

As with a constant velocity (see `velocity`), products of different spans are summed: they grow as what one point of the scene
sends comes together. A path has many unknowns, and fits photon noise, too: how many knots it may have is decided by photons
that it was not fitted to.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BSpline
from scipy.optimize import minimize

from photonpano.compiling import compiled
from photonpano.contracts.protocols import Source
from photonpano.errors import LocationError
from photonpano.execution.context import Context
from photonpano.merging import binning_of
from photonpano.motion.velocity import Images, halved, span_means, structure_of
from photonpano.values import FloatArray

_SPANS = 512  # a capture is divided into at most this many spans
_FEWEST_KNOTS, _MORE_KNOTS, _SPANS_OF_KNOT = 8, 1.5, 3
_LEAST_SIDE = 32  # pixels of the shorter side of the coarsest images
_FINEST = 4  # binning from which on images of half that binning are used, too: finer ones of small frames are too noisy
_ITERATIONS = 40  # of the search, for each number of knots
# Least height of photons of other spans along the path above those of a still image, in standard deviations. The best of ten
# numbers of knots reaches 3 by chance.
_SIGNIFICANT = 6.0


class SmoothPath:
    """A trajectory that shifts the image along a cubic spline; the reference frame's homography is the identity."""

    def __init__(self, knots: FloatArray, n_frames: int, reference: float, std_px: float) -> None:
        """Take the (K, 2) coefficients of a spline over all frames, in px, and the expected error of the shifts, in px."""
        self._knots, self._n_frames, self.std_px = knots, n_frames, std_px
        self._at_reference = self._shifts(reference)

    @property
    def error_px_a_frame(self) -> float:
        """How fast the error of the path changes, in px a frame: by as much as itself from one knot to the next."""
        return self.std_px * len(self._knots) / self._n_frames

    def at(self, frame_indices: ArrayLike) -> FloatArray:
        """Return the homographies of N instants, in frames, to the reference frame: (N, 3, 3)."""
        shifts = self._shifts(frame_indices) - self._at_reference
        homographies = np.tile(np.eye(3), (len(shifts), 1, 1))
        homographies[:, :2, 2] = shifts
        return homographies

    def _shifts(self, instants: ArrayLike) -> FloatArray:
        shares = (np.atleast_1d(np.asarray(instants, np.float64)) + 0.5) / self._n_frames
        return np.asarray(BSpline(_ends(len(self._knots)), self._knots, 3)(np.clip(shares, 0, 1)))


@dataclass(frozen=True, slots=True, eq=False)
class FoundPath:
    """A path that was found, and how certain it is."""

    trajectory: SmoothPath
    n_knots: int
    significance: float  # of photons that it was not fitted to, above those of a still image, in standard deviations


def find_path(source: Source, reference: float, context: Context) -> FoundPath:
    """Find the smooth path of the image in all of a capture: shifts up to half of a frame, from nothing.

    A path with more and more knots is fitted to every second span, from the path before. The photons of the others say how
    many knots are right; then it is fitted to all spans, in finer images. Paths of the even and of the odd spans differ by
    twice its error.

    Raises:
        InputError: the capture has too few frames, or they are tiny.
        LocationError: no path stands out.
    """
    binning = binning_of(source)
    px = binning // 2 if binning >= _FINEST else binning
    search = _Search(*span_means(source, context, _SPANS, px), px)
    tried = even = search.still
    unmoved = search.held_out(even)
    best, significance, count = unmoved.sum(), 0.0, _FEWEST_KNOTS
    while count <= search.n_spans // _SPANS_OF_KNOT:
        tried = search.sharpest(tried, count, slice(0, None, 2), finest=False)
        products = search.held_out(tried)
        if products.sum() > best:
            best, even = products.sum(), tried
            significance = float((products - unmoved).sum() / np.sqrt(((products - unmoved) ** 2).sum()))
        count = int(count * _MORE_KNOTS)
    if significance < _SIGNIFICANT:
        raise LocationError(
            "motion.start: no smooth path stands out from photon noise: along the sharpest one, photons that it was not fitted "
            f"to are {significance:.2g} standard deviations above those of a still image, and {_SIGNIFICANT:g} are needed; the "
            "scene may stand still or move too fast, or the capture is too dark or too short"
        )
    knots, *halves = (search.sharpest(even, len(even), slice(*each)) for each in ((None,), (0, None, 2), (1, None, 2)))
    apart = np.subtract(*map(search.along, halves))
    std_px = float(np.sqrt(((apart - apart.mean(axis=0)) ** 2).sum(axis=1).mean()) / 2)
    return FoundPath(SmoothPath(knots, search.n_frames, reference, std_px), len(knots), significance)


class _Search:
    """Photons of spans, in images of several sizes, and paths that are fitted to them, in px of a frame."""

    def __init__(self, means: Images, seen: Images, span_frames: int, px: int) -> None:
        """Take the (S, h, w) means of spans of some frames, whose pixels have a side of some px of a frame."""
        self.n_spans, self.n_frames = len(means), span_frames * len(means)
        self.still = np.zeros((_FEWEST_KNOTS, 2))
        self._instants = (np.arange(self.n_spans) + 0.5) / self.n_spans
        self._images = [(px, _framed(structure_of(means, seen)))]
        while min(means.shape[1:]) >= 2 * _LEAST_SIDE:
            px, means, seen = 2 * px, halved(means), halved(seen[None])[0]
            self._images.insert(0, (px, _framed(structure_of(means, seen))))

    def along(self, knots: FloatArray) -> FloatArray:
        """Return the shifts of the spans along a path: (S, 2)."""
        return np.asarray(_basis(self._instants, len(knots)) @ knots)

    def sharpest(self, path: FloatArray, count: int, spans: slice, finest: bool = True) -> FloatArray:
        """Return the path of some knots, (count, 2), along which some of the spans are sharpest, near another path.

        It is found in the coarsest images, and then in finer ones.
        """
        basis = _basis(self._instants, count)
        found = np.linalg.lstsq(basis, self.along(path), rcond=None)[0]
        for px, images in self._images if finest else self._images[:1]:
            lost = partial(_lost, images=images[spans], basis=basis[spans])
            # Knots are in pixels of the images, so that the first step is of about one of them.
            answer = minimize(lost, found.ravel() / px, jac=True, method="L-BFGS-B", options={"maxiter": _ITERATIONS})
            found = answer.x.reshape(-1, 2) * px
        return np.asarray(found)

    def held_out(self, path: FloatArray) -> FloatArray:
        """Return the products of each odd span with the sum of the even ones along a path: (S // 2,)."""
        px, images = self._images[-1]
        shifts = self.along(path) / px
        return _products(_merged(images[::2], shifts[::2])[0], images[1::2], shifts[1::2])


def _framed(images: Images) -> Images:
    """Return images with a frame of zeros, so that they fade out where they are shifted by parts of a pixel."""
    return np.pad(images, ((0, 0), (1, 1), (1, 1)))


def _lost(knots: FloatArray, images: Images, basis: FloatArray) -> tuple[float, FloatArray]:
    """Return the products of different spans along a path, and their derivatives by its knots, (2 K,): negative, for minima.

    They are shares of the products of each span with itself.
    """
    shifts = basis @ knots.reshape(-1, 2)
    merged, own = _merged(images, shifts)
    down, right = (np.asarray(each, np.float32) for each in np.gradient(merged))
    # What a span has in common with itself has no slope.
    slopes = np.stack([_products(right, images, shifts), _products(down, images, shifts)], axis=-1)
    unit = max(own, 1e-30)
    return (own - float((merged * merged).sum())) / unit, -2 * (basis.T @ slopes).ravel() / unit


def _merged(images: Images, shifts: FloatArray) -> tuple[Images, float]:
    """Return the sum of (S, h, w) shifted images, with borders, and the sum of the products of each with itself."""
    height, width = images.shape[1:]
    merged = np.zeros((2 * height, 2 * width), np.float32)
    return merged, _add(images, shifts, merged)


def _products(merged: Images, images: Images, shifts: FloatArray) -> FloatArray:
    """Return the product of an image with borders and each of (S, h, w) shifted ones: (S,)."""
    products = np.zeros(len(images))
    _multiply(images, shifts, merged, products)
    return products


@compiled
def _add(images: Images, shifts: FloatArray, merged: Images) -> float:
    """Add shifted images to one with borders, and return the sum of their squares; what lies beyond the borders is left out."""
    own = 0.0
    for image, shift in zip(images, shifts):  # noqa: B905 - compiled
        top, left, weights = _placed(image, shift, merged)
        for y in range(image.shape[0] - 1):
            above, below, row = image[y], image[y + 1], merged[top + y]
            for x in range(image.shape[1] - 1):
                value = weights[0] * above[x] + weights[1] * above[x + 1] + weights[2] * below[x] + weights[3] * below[x + 1]
                row[left + x] += value
                own += value * value
    return own


@compiled
def _multiply(images: Images, shifts: FloatArray, merged: Images, products: FloatArray) -> None:
    """Write the products of shifted images and one with borders: see `_add`."""
    for index in range(len(images)):
        image = images[index]
        top, left, weights = _placed(image, shifts[index], merged)
        for y in range(image.shape[0] - 1):
            above, below, row = image[y], image[y + 1], merged[top + y]
            for x in range(image.shape[1] - 1):
                value = weights[0] * above[x] + weights[1] * above[x + 1] + weights[2] * below[x] + weights[3] * below[x + 1]
                products[index] += value * row[left + x]


@compiled
def _placed(image: Images, shift: FloatArray, merged: Images) -> tuple[int, int, tuple[float, float, float, float]]:
    """Return the row and column of a shifted image within one with borders, not beyond them, and its bilinear weights."""
    margin_y, margin_x = merged.shape[0] - image.shape[0], merged.shape[1] - image.shape[1]
    y = min(max(shift[1] + margin_y / 2, 0.0), margin_y)
    x = min(max(shift[0] + margin_x / 2, 0.0), margin_x)
    top, left = int(y), int(x)
    b, a = y - top, x - left
    return top, left, ((b * a), b * (1 - a), (1 - b) * a, (1 - b) * (1 - a))


def _basis(instants: FloatArray, count: int) -> FloatArray:
    """Return the weights of the knots of a cubic spline at N instants, as shares of the capture: (N, count)."""
    return np.asarray(BSpline.design_matrix(instants, _ends(count), 3).toarray())


def _ends(count: int) -> FloatArray:
    """Return where the pieces of a cubic spline with some knots end, as shares of the capture."""
    return np.concatenate([np.zeros(3), np.linspace(0, 1, count - 2), np.ones(3)])
