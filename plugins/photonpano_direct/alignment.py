"""Align one layer of an exposure, the template, to that of another, and estimate how well."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from threading import local

import numpy as np

from photonpano import FloatArray, Homography, NotLocated
from photonpano.geometry import corners, generators, slopes, unit_coordinates, why_implausible
from photonpano.locating import NO_TEXTURE, information_on_turn
from photonpano_direct import descent
from photonpano_direct.curvature import Coordinates, information_of
from photonpano_direct.moments import Buffers, Layer


@dataclass(frozen=True, slots=True, eq=False)
class Quality:
    """How well two images agree."""

    information: FloatArray  # (8, 8) inverse covariance of p1..p8 of the homography, from the photons of both images
    noise_ratio: float  # mean squared residual relative to that of photon noise
    overlap: float  # fraction of the template that both see
    std_px: float  # expected error of a corner, in px of the layer


@dataclass(frozen=True, slots=True, eq=False)
class Aligned:
    """An aligned template."""

    template: Layer
    homography: Homography  # (3, 3), pixels of the template to pixels of the fixed layer
    pixels: int  # number of pixels that both see
    squares: float  # weighted sum of the squared residuals
    weights: float  # sum of the weights, the inverse variances of the residuals
    # residual and weight at the last step. They belong to the thread, and are valid until it aligns another template of this
    # shape
    buffers: Buffers

    @property
    def overlap(self) -> float:
        """Fraction of the template that both see."""
        return self.pixels / self.template.image.size

    def quality(self, camera_matrix: FloatArray | None) -> Quality:
        """Return how well the images agree, given K in px of the layer for a rotation; it overwrites the buffers."""
        # A Gaussian blur of standard deviation s leaves 1 / (4 pi s^2) of the variance of white noise.
        noise_ratio = self.squares / self.pixels * 4 * np.pi * self.template.blur_px**2
        shape = (self.template.image.shape[0], self.template.image.shape[1])
        information, std_px = information_of(
            self.template,
            self.buffers,
            self.homography,
            self.pixels,
            self.weights,
            noise_ratio,
            _coordinates(shape),
        )
        if camera_matrix is not None and np.isfinite(std_px):
            information, std_px = information_on_turn(information, self.homography, camera_matrix, shape)
        return Quality(information=information, noise_ratio=noise_ratio, overlap=self.overlap, std_px=std_px)


def align(
    template: Layer,
    fixed: Layer,
    homography: Homography,
    prior_mean: Homography,
    basis: FloatArray,
    tolerance_px: float,
    max_steps: int,
) -> Aligned | NotLocated:
    """Align a template to another layer of the same shape, from an initial map of its pixels to those of the other layer.

    `basis` (8, K) are the small changes of p1..p8 in unit coordinates that are estimated. It has converged when a step moves no
    corner further than `tolerance_px`.
    """
    shape = (template.image.shape[0], template.image.shape[1])
    buffers = buffers_of(template)
    status, homography, pixels, squares, weights = descent.descend(
        template,
        fixed,
        homography,
        prior_mean,
        _coordinates(shape),
        basis,
        tolerance_px,
        max_steps,
        buffers,
    )
    if status == descent.CONVERGED:
        return Aligned(template, homography, pixels, squares, weights, buffers)
    if status == descent.DIVERGED:
        return NotLocated(f"the alignment diverges: {why_implausible(homography, shape, 0.0)}")
    if status == descent.NO_TEXTURE:
        return NotLocated(NO_TEXTURE)
    return NotLocated(f"the alignment has not converged after {max_steps} steps")


@cache
def _coordinates(shape: tuple[int, int]) -> Coordinates:
    homogeneous = np.concatenate([corners(shape), np.ones((4, 1))], axis=1).T
    to_corners = np.ascontiguousarray(slopes(homogeneous, generators(shape) @ homogeneous))
    return Coordinates(np.array(unit_coordinates(shape)), np.array(generators(shape)), to_corners)


_of_thread = local()


def buffers_of(layer: Layer) -> Buffers:
    """Return the buffers of this thread for images of the shape of a layer."""
    shape = layer.image.shape
    buffers: dict[tuple[int, ...], Buffers] = _of_thread.__dict__.setdefault("buffers", {})
    if shape not in buffers:
        buffers[shape] = Buffers(*(np.empty(size, np.float32) for size in (shape, shape, (2, *shape))))
    return buffers[shape]
