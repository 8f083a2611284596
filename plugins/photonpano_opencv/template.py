"""The inverse-compositional step on homographies (Baker and Matthews 2004), from moments of a few images."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import cv2
import numpy as np

from photonpano.geometry import (
    corner_displacements,
    corners,
    from_parameters,
    generators,
    jacobian,
    normalised,
    parameters,
    slopes,
    unit_coordinates,
)
from photonpano.photometry import noise_free_correlation

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from photonpano_opencv.pyramid import Layer

ALL = (0, 1, 2, 3, 4, 5, 6, 7)
"""All of p1..p8."""
_BOLDEST = 5.0
"""The curvature common to both images is taken to be at least so many times what noise alone leaves in common by chance, which
is the template's over the root of the number of independent pixels; so steps stay bounded."""
_BY_CHANCE = 1.0
"""The best alignment of noise has a curvature in common of up to so many times the same; that much tells nothing."""
_UNKNOWN = 1e-3
"""Where no more than that is in common, next to nothing is known: this share of the template's curvature."""
_PRIOR_STD = np.array([0.03, 0.03, 0.03, 0.03, np.inf, np.inf, 0.03, 0.03])
"""How much p1..p8, in coordinates of about unit size, may differ from the start where photons do not tell: a camera that turns
between two exposures shifts the image by any amount, but rolls by a degree or two and changes the perspective by little."""
_PRIOR = np.diag(_PRIOR_STD**-2.0)
_NEGLIGIBLE = 0.02
"""Steps of this share of what photons leave open do not count: where they tell little, steps stay small for long."""
_SURROUNDINGS_PX = 4.0
"""What counts as the surroundings of a pixel, as the standard deviation of a Gaussian in px of the layer."""
_RENEWED_PX = 0.25
"""The curvature is taken anew until steps are smaller than this."""


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


