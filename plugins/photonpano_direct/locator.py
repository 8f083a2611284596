"""Locator `direct`: inverse-compositional alignment of brightness (Baker and Matthews 2004), coarse to fine.

The layers of an image pyramid lie on the scale on which photon noise is uniform. Two layers are compared by their similarity
under a motion, by the part that follows a motion, and by the shifts under which most of one fits the other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from photonpano import BoolArray, FloatArray, Homography, Located, NotLocated, VirtualExposure
from photonpano.compiling import compiled
from photonpano.geometry import (
    Camera,
    likely_rotations,
    parameters,
    rescaled,
    run_from,
    sample_run,
    scaled_ahead,
    translation,
    unit_coordinates,
    visible_columns,
)
from photonpano.locating import (
    ALL_PARAMETERS,
    NOTHING_SEEN,
    SMALLEST_SIDE,
    Follows,
    View,
    correlation_peaks,
    correlation_surface,
    follows,
    free_parameters,
    turn_slopes,
    view_pyramid,
)
from photonpano.photometry import LOCAL_PX, Similarity, autocorrelation, hann_window, similarity_of, without_local_mean
from photonpano_direct.alignment import Aligned, Quality, align, buffers_of
from photonpano_direct.hooks import DirectConfig
from photonpano_direct.normal_equations import Image, Layer, differentiate, residuals_and_moments

# Aligned images are compared on the coarsest layer, of the first three, with this shorter side: on a coarse one, noise and
# motion blur hardly matter.
_COMPARED, _COMPARED_PX = 2, 60
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


class Details(NamedTuple):
    """A layer without its local mean."""

    image: Image  # (H, W), the layer without its local mean; 0 at masked pixels
    weight: Image  # (H, W), that of the layer, 0 where the local mean is one-sided
    gain: float  # fraction of the variance of white noise that the blur leaves
    autocorrelation: FloatArray

    @property
    def contrast(self) -> float:
        """Mean square of the unmasked pixels relative to the variance of their noise."""
        seen = self.weight > 0
        return float(np.mean(np.square(self.image[seen]) * self.weight[seen])) / self.gain if seen.any() else 0.0


def similarity_under(homography: Homography, moving: Details, fixed: Details) -> Similarity:
    """Return the similarity of two images of one shape under a homography, from `moving` to `fixed`."""
    sums = np.empty(8)
    _sum_up(moving, fixed, homography, sums)
    pixels, first, second, squares, products, others, weight, other_weight = sums
    if not pixels:
        return Similarity(0.0, 0.0, 0.0)
    covariance = np.array([[squares, products], [products, others]]) - np.outer([first, second], [first, second]) / pixels
    # Averaged over sub-pixel positions, linear interpolation leaves 4/9 of the variance of white noise.
    noise = moving.gain * pixels / weight, 4 / 9 * fixed.gain * pixels / other_weight
    autocorrelations = moving.autocorrelation, fixed.autocorrelation
    return similarity_of(covariance / max(1.0, pixels - 1), noise, pixels, pixels * min(1.0, moving.gain), autocorrelations)


@compiled
def _sum_up(moving: Details, fixed: Details, homography: Homography, sums: FloatArray) -> None:
    """Sum over the pixels that both see: ones, both images, their squares and products, and both weights."""
    height, width = moving.image.shape
    there, there_weight = np.empty(width, np.float32), np.empty(width, np.float32)
    sums[:] = 0
    for y in range(height):
        first, last = visible_columns(homography, y, 0.0, width - 1.0, 0.0, height - 1.0, width)
        x = first
        while x < last:
            run = run_from(homography, x, y, last - x, height, width)
            sample_run(fixed.image, run, there[x : x + run.size])
            sample_run(fixed.weight, run, there_weight[x : x + run.size])
            x += run.size
        here, here_weight = moving.image[y], moving.weight[y]
        for x in range(first, last):
            if here_weight[x] > 0 and there_weight[x] > 0:
                a, b = float(here[x]), float(there[x])
                sums[0] += 1
                sums[1] += a
                sums[2] += b
                sums[3] += a * a
                sums[4] += a * b
                sums[5] += b * b
                sums[6] += here_weight[x]
                sums[7] += there_weight[x]


class Pyramid(NamedTuple):
    """An exposure and its halves."""

    layers: tuple[Layer, ...]  # finest first
    details: Details  # those of the layer `compared`

    @property
    def compared(self) -> int:
        """Number of the layer on which aligned images are compared."""
        return _compared(self.layers)


def pyramid_of(exposure: VirtualExposure, levels: int, blur_px: float) -> Pyramid:
    """Return an exposure, blurred against photon noise, and its halves; small images have fewer than `levels` layers."""
    layers = tuple(_layer_of(view) for view in view_pyramid(exposure, blur_px, levels, SMALLEST_SIDE))
    layer = layers[_compared(layers)]
    seen = layer.weight > 0
    image = without_local_mean(layer.image, seen)
    # Near a border the mean is one-sided: a gradient looks like a structure there, in any two images.
    inside = cv2.erode(seen.astype(np.uint8), np.ones((LOCAL_PX, LOCAL_PX), np.uint8), borderValue=0) > 0
    if 2 * np.count_nonzero(inside) < np.count_nonzero(seen):
        inside = seen  # a small image has hardly anything else
    image = np.where(inside, image, np.float32(0))
    weight = np.where(inside, layer.weight, np.float32(0))
    return Pyramid(layers, Details(image, weight, 1 / (4 * np.pi * layer.blur_px**2), autocorrelation(image)))


def _compared(layers: Sequence[Layer]) -> int:
    """Return the number of the layer on which aligned images are compared."""
    return max((n for n, layer in enumerate(layers[: _COMPARED + 1]) if min(layer.image.shape) >= _COMPARED_PX), default=0)


def _layer_of(view: View) -> Layer:
    # A Gaussian of standard deviation s leaves 1 / (4 pi s^2) of the variance of white noise.
    blur_px = 1 / math.sqrt(4 * math.pi * view.noise_left)
    gradients = np.empty((2, *view.shape), np.float32)
    differentiate(np.ascontiguousarray(view.image), gradients)
    smoothed = np.empty_like(gradients)
    for axis in (0, 1):
        cv2.GaussianBlur(gradients[axis], (0, 0), blur_px, dst=smoothed[axis])
    return Layer(np.ascontiguousarray(view.image), np.ascontiguousarray(view.weight), blur_px, gradients, smoothed)


JUDGED = 1  # layer on which parts are compared: coarse, so that noise and small errors of the motion do not matter
_DIFFERENT = 0.5  # cap on the residual of a pixel in a search for shifts, relative to its usual one
# Side of the squares compared in a search for shifts, and spacing of the shifts that are tried.
_SEARCH_PX, _NEAR_PX = 5, 2
_LEAST_SEEN = 0.3  # minimum overlap under a shift, as a fraction of the template
_TRIED = 3  # number of shifts that a search returns


def part_following(moving: Layer, fixed: Layer, homography: Homography) -> Follows:
    """Find the part of a template that follows a motion, (3, 3), to pixels of another image of the same shape."""
    buffers = buffers_of(moving)
    residuals_and_moments(moving, fixed, homography, buffers, np.empty((3, 3)), np.empty((3, 3)))
    noise_left = 1 / (4 * np.pi * moving.blur_px**2)
    unknown = np.full_like(buffers.weight, np.inf)
    noise = np.divide(np.float32(noise_left), buffers.weight, out=unknown, where=buffers.weight > 0)
    return follows(moving.image, moving.image + buffers.residual, noise, noise_left)


def shifts_between(moving: Layer, fixed: Layer) -> list[Homography]:
    """Return the shifts under which most of a template fits an image, the best first: what moves otherwise counts half at most.

    All shifts by whole pixels, up to a third of the image, are compared.
    """
    height, width = moving.image.shape
    reach_y, reach_x = height // 3, width // 3
    seen, margins = (moving.weight > 0).astype(np.float32), ((reach_y, reach_y), (reach_x, reach_x))
    image, known = np.pad(fixed.image, margins), np.pad((fixed.weight > 0).astype(np.float32), margins)
    shifts = [(y, x) for y in range(-reach_y, reach_y + 1) for x in range(-reach_x, reach_x + 1)]
    squares = np.empty((len(shifts), height, width), np.float32)
    for index, (y, x) in enumerate(shifts):
        part = slice(reach_y + y, reach_y + y + height), slice(reach_x + x, reach_x + x + width)
        both = known[part] * seen
        near = _blur(both, _SEARCH_PX)
        difference = _blur(((image[part] - moving.image) * both) ** 2, _SEARCH_PX)
        squares[index] = np.where(near > 0.5, difference / np.maximum(near, np.float32(1e-6)), np.float32(np.nan))
    n_seen = np.isfinite(squares).sum(axis=(1, 2))
    # Each pixel counts relative to its usual difference, so that a part with strong contrast counts no more than others.
    ordered = np.sort(squares, axis=0)  # NaN comes last
    middle = np.isfinite(squares).sum(axis=0, keepdims=True) // 2
    usual = np.maximum(np.nan_to_num(np.take_along_axis(ordered, middle, axis=0)), np.float32(1e-12))
    relative = np.minimum(squares / usual, _DIFFERENT)
    cost = np.nansum(relative, axis=(1, 2)) / np.maximum(np.isfinite(relative).sum(axis=(1, 2)), 1)
    cost[n_seen < _LEAST_SEEN * height * width] = np.inf
    found: list[tuple[int, int]] = []
    for index in np.argsort(cost):
        y, x = shifts[index]
        if all(max(abs(y - other_y), abs(x - other_x)) >= _NEAR_PX for other_y, other_x in found):
            found.append((y, x))
        if len(found) == _TRIED:
            break
    return [translation(x, y) for y, x in found]


def masked(pyramid: Pyramid, part: BoolArray) -> Pyramid:
    """Return a pyramid of which only a part is used, given on any of its layers."""

    def limited(weight: Image) -> Image:
        size = weight.shape[1], weight.shape[0]
        return weight * cv2.resize(part.astype(np.float32), size, interpolation=cv2.INTER_NEAREST)

    layers = tuple(layer._replace(weight=limited(layer.weight)) for layer in pyramid.layers)
    return pyramid._replace(layers=layers, details=pyramid.details._replace(weight=limited(pyramid.details.weight)))


def _blur(image: Image, side: int) -> Image:
    return np.asarray(cv2.blur(image, (side, side)), np.float32)


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
        if self._camera_matrix is None:
            return outcome
        if isinstance(outcome, Located) and outcome.residual_px is not None and outcome.residual_px <= _DETERMINED_PX:
            return outcome  # the pair determines all eight parameters of a homography
        turned = _Alignment(self._config, self._camera_matrix).aligned(moving, fixed, start, searches)
        return outcome if isinstance(turned, NotLocated) or _contradicts(turned, outcome) else turned


def _contradicts(turned: Located, outcome: Located | NotLocated) -> bool:
    """Return whether a rotation is far from the homography that aligns the same images, for what these say of it."""
    if isinstance(outcome, NotLocated) or outcome.information is None:
        return False
    away = parameters(turned.homography) - parameters(outcome.homography)
    return float(away @ outcome.information @ away) > _CONTRADICTION * len(away)


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
        moving, coarse = self._of_majority(moving, fixed, coarse, start=start, judged=judged, searches=searches)
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
                prior_mean=rescaled(prior_mean, scale),
                basis=basis,
                tolerance_px=self._config.converged_px * (1 if depth == 0 else _COARSE_TOLERANCE),
                max_steps=self._config.max_iterations,
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
        self, moving: Pyramid, fixed: Pyramid, first: _Descent, *, start: Homography, judged: int, searches: bool
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
