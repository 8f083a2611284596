"""One layer of an exposure as the template of an alignment: how it is aligned, and what is known afterwards."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from threading import local

import numpy as np
from numpy.typing import NDArray

from photonpano.geometry import corners, generators, slopes, unit_coordinates, why_implausible
from photonpano_direct.curvature import told
from photonpano_direct.descent import DIVERGED, LOST, SETTLED, descend
from photonpano_direct.layers import Layer
from photonpano_direct.moments import Buffers

ALL = (0, 1, 2, 3, 4, 5, 6, 7)
"""All of p1..p8."""
_PRIOR_STD = np.array([0.03, 0.03, 0.03, 0.03, np.inf, np.inf, 0.03, 0.03])
"""How much p1..p8, in coordinates of about unit size, may differ from the start where photons do not tell: a camera that turns
between two exposures shifts the image by any amount, but rolls by a degree or two and changes the perspective by little."""
_PRIOR = np.diag(_PRIOR_STD**-2.0)


@dataclass(frozen=True, slots=True, eq=False)
class Aligned:
    """Where a template lies.

    Attributes:
        homography: (3, 3), pixels of the template to pixels of the fixed layer.
        pixels: how many pixels both see.
        overlap: share of the template that both see.
        squares: weighted sum of the squares of their differences.
        weights: sum of their weights, the inverse variances of the differences.
    """

    homography: NDArray[np.float64]
    pixels: int
    overlap: float
    squares: float
    weights: float


@dataclass(frozen=True, slots=True, eq=False)
class Quality:
    """How well two images agree.

    Attributes:
        information: (8, 8) inverse covariance of p1..p8 of the homography, from the photons of both images.
        noise_ratio: mean square of their difference over that which photon noise makes.
        overlap: share of the template that both see.
        std_px: expected distance of a corner from where it should be, in px of the layer.
    """

    information: NDArray[np.float64]
    std_px: float
    noise_ratio: float
    overlap: float


class _Geometry:
    """What is the same for all templates of a shape, in arrays that compiled functions take as they are."""

    def __init__(self, shape: tuple[int, int]) -> None:
        rows = np.concatenate([corners(shape), np.ones((4, 1))], axis=1).T
        self.unit, self.generators = np.array(unit_coordinates(shape)), np.array(generators(shape))
        self._to_corners = slopes(rows, self.generators @ rows)
        self._of: dict[tuple[int, ...], NDArray[np.float64]] = {}

    def to_corners(self, free: tuple[int, ...]) -> NDArray[np.float64]:
        """Return how small changes of some of p1..p8 move the corners of an image: (8, len(free))."""
        if free not in self._of:
            self._of[free] = np.ascontiguousarray(self._to_corners[:, list(free)])
        return self._of[free]


_geometry = cache(_Geometry)
_of_thread = local()


def _buffers(shape: tuple[int, ...]) -> Buffers:
    """Return the buffers of this thread for images of a shape."""
    known: dict[tuple[int, ...], Buffers] = _of_thread.__dict__.setdefault("buffers", {})
    if shape not in known:
        known[shape] = Buffers(*(np.empty(size, np.float32) for size in (shape, shape, (2, *shape))))
    return known[shape]


class Template:
    """The moving image, with what a small change of p1..p8 of its own frame does to it.

    A template belongs to one thread.
    """

    def __init__(self, layer: Layer, start: NDArray[np.float64]) -> None:
        """Prepare a layer.

        Args:
            layer: the moving image.
            start: (3, 3) what is thought of the homography before the photons are asked.
        """
        self._layer, self._start = layer, start
        self._shape = (layer.image.shape[0], layer.image.shape[1])
        self._known, self._buffers = _geometry(self._shape), _buffers(self._shape)

    def aligned(
        self, homography: NDArray[np.float64], fixed: Layer, free: tuple[int, ...], tolerance_px: float, max_steps: int
    ) -> Aligned | str:
        """Return the homography that aligns the template to another layer, or why there is none.

        Args:
            homography: (3, 3) where to begin, pixels of the template to pixels of the fixed layer.
            fixed: what the template is aligned to.
            free: which of p1..p8 may change.
            tolerance_px: steps that move no corner further are the last.
            max_steps: how many there are at most.
        """
        ended, homography, pixels, squares, weights = descend(
            self._layer,
            fixed,
            homography,
            self._start,
            _PRIOR,
            self._known.unit,
            np.array(free),
            self._known.to_corners(free),
            tolerance_px,
            max_steps,
            self._buffers,
        )
        if ended == SETTLED:
            return Aligned(homography, pixels, pixels / self._layer.image.size, squares, weights)
        if ended == DIVERGED:
            return f"the alignment diverges: {why_implausible(homography, self._shape, 0.0)}"
        if ended == LOST:
            return "where the images overlap, if they do, there is no texture"
        return f"the alignment has not settled after {max_steps} steps"

    def quality(self, aligned: Aligned) -> Quality:
        """Return how well the images agree, and what their photons tell about p1..p8 of the homography.

        The template must not have been aligned to anything else in between, nor another of its shape in this thread.
        """
        layer = self._layer
        # White noise, and what the blur leaves of it in a pixel.
        noise_ratio = aligned.squares / aligned.pixels * 4 * np.pi * layer.blur_px**2
        information, std_px = told(
            layer,
            self._buffers,
            aligned.homography,
            aligned.pixels,
            aligned.weights,
            noise_ratio,
            _PRIOR,
            self._known.generators,
            self._known.to_corners(ALL),
        )
        return Quality(information, std_px, noise_ratio, aligned.overlap)
