"""Direct alignment: inverse-compositional Lucas-Kanade on homographies (Baker and Matthews 2004), coarse to fine."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from photonpano import Located, NotLocated
from photonpano.geometry import corners, implausibility, inverse, jacobian, normalised, rescaled, translation
from photonpano_opencv.pyramid import pyramid_of
from photonpano_opencv.template import ALL, Template

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from photonpano import VirtualExposure
    from photonpano_opencv.configs import DirectConfig
    from photonpano_opencv.pyramid import Layer

_COARSE_MODELS = ((4, 5), (0, 1, 2, 3, 4, 5))
"""What moves at the coarsest level of the pyramid (translation) and at the next (affine); the others use all of p1..p8."""
_COARSE_TOLERANCE = 4
"""The coarser levels of the pyramid only start the finest, and may stop this much earlier."""


class DirectLocator:
    """Aligns exposures by their brightness, coarse to fine, weighted by the photon statistics of both."""

    def __init__(self, config: DirectConfig) -> None:
        self._config = config

    def describe(self, exposure: VirtualExposure) -> tuple[Layer, ...]:
        """Return the pyramid of the exposure on the scale on which photon noise is uniform, finest first."""
        return pyramid_of(exposure, self._config.pyramid_levels, self._config.blur_px)

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
            template = Template(moving[depth])
            free = _model(depth, len(moving), initial is not None)
            scale = 0.5**depth
            local = rescaled(homography, scale)
            tolerance = config.converged_px * (1 if depth == 0 else _COARSE_TOLERANCE)
            for _ in range(config.max_iterations):
                step = template.step(local, fixed[depth], free, config.blur_px * scale)
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

    def _judged(self, template: Template, homography: NDArray[np.float64], fixed: Layer) -> Located | NotLocated:
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


def _model(depth: int, levels: int, known: bool) -> tuple[int, ...]:
    """Return which of p1..p8 are free at a level of the pyramid."""
    from_coarsest = levels - 1 - depth
    if not known and from_coarsest < len(_COARSE_MODELS):
        return _COARSE_MODELS[from_coarsest]
    return ALL


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
