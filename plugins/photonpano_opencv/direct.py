"""Direct alignment: inverse-compositional Lucas-Kanade on homographies (Baker and Matthews 2004)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from photonpano import Located, NotLocated
from photonpano.geometry import corners, from_parameters, implausibility, inverse, jacobian, normalised, rescaled, translation

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from photonpano import VirtualExposure
    from photonpano_opencv.configs import DirectConfig

_SMALLEST_SIDE = 24
"""The pyramid ends before an image gets smaller than this, in px."""
_BORDER = 3
"""Pixels this near to unseen ones, in units of the blur, are left out: theirs is one-sided, and pulls by a few 0.01 px."""
_COARSE_MODELS = ((4, 5), (0, 1, 2, 3, 4, 5))
"""What moves at the coarsest level of the pyramid (translation) and at the next (affine); the others use all of p1..p8."""


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """One level of a pyramid.

    Attributes:
        image: (H, W) float32, variance-stabilised and blurred.
        weight: (H, W) float32, inverse noise variance of a pixel before the blur; 0 where nothing was seen.
    """

    image: NDArray[np.float32]
    weight: NDArray[np.float32]


class DirectLocator:
    """Aligns exposures by their brightness, coarse to fine, weighted by the photon statistics of both."""

    def __init__(self, config: DirectConfig) -> None:
        self._config = config

    def describe(self, exposure: VirtualExposure) -> tuple[Layer, ...]:
        """Return the pyramid of the exposure on the scale on which photon noise is uniform, finest first."""
        known = exposure.weight > 0
        # arcsin(sqrt(k / n)) has the variance 1 / (4 n), whatever the flux.
        precision = np.zeros(known.shape, dtype=np.float32)
        precision[known] = exposure.response.stabilised_std(exposure.weight[known]) ** -2.0
        stabilised = np.where(known, exposure.response.stabilised(exposure.flux), np.float32(0))
        smooth = cv2.GaussianBlur(stabilised * precision, (0, 0), self._config.blur_px)
        norm = cv2.GaussianBlur(precision, (0, 0), self._config.blur_px)
        image = np.divide(smooth, norm, out=np.zeros_like(smooth), where=norm > 0)
        border = int(np.ceil(_BORDER * self._config.blur_px))
        square = np.ones((2 * border + 1, 2 * border + 1), np.uint8)
        inside = cv2.erode(known.astype(np.uint8), square, borderType=cv2.BORDER_CONSTANT, borderValue=0)
        layers = [Layer(image, precision * inside)]
        while len(layers) < self._config.pyramid_levels and min(layers[-1].image.shape) >= 2 * _SMALLEST_SIDE:
            layers.append(_halved(layers[-1]))
        return tuple(layers)

    def register(
        self, moving: tuple[Layer, ...], fixed: tuple[Layer, ...], initial: NDArray[np.float64] | None
    ) -> Located | NotLocated:
        """Align; see `photonpano.Locator`.

        Returns:
            `NotLocated` with the numbers that decided when the alignment diverges, when too little overlaps, or when the images
            do not look alike after it.
        """
        config = self._config
        if not (moving[-1].weight.any() and fixed[-1].weight.any()):
            return NotLocated("nothing was seen far enough from what was not")
        homography = _by_phase(moving[-1], fixed[-1], len(moving)) if initial is None else initial
        shape = moving[0].image.shape
        for depth in reversed(range(len(moving))):
            template = _Template(moving[depth], _model(depth, len(moving), initial is not None))
            scale = 0.5**depth
            local = rescaled(homography, scale)
            tolerance = config.converged_px * (1 if depth == 0 else 4)
            for _ in range(config.max_iterations):
                step = template.step(local, fixed[depth])
                if step is None:
                    return NotLocated("where the images overlap, if they do, there is no texture")
                local = normalised(local @ inverse(step))
                if reason := implausibility(rescaled(local, 1 / scale), shape, config.min_overlap):
                    return NotLocated(f"the alignment diverges at level {depth} of the pyramid: {reason}")
                if template.size_px(step) < tolerance:
                    break
            else:
                if depth == 0:
                    return NotLocated(f"the alignment has not settled after {config.max_iterations} steps")
            homography = rescaled(local, 1 / scale)
        return self._judged(template, homography, fixed[0])

    def _judged(self, template: _Template, homography: NDArray[np.float64], fixed: Layer) -> Located | NotLocated:
        quality = template.quality(homography, fixed, self._config.blur_px)
        evidence = {"zncc": quality.zncc, "noise_ratio": quality.noise_ratio, "overlap": quality.overlap}
        if quality.zncc < self._config.min_zncc:
            return NotLocated(
                f"after alignment the images correlate by {quality.zncc:.2f}, less than min_zncc = {self._config.min_zncc:g}",
                evidence,
            )
        if quality.noise_ratio > self._config.max_noise_ratio:
            return NotLocated(
                f"after alignment the images differ by {quality.noise_ratio:.0f} times the photon noise, "
                f"more than max_noise_ratio = {self._config.max_noise_ratio:g}",
                evidence,
            )
        corner_jacobian = jacobian(homography, corners(fixed.image.shape)).reshape(8, 8)
        return Located(homography, quality.information, _std_px(quality.information, corner_jacobian), evidence)


@dataclass(frozen=True, slots=True, eq=False)
class _Quality:
    information: NDArray[np.float64]
    zncc: float
    noise_ratio: float
    overlap: float


class _Template:
    """The moving image with its derivatives for small changes of p1..p8, in coordinates of about unit size."""

    def __init__(self, layer: Layer, free: tuple[int, ...]) -> None:
        self._layer = layer
        self._free = free
        height, width = layer.image.shape
        self._half = half = max(height, width) / 2
        self._unit = np.array([[1 / half, 0, (1 - width) / (2 * half)], [0, 1 / half, (1 - height) / (2 * half)], [0, 0, 1]])
        x = ((np.arange(width) - (width - 1) / 2) / half).astype(np.float32)
        y = ((np.arange(height) - (height - 1) / 2) / half).astype(np.float32)[:, None]
        gx, gy = (half * gradient for gradient in _gradients(layer.image))
        radial = -(gx * x + gy * y)
        images = (gx * x, gy * x, gx * y, gy * y, gx, gy, radial * x, radial * y)
        self._descent = np.stack([images[index].ravel() for index in free])
        self._hessian: NDArray[np.float64] | None = None

    def step(self, homography: NDArray[np.float64], fixed: Layer) -> NDArray[np.float64] | None:
        """Return the small homography of the template's frame that explains the residuals; None without overlap."""
        residual, weight = self._residual(homography, fixed)
        if not weight.any():
            return None
        weighted = self._descent * weight.ravel()
        if self._hessian is None:
            # With the noise in it: steps come out too short in the dark, but never too long.
            self._hessian = (weighted @ self._descent.T).astype(np.float64)
        try:
            change = np.linalg.solve(self._hessian, (weighted @ residual.ravel()).astype(np.float64))
        except np.linalg.LinAlgError:
            return None
        p = np.zeros(8)
        p[list(self._free)] = change
        return np.asarray(np.linalg.inv(self._unit) @ from_parameters(p) @ self._unit)

    def _signal_hessian(self, weight: NDArray[np.float32], s: float) -> NDArray[np.float64]:
        """Return the curvature that the scene causes, without that of the noise, which has gradients too."""
        descent = self._descent.astype(np.float64)
        hessian = (descent * weight.ravel()) @ descent.T
        noise = np.divide(1, self._layer.weight, out=np.zeros_like(weight), where=self._layer.weight > 0)
        # Variance of a central difference of white noise after a Gaussian of standard deviation s.
        amount = (weight * noise).ravel() * (self._half**2 * 0.5 * (1 - np.exp(-1 / s**2)) / (4 * np.pi * s**2))
        along_x, along_y = self._coordinates()
        floor = ((along_x * amount) @ along_x.T + (along_y * amount) @ along_y.T).astype(np.float64)
        values, vectors = np.linalg.eigh(hessian - floor)
        # Where noise exceeds the scene, next to nothing is known.
        return np.asarray((vectors * np.maximum(values, 1e-3 * np.diag(hessian).min())) @ vectors.T)

    def _coordinates(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return what multiplies the gradients along x and along y in the descent images: (8, H * W) each."""
        height, width = self._layer.image.shape
        x = np.broadcast_to(((np.arange(width) - (width - 1) / 2) / self._half).astype(np.float32), (height, width)).ravel()
        y = np.repeat(((np.arange(height) - (height - 1) / 2) / self._half).astype(np.float32), width)
        zero, one = np.zeros_like(x), np.ones_like(x)
        along_x = np.stack([x, zero, y, zero, one, zero, -x * x, -x * y])
        along_y = np.stack([zero, x, zero, y, zero, one, -y * x, -y * y])
        return along_x[list(self._free)], along_y[list(self._free)]

    def size_px(self, step: NDArray[np.float64]) -> float:
        """Return how far a step moves the corners of the template at most, in px of its layer."""
        frame = corners(self._layer.image.shape)
        moved = np.concatenate([frame, np.ones((4, 1))], axis=1) @ step.T
        return float(np.abs(moved[:, :2] / moved[:, 2:] - frame).max())

    def quality(self, homography: NDArray[np.float64], fixed: Layer, blur_px: float) -> _Quality:
        """Return how well the images agree, and the information on p1..p8 of `homography` in the photons of both."""
        residual, weight = self._residual(homography, fixed)
        seen = weight > 0
        here = self._layer.image[seen]
        there = here + residual[seen]
        here, there = here - here.mean(), there - there.mean()
        spread = float(np.sqrt(np.mean(here**2) * np.mean(there**2)))
        # White noise, and what the blur leaves of it in a pixel.
        variance = float(np.median(1 / weight[seen]))
        noise = variance / (4 * np.pi * blur_px**2)
        noise_ratio = float(np.mean(residual[seen] ** 2)) / noise
        # The blur correlates the noise of neighbours, so that the step scatters by H^-1 M H^-1 and not by H^-1.
        shape = self._layer.image.shape
        weighted = (self._descent * weight.ravel()).reshape(-1, *shape)
        hessian = self._signal_hessian(weight, blur_px)
        blurred = np.stack([cv2.GaussianBlur(image, (0, 0), blur_px) for image in weighted]).reshape(8, -1)
        # In float64: the eight parameters differ so much in scale that float32 would leave no digit of the result.
        blurred = blurred.astype(np.float64)
        scatter = blurred @ blurred.T * variance
        information = hessian @ np.linalg.solve(scatter, hessian) / max(1.0, noise_ratio)
        return _Quality(
            information=self._in_parameters(homography, information),
            zncc=float(np.mean(here * there)) / max(spread, 1e-12),
            noise_ratio=noise_ratio,
            overlap=float(seen.mean()),
        )

    def _in_parameters(self, homography: NDArray[np.float64], information: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert the information on a step to that on p1..p8 of the homography it changes."""
        frame = corners(self._layer.image.shape)
        basis = from_parameters(np.eye(8)) - np.eye(3)
        generators = np.linalg.inv(self._unit) @ basis @ self._unit
        rows = np.concatenate([frame, np.ones((4, 1))], axis=1).T
        mapped = homography @ rows
        changed = homography @ generators @ rows
        d = (changed[:, :2] - mapped[:2] / mapped[2] * changed[:, 2:]) / mapped[2]
        to_corners = d.transpose(2, 1, 0).reshape(8, 8)
        to_step = np.linalg.solve(to_corners, jacobian(homography, frame).reshape(8, 8))
        return np.asarray(to_step.T @ information @ to_step)

    def _residual(self, homography: NDArray[np.float64], fixed: Layer) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the fixed image seen from the template minus the template, and the inverse variance of the difference."""
        height, width = self._layer.image.shape
        # Linear interpolation would blur one image and not the other, which looks like a change of scale.
        cubic, linear = (kind | cv2.WARP_INVERSE_MAP for kind in (cv2.INTER_CUBIC, cv2.INTER_LINEAR))
        seen = cv2.warpPerspective(fixed.image, homography, (width, height), flags=cubic)
        weight = cv2.warpPerspective(fixed.weight, homography, (width, height), flags=linear)
        both = self._layer.weight + weight
        combined = np.divide(self._layer.weight * weight, both, out=np.zeros_like(both), where=both > 0)
        return seen - self._layer.image, combined


def _model(depth: int, levels: int, known: bool) -> tuple[int, ...]:
    """Return which of p1..p8 are free at a level of the pyramid."""
    from_coarsest = levels - 1 - depth
    if not known and from_coarsest < len(_COARSE_MODELS):
        return _COARSE_MODELS[from_coarsest]
    return tuple(range(8))


def _halved(layer: Layer) -> Layer:
    """Average squares of four pixels; a square counts if all of it was seen."""
    height, width = (side // 2 * 2 for side in layer.image.shape)
    size = (width // 2, height // 2)
    image = np.asarray(cv2.resize(layer.image[:height, :width], size, interpolation=cv2.INTER_AREA), dtype=np.float32)
    weight = cv2.resize(layer.weight[:height, :width], size, interpolation=cv2.INTER_AREA)
    whole = cv2.resize((layer.weight[:height, :width] > 0).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return Layer(image, np.where(whole == 1, 4 * weight, np.float32(0)))


def _gradients(image: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    kernel = np.array([[-0.5, 0, 0.5]], dtype=np.float32)
    along_x, along_y = (cv2.filter2D(image, cv2.CV_32F, each) for each in (kernel, kernel.T))
    return np.asarray(along_x, dtype=np.float32), np.asarray(along_y, dtype=np.float32)


def _by_phase(moving: Layer, fixed: Layer, levels: int) -> NDArray[np.float64]:
    """Return the shift between two images by phase correlation, in px of the finest level."""
    height, width = moving.image.shape
    window = cv2.createHanningWindow((width, height), cv2.CV_32F)
    flat = [np.where(layer.weight > 0, layer.image - layer.image[layer.weight > 0].mean(), 0) for layer in (moving, fixed)]
    (x, y), _ = cv2.phaseCorrelate(flat[0].astype(np.float32), flat[1].astype(np.float32), window)
    return rescaled(translation(x, y), 2.0 ** (levels - 1))


def _std_px(information: NDArray[np.float64], to_corners: NDArray[np.float64]) -> float:
    """Return the expected distance of a corner from where it should be, in px."""
    covariance = to_corners @ np.linalg.inv(information) @ to_corners.T
    return float(np.sqrt(np.trace(covariance) / 4))
