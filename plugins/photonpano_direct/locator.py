"""Locator `direct`: inverse-compositional alignment of brightness (Baker and Matthews 2004), coarse to fine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from photonpano import FloatArray, Homography, Located, NotLocated, VirtualExposure
from photonpano.geometry import Camera, likely_rotations, parameters, rescaled, scaled_ahead, translation, unit_coordinates
from photonpano.locating import (
    ALL_PARAMETERS,
    NOTHING_SEEN,
    Follows,
    correlation_peaks,
    correlation_surface,
    free_parameters,
    turn_slopes,
)
from photonpano.photometry import Similarity, hann_window
from photonpano_direct.alignment import Aligned, Quality, align
from photonpano_direct.hooks import DirectConfig
from photonpano_direct.pyramid import JUDGED, Pyramid, masked, part_following, pyramid_of, shifts_between, similarity_under

_EXACT_PX = 0.1  # expected corner error below which coarser layers are not considered
_COARSE_TOLERANCE = 12  # tolerance of coarser layers, which initialise the finest, relative to `converged_px`
_PEAK_PX = 0.5  # standard deviation of the peaks of the phase correlation, px of the coarsest layer
_RIVAL = 0.7  # peaks of at least this fraction of the highest are hypotheses, too
_RESTRICTED = 2  # alignments of a hypothesis, each restricted to where the last one fits
_TRUST = 3.0  # weight of the part that follows the motion known so far, which many pairs have determined
# Corner error above which a pair does not determine eight parameters; for a rotating camera, three are estimated instead.
_DETERMINED_PX = 1.0
_CONTRADICTION = 9.0  # mean squared deviation of the eight parameters, over what the images allow, that a rotation may have
# Largest residual that different motion blur explains, as a fraction of the contrast; in much light, many times the noise.
_BLUR_DIFFERENCE = 0.1


class _Descent(NamedTuple):
    homography: Homography  # (3, 3) the motion, in pixels of the finest layer
    # scales of the layers on which all parameters were estimated, and their alignments, coarsest first
    found: Sequence[tuple[float, Aligned]]
    failure: NotLocated | None  # why a layer could not be aligned, of the last one that could not; None if all could


class DirectLocator:
    """Aligns exposures by their brightness, coarse to fine, and leaves out a part that follows another motion."""

    def __init__(self, config: DirectConfig, camera_matrix: FloatArray | None = None) -> None:
        """Take (3, 3) K, in px of the exposures, of a camera that only turns; None for any other."""
        self._config = config
        self._camera_matrix = camera_matrix

    def turning(self, camera_matrix: FloatArray) -> DirectLocator:
        """Return the locator for a camera that only turns: see `photonpano.LocatesTurns`."""
        return DirectLocator(self._config, camera_matrix)

    def describe(self, exposure: VirtualExposure) -> Pyramid:
        """Return the pyramid of the exposure on the scale on which photon noise is uniform."""
        return pyramid_of(exposure, self._config.pyramid_levels, self._config.blur_px)

    def hypotheses(self, moving: Pyramid, fixed: Pyramid) -> Sequence[Homography]:
        """Return shifts to start from, likeliest first; see `photonpano.KeepsHypotheses`.

        The phase correlation of the coarsest layers peaks there.
        """
        coarsest = moving.layers[-1], fixed.layers[-1]
        if not all(layer.weight.any() for layer in coarsest):
            return []
        height, width = coarsest[0].image.shape
        window = hann_window((height, width))
        flat = [np.where(layer.weight > 0, layer.image - layer.image[layer.weight > 0].mean(), 0) for layer in coarsest]
        spectra = [np.fft.rfft2(window * image) for image in flat]
        surface = correlation_surface(spectra[1] * spectra[0].conj(), (height, width), _PEAK_PX)
        if surface is None:
            return []
        shifts, _ = correlation_peaks(surface, _RIVAL)
        return [rescaled(translation(x, y), 2.0 ** (len(moving.layers) - 1)) for x, y in shifts]

    def register(self, moving: Pyramid, fixed: Pyramid, initial: Homography | None) -> Located | NotLocated:
        """Align; see `photonpano.Locator`."""
        if not (moving.layers[-1].weight.any() and fixed.layers[-1].weight.any()):
            return NotLocated(NOTHING_SEEN)
        searches = initial is None
        if initial is None:
            initial = next(iter(self.hypotheses(moving, fixed)), np.eye(3))
        start = np.array(initial, dtype=np.float64)
        outcome = _Alignment(self._config, None).aligned(moving, fixed, start, searches)
        if self._camera_matrix is None or _determined(outcome):
            return outcome
        turned = _Alignment(self._config, self._camera_matrix).aligned(moving, fixed, start, searches)
        return outcome if isinstance(turned, NotLocated) or _contradicts(turned, outcome) else turned


def _contradicts(turned: Located, outcome: Located | NotLocated) -> bool:
    """Return whether a rotation is far from the homography that aligns the same images, for what these say of it."""
    if isinstance(outcome, NotLocated) or outcome.information is None:
        return False
    away = parameters(turned.homography) - parameters(outcome.homography)
    return float(away @ outcome.information @ away) > _CONTRADICTION * len(away)


def _determined(outcome: Located | NotLocated) -> bool:
    """Return whether a pair determines all eight parameters of a homography."""
    return isinstance(outcome, Located) and outcome.residual_px is not None and outcome.residual_px <= _DETERMINED_PX


class _Alignment:
    """Estimates of the parameters of a homography, or of a rotation."""

    def __init__(self, config: DirectConfig, camera_matrix: FloatArray | None) -> None:
        """Estimate all eight parameters without `camera_matrix`, and three with it."""
        self._config = config
        self._camera = None if camera_matrix is None else Camera(camera_matrix)

    def aligned(self, moving: Pyramid, fixed: Pyramid, start: Homography, searches: bool) -> Located | NotLocated:
        """Align from a start; `searches`: whether other motions are tried where the image has several."""
        n_layers = len(moving.layers)
        if self._camera is not None:
            turned = likely_rotations(self._camera, start[None], moving.layers[0].image.shape)
            start = scaled_ahead(self._camera.homographies(turned[0]))
        judged = min(JUDGED, n_layers - 1)
        coarse = self._descend(moving, fixed, start, start, range(judged, n_layers))
        moving, coarse = self._of_majority(moving, fixed, coarse, start, judged, searches)
        fine = self._descend(moving, fixed, coarse.homography, start, range(judged))
        found = [*coarse.found, *fine.found]
        # The failure of a coarse layer does not count: the next one starts where it started.
        if not found:
            return fine.failure or coarse.failure or NotLocated(NOTHING_SEEN)
        scale, homography, quality = self._best(found)
        similarity = similarity_under(rescaled(homography, 0.5**moving.compared), moving.details, fixed.details)
        # The variance of noise, in pixels of a layer, falls with their area.
        contrast = moving.details.contrast * (0.5**moving.compared / scale) ** 2
        return self._judged(homography, quality, scale, similarity, contrast)

    def _descend(
        self, moving: Pyramid, fixed: Pyramid, homography: Homography, prior_mean: Homography, depths: range
    ) -> _Descent:
        """Align some layers, the coarsest first; a layer that fails is skipped."""
        failure = None
        found: list[tuple[float, Aligned]] = []
        for depth in reversed(depths):
            scale = 0.5**depth
            basis, complete = self._basis(depth, moving)
            aligned = align(
                moving.layers[depth],
                fixed.layers[depth],
                rescaled(homography, scale),
                rescaled(prior_mean, scale),
                basis,
                self._config.converged_px * (1 if depth == 0 else _COARSE_TOLERANCE),
                self._config.max_iterations,
            )
            if isinstance(aligned, Aligned) and aligned.overlap < self._config.min_overlap:
                least = self._config.min_overlap
                aligned = NotLocated(
                    f"both exposures see {aligned.overlap:.0%} of the image, less than min_overlap = {least:g}"
                )
            if isinstance(aligned, NotLocated):
                failure = aligned
                continue
            homography = rescaled(aligned.homography, 1 / scale)
            if complete:
                found.append((scale, aligned))
        return _Descent(homography, found, failure)

    def _basis(self, depth: int, pyramid: Pyramid) -> tuple[FloatArray, bool]:
        """Return the changes of p1..p8 that are estimated on a layer, (8, K), and whether these are all that are unknown."""
        if self._camera is None:
            free = free_parameters(depth, len(pyramid.layers))
            return np.ascontiguousarray(np.eye(8)[:, list(free)]), free == ALL_PARAMETERS
        height, width = pyramid.layers[depth].image.shape
        matrix = unit_coordinates((height, width)) @ self._camera.scaled(0.5**depth).matrix
        return np.ascontiguousarray(turn_slopes(np.eye(3), matrix)), True

    def _of_majority(
        self, moving: Pyramid, fixed: Pyramid, first: _Descent, start: Homography, judged: int, searches: bool
    ) -> tuple[Pyramid, _Descent]:
        """Restrict an alignment to the larger part that follows one motion, if the images do not follow it as a whole.

        `first` is the alignment from `start` of the coarse layers, down to the layer `judged` on which parts are compared. Of
        several motions, that of the camera fits most of the image.
        """
        n_layers = len(moving.layers)

        def part_of(homography: Homography) -> Follows:
            return part_following(moving.layers[judged], fixed.layers[judged], rescaled(homography, 0.5**judged))

        def aligned(kept: Pyramid, motion: Homography) -> _Descent:
            return self._descend(kept, fixed, motion, motion, range(judged, n_layers))

        part, motion = part_of(first.homography), first.homography
        if not part.suspect:
            return moving, first
        if searches:
            shifts = shifts_between(moving.layers[-1], fixed.layers[-1])
            others = [(rescaled(shift, 2.0 ** (n_layers - 1)), 1.0) for shift in shifts]
        else:
            others = [(start, _TRUST)]
        for other, trust in others:
            for _ in range(_RESTRICTED):
                follower = part_of(other)
                mask = (follower.part | follower.rather_than(part)) & ~part.rather_than(follower)
                other = aligned(masked(moving, mask), other).homography
            if (larger := part_of(other)).more_than(part, trust):
                part, motion = larger, other
        for _ in range(_RESTRICTED):
            restricted = masked(moving, part.inner)
            found = aligned(restricted, motion)
            motion = found.homography
            part = part_of(motion)
        return restricted, found

    def _best(self, found: Sequence[tuple[float, Aligned]]) -> tuple[float, Homography, Quality]:
        """Return scale, homography in px of the finest layer, and quality of the layer of least error: blur spoils others."""
        best: tuple[float, Homography, Quality] | None = None
        for scale, aligned in reversed(found):
            quality = aligned.quality(None if self._camera is None else self._camera.scaled(scale).matrix)
            if best is None or quality.std_px / scale < best[2].std_px / best[0]:
                best = scale, rescaled(aligned.homography, 1 / scale), quality
            if best[2].std_px / best[0] < _EXACT_PX:
                break
        assert best is not None
        return best

    def _judged(
        self, homography: Homography, quality: Quality, scale: float, similarity: Similarity, contrast: float
    ) -> Located | NotLocated:
        """Accept or reject an alignment; `quality` and `contrast` are in pixels of the layer at `scale`."""
        config, std_px = self._config, quality.std_px / scale
        max_noise_ratio = max(config.max_noise_ratio, _BLUR_DIFFERENCE * contrast)
        evidence = {
            **similarity.evidence,
            "noise_ratio": quality.noise_ratio,
            "overlap": quality.overlap,
            "pixel": 1 / scale,
        }
        if reason := similarity.why_different(config.min_agreement):
            return NotLocated(reason, evidence)
        if quality.noise_ratio > max_noise_ratio:
            reason = f"after alignment the images differ by {quality.noise_ratio:.0f} times the photon noise, " + (
                f"more than max_noise_ratio = {config.max_noise_ratio:g}"
                if max_noise_ratio == config.max_noise_ratio
                else f"more than the {max_noise_ratio:.0f} times that blur explains"
            )
        elif std_px > config.max_std_px:
            reason = f"the images leave the corners uncertain by {std_px:.2g} px, more than max_std_px = {config.max_std_px:g}"
        else:
            units = np.array([1, 1, 1, 1, scale, scale, 1 / scale, 1 / scale])
            patches = quality.patches and quality.patches.rescaled(1 / scale)
            return Located(homography, quality.information * np.outer(units, units), std_px, evidence, patches)
        return NotLocated(reason, evidence)