class Template:
    """The moving image, with what a small change of p1..p8 of its own frame does to it.

    A parameter changes a pixel by its gradient times a polynomial of its place of degree two at most. So sums over all pixels
    are moments of a few images, each two small matrix products, and no image for each parameter is ever made. Parameters are
    those of coordinates of about unit size.
    """

    def __init__(self, layer: Layer, start: NDArray[np.float64]) -> None:
        """Prepare a layer.

        Args:
            layer: the moving image.
            start: (3, 3) what is thought of the homography before the photons are asked.
        """
        self._layer = layer
        self._to_start = np.linalg.inv(start)
        height, width = layer.image.shape
        self._half = half = max(height, width) / 2
        self._unit = unit_coordinates(layer.image.shape)
        self._from_unit = np.linalg.inv(self._unit)
        self._frame = corners(layer.image.shape)
        self._rows = np.concatenate([self._frame, np.ones((4, 1))], axis=1).T
        self._gx, self._gy = (np.float32(half) * gradient for gradient in _gradients(layer.image))
        self._powers = _powers(width, half), _powers(height, half)
        self._hessian: NDArray[np.float64] | None = None
        self._own = np.zeros((8, 8))
        self._std_px = 0.0

    def step(
        self, homography: NDArray[np.float64], fixed: Layer, free: tuple[int, ...], damping: float
    ) -> tuple[NDArray[np.float64], float] | None:
        """Return the small homography of the template's frame that explains what differs, and how much differs.

        Args:
            homography: (3, 3), pixels of the template to pixels of the fixed layer.
            fixed: what the template is aligned to.
            free: which of p1..p8 may change; the same in every call.
            damping: how much shorter than its best guess the step is to be: 0 for not at all (Levenberg 1944).

        Returns:
            The step, and the mean square of the differences in units of their noise; None without overlap or texture.
        """
        residual, weight = self._residual(homography, fixed)
        seen = int(np.count_nonzero(weight))
        if not seen:
            return None
        if self._hessian is None:
            self._own, common = self._curvatures(residual, weight, 0.0, min(0.5, _BOLDEST * self._chance(weight)))
            self._hessian = common + _PRIOR
            self._std_px = self._expected_px(free)
        weighted = residual * weight
        along_x, along_y = self._moments(weighted * self._gx, 3), self._moments(weighted * self._gy, 3)
        gradient = np.einsum("aij,ij->a", _ALONG_X, along_x) + np.einsum("aij,ij->a", _ALONG_Y, along_y)
        moved = parameters(normalised(self._unit @ self._to_start @ homography @ self._from_unit))
        gradient += _PRIOR @ moved
        differs = (float(np.vdot(weighted, residual)) + float(moved @ _PRIOR @ moved)) / seen
        p = np.zeros(8)
        try:
            p[list(free)] = np.linalg.solve((self._hessian + damping * self._own)[np.ix_(free, free)], gradient[list(free)])
        except np.linalg.LinAlgError:
            return None
        step = np.asarray(self._from_unit @ from_parameters(p) @ self._unit)
        if self.size_px(step) > _RENEWED_PX:
            self._hessian = None
        return step, differs

    def settled(self, step: NDArray[np.float64], tolerance_px: float) -> bool:
        """Tell whether steps have become small: below the tolerance, or of no weight beside what photons leave open."""
        return self.size_px(step) < max(tolerance_px, _NEGLIGIBLE * self._std_px)

    def size_px(self, step: NDArray[np.float64]) -> float:
        """Return how far a step moves the corners of the template at most, in px of its layer."""
        return float(corner_displacements(step, np.eye(3), self._layer.image.shape).max())

    def quality(self, homography: NDArray[np.float64], fixed: Layer) -> Quality:
        """Return how well the images agree, and what their photons tell about p1..p8 of `homography`."""
        residual, weight = self._residual(homography, fixed)
        seen = weight > 0
        # White noise, and what the blur leaves of it in a pixel.
        variance = float(np.median(1 / weight[seen]))
        noise_ratio = float(np.mean(residual[seen] ** 2)) * 4 * np.pi * self._layer.blur_px**2 / variance
        # The blur correlates the noise of neighbours, so that the step scatters by H^-1 M H^-1 and not by H^-1. Weight and
        # place hardly change within the blur, so that it is enough to blur the gradients.
        _, hessian = self._curvatures(residual, weight, _BY_CHANCE * self._chance(weight), _UNKNOWN)
        bx, by = (cv2.GaussianBlur(weight * gradient, (0, 0), self._layer.blur_px) for gradient in (self._gx, self._gy))
        scatter = self._quadratic(bx * bx, bx * by, by * by) * variance
        information = hessian @ np.linalg.solve(scatter, hessian) / max(1.0, noise_ratio) + _PRIOR
        in_parameters = self._in_parameters(homography, information)
        to_corners = jacobian(homography, self._frame).reshape(8, 8)
        return Quality(
            information=in_parameters,
            std_px=float(np.sqrt(np.trace(to_corners @ np.linalg.inv(in_parameters) @ to_corners.T) / 4)),
            noise_ratio=noise_ratio,
            overlap=float(seen.mean()),
        )

    def agreement(self, homography: NDArray[np.float64], fixed: Layer) -> float:
        """Return the correlation that the images would have without photon noise: 1 where they show the same.

        Around 0 for different places, and 0 where the scene does not stand out from the noise, so that any two places look
        alike.
        """
        height, width = self._layer.image.shape
        there, there_weight = (
            cv2.warpPerspective(image, homography, (width, height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
            for image in (fixed.image, fixed.weight)
        )
        seen = (self._layer.weight > 0) & (there_weight > 0)
        gain = 1 / (4 * np.pi * self._layer.blur_px**2)
        independent = np.count_nonzero(seen) * min(1.0, gain)
        if not independent:
            return 0.0
        # Shadows and slopes that fill the image look alike wherever one looks.
        first, second = (_details(image, seen)[seen] for image in (self._layer.image, np.asarray(there, np.float32)))
        # Interpolation leaves 4/9 of the variance of white noise, on average over where between pixels it looks.
        noise = [
            left * gain * float(np.median(1 / weight[seen]))
            for weight, left in ((self._layer.weight, 1), (there_weight, 4 / 9))
        ]
        return noise_free_correlation(first, second, (noise[0], noise[1]), independent)

    def _residual(self, homography: NDArray[np.float64], fixed: Layer) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the fixed image seen from the template minus the template, and the inverse variance of the difference."""
        height, width = self._layer.image.shape
        # Linear, because OpenCV's cubic kernel bends even a ramp by up to 0.05 px, which would bend the homography.
        seen, weight = (
            cv2.warpPerspective(image, homography, (width, height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
            for image in (fixed.image, fixed.weight)
        )
        both = self._layer.weight + weight
        combined = np.divide(self._layer.weight * weight, both, out=np.zeros_like(both), where=both > 0)
        return seen - self._layer.image, combined

    def _curvatures(
        self, residual: NDArray[np.float32], weight: NDArray[np.float32], by_chance: float, least: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the (8, 8) curvature of the template, and that which both images have in common: that of the scene.

        The noise of the template has gradients too, and in the dark larger ones than the scene. With those of the other image
        it has nothing in common.

        Args:
            residual: (H, W) the fixed image seen from the template minus the template.
            weight: (H, W) inverse variance of a pixel of the residual.
            by_chance: the share of the template's curvature that noise may have in common, which is taken off.
            least: what is left of a direction in which there is nothing in common, as a share of the template's curvature.
        """
        gx, gy = self._gx, self._gy
        wx, wy = weight * gx, weight * gy
        own = self._quadratic(wx * gx, wx * gy, wy * gy)
        dx, dy = (np.float32(self._half) * gradient for gradient in _gradients(residual))
        difference = self._quadratic(wx * dx, (wx * dy + wy * dx) / 2, wy * dy)
        # In units in which the template's is the identity, so that no parameter drowns another.
        try:
            root = np.linalg.cholesky(own)
        except np.linalg.LinAlgError:
            return own, own
        whitening = np.linalg.inv(root)
        values, vectors = np.linalg.eigh(np.eye(8) + whitening @ difference @ whitening.T)
        half = root @ (vectors * np.sqrt(np.maximum(values - by_chance, least)))
        return own, np.asarray(half @ half.T)

    def _quadratic(self, xx: NDArray[np.float32], xy: NDArray[np.float32], yy: NDArray[np.float32]) -> NDArray[np.float64]:
        """Return the (8, 8) sums over pixels of products of two parameters' images, for products of gradients."""
        moments = [self._moments(image, 5) for image in (xx, xy, yy)]
        return np.asarray(sum(np.einsum("abij,ij->ab", product, m) for product, m in zip(_products(), moments, strict=True)))

    def _moments(self, image: NDArray[np.float32], count: int) -> NDArray[np.float64]:
        """Return the sums of an image times x^i y^j, i and j below `count`: (count, count)."""
        x, y = self._powers
        return np.asarray((image @ x[:, :count]).astype(np.float64).T @ y[:, :count])

    def _chance(self, weight: NDArray[np.float32]) -> float:
        """Return the curvature that noise has in common by chance, as a share of the template's."""
        independent = np.count_nonzero(weight) / max(1.0, 4 * np.pi * self._layer.blur_px**2)
        return 1 / float(np.sqrt(independent))

    def _expected_px(self, free: tuple[int, ...]) -> float:
        """Return the expected distance of a corner from where it should be, in px of the layer, if noise were white."""
        to_corners = slopes(self._rows, generators(self._layer.image.shape) @ self._rows)[:, list(free)]
        assert self._hessian is not None
        try:
            covariance = to_corners @ np.linalg.solve(self._hessian[np.ix_(free, free)], to_corners.T)
        except np.linalg.LinAlgError:
            return 0.0
        return float(np.sqrt(max(np.trace(covariance), 0.0) / 4))

    def _in_parameters(self, homography: NDArray[np.float64], information: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert the information on a step to that on p1..p8 of the homography it changes."""
        changed = homography @ generators(self._layer.image.shape) @ self._rows
        to_corners = slopes(homography @ self._rows, changed)
        to_step = np.linalg.solve(to_corners, jacobian(homography, self._frame).reshape(8, 8))
        return np.asarray(to_step.T @ information @ to_step)


def _polynomials(terms: dict[int, tuple[tuple[float, int, int], ...]]) -> NDArray[np.float64]:
    """Return the coefficients of x^i y^j for each parameter: (8, 3, 3)."""
    coefficients = np.zeros((8, 3, 3))
    for parameter, polynomial in terms.items():
        for factor, i, j in polynomial:
            coefficients[parameter, i, j] = factor
    return coefficients


# A small change of p1..p8 moves (x, y) by (p1 x + p3 y + p5 - p7 x^2 - p8 x y, p2 x + p4 y + p6 - p7 x y - p8 y^2).
_ALONG_X = _polynomials({0: ((1, 1, 0),), 2: ((1, 0, 1),), 4: ((1, 0, 0),), 6: ((-1, 2, 0),), 7: ((-1, 1, 1),)})
_ALONG_Y = _polynomials({1: ((1, 1, 0),), 3: ((1, 0, 1),), 5: ((1, 0, 0),), 6: ((-1, 1, 1),), 7: ((-1, 0, 2),)})


@cache
def _products() -> tuple[NDArray[np.float64], ...]:
    """Return the coefficients of x^i y^j of two parameters' product, (8, 8, 5, 5), for gx gx, gx gy and gy gy."""

    def product(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
        result = np.zeros((8, 8, 5, 5))
        for i in range(3):
            for j in range(3):
                result[:, :, i : i + 3, j : j + 3] += first[:, None, i, j, None, None] * second[None]
        return result

    return (
        product(_ALONG_X, _ALONG_X),
        product(_ALONG_X, _ALONG_Y) + product(_ALONG_Y, _ALONG_X),
        product(_ALONG_Y, _ALONG_Y),
    )


def _details(image: NDArray[np.float32], seen: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return what differs from the surroundings."""
    mask = seen.astype(np.float32)
    around, norm = (cv2.GaussianBlur(each, (0, 0), _SURROUNDINGS_PX) for each in (image * mask, mask))
    return np.asarray(image - around / np.maximum(norm, 1e-6), dtype=np.float32)


def _powers(length: int, half: float) -> NDArray[np.float32]:
    """Return the powers 0 to 4 of the coordinates of a side, from its middle, in units of half the longer side."""
    coordinates = (np.arange(length) - (length - 1) / 2) / half
    return np.asarray(np.power(coordinates[:, None], np.arange(5)), dtype=np.float32)


def _gradients(image: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    kernel = np.array([[-0.5, 0, 0.5]], dtype=np.float32)
    along_x, along_y = (cv2.filter2D(image, cv2.CV_32F, each) for each in (kernel, kernel.T))
    return np.asarray(along_x, dtype=np.float32), np.asarray(along_y, dtype=np.float32)
