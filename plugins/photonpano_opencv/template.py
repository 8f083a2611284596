"""One layer of an exposure as the template of an alignment: how it is aligned, and what is known afterwards."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from threading import local
from typing import TYPE_CHECKING

import numpy as np

from photonpano.geometry import corners, generators, implausibility, jacobian, slopes, unit_coordinates
from photonpano_opencv.descent import DIVERGED, LOST, SETTLED, by_chance, curvatures, descend, quadratic
from photonpano_opencv.moments import Buffers

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from photonpano_opencv.pyramid import Layer

ALL = (0, 1, 2, 3, 4, 5, 6, 7)
"""All of p1..p8."""
_BY_CHANCE = 1.0
"""The best alignment of noise has a curvature in common of up to so many times what noise has in common anywhere; that much
tells nothing."""
_UNKNOWN = 1e-3
"""Where no more than that is in common, next to nothing is known: this share of the template's curvature."""
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
        self._buffers = _buffers(self._shape)

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
            np.array(unit_coordinates(self._shape)),
            np.array(free),
            _to_corners(self._shape, free),
            tolerance_px,
            max_steps,
            self._buffers,
        )
        if ended == SETTLED:
            return Aligned(homography, pixels, pixels / self._layer.image.size, squares, weights)
        if ended == DIVERGED:
            return f"the alignment diverges: {implausibility(homography, self._shape, 0.0)}"
        if ended == LOST:
            return "where the images overlap, if they do, there is no texture"
        return f"the alignment has not settled after {max_steps} steps"

    def quality(self, aligned: Aligned) -> Quality:
        """Return how well the images agree, and what their photons tell about p1..p8 of the homography.

        The template must not have been aligned to anything else in between, nor another of its shape in this thread.
        """
        layer, buffers = self._layer, self._buffers
        weight = buffers.weight
        # White noise, and what the blur leaves of it in a pixel.
        noise_ratio = aligned.squares / aligned.pixels * 4 * np.pi * layer.blur_px**2
        chance = _BY_CHANCE * by_chance(aligned.pixels, layer.blur_px)
        _, hessian = curvatures(layer, buffers, chance, _UNKNOWN)
        # The blur correlates the noise of neighbours, so that the step scatters by H^-1 M H^-1 and not by H^-1. Weight and
        # place hardly change within the blur, so that it is enough to blur the gradients.
        np.multiply(weight, weight * np.float32(aligned.pixels / aligned.weights), out=weight)
        scatter = quadratic(layer.smoothed, layer.smoothed, weight)
        information = hessian @ np.linalg.solve(scatter, hessian) / max(1.0, noise_ratio) + _PRIOR
        in_parameters = self._in_parameters(aligned.homography, information)
        to_corners = jacobian(aligned.homography, corners(self._shape)).reshape(8, 8)
        return Quality(
            information=in_parameters,
            std_px=float(np.sqrt(np.trace(to_corners @ np.linalg.inv(in_parameters) @ to_corners.T) / 4)),
            noise_ratio=noise_ratio,
            overlap=aligned.overlap,
        )

    def _in_parameters(self, homography: NDArray[np.float64], information: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert the information on a step to that on p1..p8 of the homography it changes."""
        rows = _corner_rows(self._shape)
        to_corners = slopes(homography @ rows, homography @ generators(self._shape) @ rows)
        to_step = np.linalg.solve(to_corners, jacobian(homography, corners(self._shape)).reshape(8, 8))
        return np.asarray(to_step.T @ information @ to_step)


@cache
def _to_corners(shape: tuple[int, int], free: tuple[int, ...]) -> NDArray[np.float64]:
    """Return how small changes of some of p1..p8 move the corners of an image: (8, len(free))."""
    rows = _corner_rows(shape)
    return np.ascontiguousarray(slopes(rows, generators(shape) @ rows)[:, list(free)])


def _corner_rows(shape: tuple[int, int]) -> NDArray[np.float64]:
    """Return the corners of an image in homogeneous coordinates: (3, 4)."""
    return np.concatenate([corners(shape), np.ones((4, 1))], axis=1).T
