"""Direct alignment: inverse-compositional Lucas-Kanade on homographies (Baker and Matthews 2004), coarse to fine."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano import Located, NotLocated, VirtualExposure
from photonpano.geometry import translation
from photonpano.photometry import Similarity
from photonpano_direct.configs import DirectConfig
from photonpano_direct.layers import Layer
from photonpano_direct.pyramid import Pyramid, pyramid_of
from photonpano_direct.similarity import agreement
from photonpano_direct.small_matrices import rescaled
from photonpano_direct.template import ALL, Aligned, Quality, Template

_COARSE_MODELS = ((4, 5), (0, 1, 2, 3, 4, 5))
"""What moves at the coarsest level of the pyramid (translation) and at the next (affine); the others use all of p1..p8."""
_EXACT_PX = 0.1
"""A layer that tells corners to this is good enough."""
_COARSE_TOLERANCE = 12
"""The coarser levels of the pyramid only start the finest, and may stop this much earlier."""
_BLURRED_APART = 0.1
"""Motion blurs exposures of the same place differently: in much light they differ by up to this share of their contrast, which
is any number of times the photon noise."""


class DirectLocator:
    """Aligns exposures by their brightness, coarse to fine, weighted by the photon statistics of both."""

    def __init__(self, config: DirectConfig) -> None:
        self._config = config

    def describe(self, exposure: VirtualExposure) -> Pyramid:
        """Return the pyramid of the exposure on the scale on which photon noise is uniform."""
        return pyramid_of(exposure, self._config.pyramid_levels, self._config.blur_px)

    def register(self, moving: Pyramid, fixed: Pyramid, initial: NDArray[np.float64] | None) -> Located | NotLocated:
        """Align; see `photonpano.Locator`.

        Returns:
            `NotLocated` with the numbers that decided when the alignment diverges, when too little overlaps, or when the images
            do not look alike after it.
        """
        if not (moving.layers[-1].weight.any() and fixed.layers[-1].weight.any()):
            return NotLocated("nothing was seen far enough from what was not")
        depths = range(len(moving.layers))
        if initial is None:
            initial = _by_phase(moving.layers[-1], fixed.layers[-1], len(depths))
        start = homography = np.array(initial, dtype=np.float64)
        found: list[tuple[float, Template, Aligned]] = []
        for depth in reversed(depths):
            free, scale = _model(depth, len(depths)), 0.5**depth
            template = Template(moving.layers[depth], rescaled(start, scale))
            tolerance_px = self._config.converged_px * (1 if depth == 0 else _COARSE_TOLERANCE)
            aligned = template.aligned(
                rescaled(homography, scale), fixed.layers[depth], free, tolerance_px, self._config.max_iterations
            )
            if isinstance(aligned, Aligned) and aligned.overlap < self._config.min_overlap:
                aligned = f"both see {aligned.overlap:.0%} of the image, less than min_overlap = {self._config.min_overlap:g}"
            if isinstance(aligned, Aligned):
                homography = rescaled(aligned.homography, 1 / scale)
                if free == ALL:
                    found.append((scale, template, aligned))
            elif depth == 0 and not found:
                # A coarse layer that leads nowhere is passed over: the start may be good enough without it.
                return NotLocated(aligned)
        scale, homography, quality = _best(found)
        alike = agreement(moving.details, fixed.details, rescaled(homography, 0.5**moving.judge))
        # In pixels of the layer, of which noise is the less the larger they are.
        contrast = moving.details.contrast * (0.5**moving.judge / scale) ** 2
        return self._judged(homography, quality, scale, alike, contrast)

    def _judged(
        self, homography: NDArray[np.float64], quality: Quality, scale: float, alike: Similarity, contrast: float
    ) -> Located | NotLocated:
        """Say what is to be said of an alignment, whose quality and contrast are those of a layer of this scale."""
        config, std_px = self._config, quality.std_px / scale
        max_noise_ratio = max(config.max_noise_ratio, _BLURRED_APART * contrast)
        evidence = {
            **alike.evidence,
            "noise_ratio": quality.noise_ratio,
            "overlap": quality.overlap,
            "pixel": 1 / scale,
        }
        if reason := alike.why_different(config.min_agreement):
            return NotLocated(reason, evidence)
        if quality.noise_ratio > max_noise_ratio:
            reason = f"after alignment the images differ by {quality.noise_ratio:.0f} times the photon noise, " + (
                f"more than max_noise_ratio = {config.max_noise_ratio:g}"
                if max_noise_ratio == config.max_noise_ratio
                else f"more than the {max_noise_ratio:.0f} times that blur explains"
            )
        elif std_px > config.max_std_px:
            reason = f"the photons tell where corners lie to {std_px:.2g} px, worse than max_std_px = {config.max_std_px:g}"
        else:
            units = np.array([1, 1, 1, 1, scale, scale, 1 / scale, 1 / scale])
            return Located(homography, quality.information * np.outer(units, units), std_px, evidence)
        return NotLocated(reason, evidence)


def _best(found: Sequence[tuple[float, Template, Aligned]]) -> tuple[float, NDArray[np.float64], Quality]:
    """Return the scale, the homography in px of the finest layer, and the quality of the layer that tells most.

    Photons blurred by motion say nothing about details, whose noise a coarse layer averages out. Where the finest layer tells
    enough, coarser ones are not asked.

    Args:
        found: scales, templates and where they lie, coarsest first.
    """
    best: tuple[float, NDArray[np.float64], Quality] | None = None
    for scale, template, aligned in reversed(found):
        quality = template.quality(aligned)
        if best is None or quality.std_px / scale < best[2].std_px / best[0]:
            best = scale, rescaled(aligned.homography, 1 / scale), quality
        if best[2].std_px / best[0] < _EXACT_PX:
            break
    assert best is not None
    return best


def _model(depth: int, layers: int) -> tuple[int, ...]:
    """Return which of p1..p8 are free in a layer of the pyramid; few pixels bear few parameters."""
    from_coarsest = layers - 1 - depth
    return _COARSE_MODELS[from_coarsest] if depth > 0 and from_coarsest < len(_COARSE_MODELS) else ALL


def _by_phase(moving: Layer, fixed: Layer, levels: int) -> NDArray[np.float64]:
    """Return the shift between two images by phase correlation, in px of the finest level."""
    height, width = moving.image.shape
    window = cv2.createHanningWindow((width, height), cv2.CV_32F)
    flat = [np.where(layer.weight > 0, layer.image - layer.image[layer.weight > 0].mean(), 0) for layer in (moving, fixed)]
    (x, y), _ = cv2.phaseCorrelate(flat[0].astype(np.float32), flat[1].astype(np.float32), window)
    return rescaled(translation(x, y), 2.0 ** (levels - 1))
