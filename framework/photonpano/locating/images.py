"""Images of exposures for alignment and keypoints: variance-stabilised, blurred against photon noise, masked."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from photonpano.geometry import corners, generators, jacobian, rescaled, slopes, unit_coordinates, why_implausible
from photonpano.locating.configs import BlurPx, ImageLimits
from photonpano.photometry import (
    Similarity,
    autocorrelation,
    signal_to_noise,
    similarity_of,
    stabilised_flux,
    without_local_mean,
)
from photonpano.text import pixels
from photonpano.values import BoolArray, FloatArray, Homography, Located, NotLocated, VirtualExposure

# Fraction of pixels clipped to black and to white, so that single hot pixels do not reduce the contrast of the rest.
_CLIPPED = 0.001
_BORDER = 3  # pixels nearer to a masked area than this, in units of the blur, are masked in a view
_ALL_SEEN = 0.999  # an interpolated pixel is unmasked if its neighbours are, up to rounding
ALL_PARAMETERS = (0, 1, 2, 3, 4, 5, 6, 7)  # indices of p1..p8
TRANSLATION = (4, 5)  # indices of the parameters of a translation, p5 and p6
_AFFINE = (0, 1, 2, 3, 4, 5)
# Prior standard deviation of p1..p4, p7 and p8 in unit coordinates: between two exposures a camera rolls by 1 or 2 degrees, and
# scale, shear and perspective change as little.
PRIOR_STD = 0.03
MIN_COMMON_CURVATURE = 1e-3  # floor on the eigenvalues of the curvature that two images have in common, relative to their own
SMALLEST_SIDE = 24  # images are not halved to fewer pixels than this along a side
_INTERPOLATED = 13 / 18  # share of the noise of two aligned images that is left where one of them is interpolated linearly
_COMPARED_PIXEL = 4  # images are compared in pixels 4 times as large, where noise is small and motion blur hardly matters

# Reasons of `NotLocated`.
NO_TEXTURE = "the images do not overlap, or there is no texture where they do"
NOTHING_SEEN = "all pixels are masked, or too near to masked ones"


@dataclass(frozen=True, eq=False)
class View:
    """An exposure as an image for alignment."""

    # (H, W) float32, on the scale on which photon noise is uniform, blurred; 0 inside of masked areas
    image: NDArray[np.float32]
    weight: NDArray[np.float32]  # (H, W) float32, inverse noise variance of a pixel before the blur; 0 at masked pixels
    blur_px: float  # standard deviation of the blur, in px of the exposure
    pixel: int = 1  # side of a pixel, in px of the exposure

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)."""
        return self.image.shape[0], self.image.shape[1]

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(H, W) bool, False at masked pixels."""
        return self.weight > 0

    @cached_property
    def noise_left(self) -> float:
        """Fraction of the noise variance 1 / weight that remains in a pixel after the blur."""
        averaged = np.full(self.pixel, 1 / self.pixel)
        if self.blur_px > 0:
            kernel = cv2.getGaussianKernel(2 * math.ceil(4 * self.blur_px) + 1, self.blur_px)
            averaged = np.convolve(kernel.ravel().astype(np.float64), averaged)
        return self.pixel**2 * float(np.sum(averaged**2)) ** 2

    def halved(self) -> View:
        """Average squares of four pixels; a square is masked if one of its pixels is."""
        height, width = (side // 2 * 2 for side in self.shape)
        size = (width // 2, height // 2)
        image, weight, whole = (
            np.asarray(cv2.resize(each[:height, :width], size, interpolation=cv2.INTER_AREA), np.float32)
            for each in (self.image, self.weight, self.seen.astype(np.float32))
        )
        return View(image, np.where(whole == 1, 4 * weight, np.float32(0)), self.blur_px, 2 * self.pixel)

    def seen_from(self, homography: Homography) -> View:
        """Return this image on the grid of another one, interpolated linearly; the homography maps pixels of that one to it."""
        height, width = self.shape
        image, weight, whole = (
            np.asarray(
                cv2.warpPerspective(each, homography, (width, height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP),
                np.float32,
            )
            for each in (self.image, self.weight, self.seen.astype(np.float32))
        )
        return View(image, np.where(whole > _ALL_SEEN, weight, np.float32(0)), self.blur_px, self.pixel)


def view_of(exposure: VirtualExposure, blur_px: float) -> View:
    """Return an exposure as an image for alignment.

    Single masked pixels are interpolated. Pixels nearer to a masked area or a border than three times the blur are masked: the
    blur is one-sided there, which biases the alignment. `blur_px` is the standard deviation of the Gaussian blur against photon
    noise, in px of the exposure.
    """
    known = exposure.weight > 0
    std = exposure.response.stabilised_std(np.where(known, exposure.weight, np.float32(1)))
    # A pixel at a smaller scale averages those of the frames that it covers.
    variance = np.where(known, std * std, np.float32(0)) * np.float32(min(1.0, exposure.scale) ** 2)
    image, noise, near = _blurred(stabilised_flux(exposure), variance, known.astype(np.float32), blur_px=blur_px)
    bridged = cv2.morphologyEx(known.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    border = math.ceil(_BORDER * blur_px)
    square = np.ones((2 * border + 1, 2 * border + 1), np.uint8)
    seen = (cv2.erode(bridged, square, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0) & (noise > 0)
    image = np.divide(image, near, out=np.zeros_like(image), where=near > 0)
    return View(image, np.divide(near, noise, out=np.zeros_like(near), where=seen), blur_px)


def view_pyramid(exposure: VirtualExposure, blur_px: float, levels: int, smallest_side: int) -> tuple[View, ...]:
    """Return the image pyramid of an exposure, finest first, with at most `levels` views. For `blur_px`, see `view_of`.

    It ends before a side gets shorter than `smallest_side`, in px of a view.
    """
    views = [view_of(exposure, blur_px)]
    while len(views) < levels and min(views[-1].shape) >= 2 * smallest_side:
        views.append(views[-1].halved())
    return tuple(views)


def blur_against_noise(exposure: VirtualExposure, blur_px: BlurPx = "auto") -> float:
    """Return the standard deviation of the Gaussian blur against photon noise, in px: the value given, or that for `auto`.

    `auto` is 1 in the light, and up to 2.5 where noise exceeds the scene. In the light more blur costs accuracy (1.5 px instead
    of 1 px raised the error of a trajectory at flux 0.5 from 0.07 to 0.17 px), in the dark less blur does (at flux 0.02 most
    keypoints are noise then).
    """
    if blur_px != "auto":
        return blur_px
    return float(np.clip(2 / max(signal_to_noise(exposure), 1e-6), 1.0, 2.5))


def stabilised_8_bit(exposure: VirtualExposure, blur_px: float) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return an exposure on the scale on which its noise is uniform, blurred against noise, stretched to 8 bits.

    With uniform noise, keypoints are found in dark and bright parts alike; a linear or sRGB scale would favour one of them.
    Returns the image, and the mask of pixels that were seen, 0 or 255: (H, W) uint8 each.
    """
    known = exposure.weight > 0
    # Masked pixels have no weight; all others have the same, since weights by numbers of frames would shift structures.
    values = stabilised_flux(exposure)
    weighted, weight = _blurred(values, known.astype(np.float32), blur_px=blur_px)
    image = weighted / np.maximum(weight, 1e-6)
    mask = np.where(known, np.uint8(255), np.uint8(0))
    if not known.any():
        return np.zeros_like(mask), mask
    low, high = np.quantile(image[known], (_CLIPPED, 1 - _CLIPPED))
    stretched = (image - low) * (255 / max(high - low, 1e-6))
    return np.clip(np.rint(stretched), 0, 255).astype(np.uint8), mask


def _blurred(*images: NDArray[np.float32], blur_px: float) -> tuple[NDArray[np.float32], ...]:
    """Return images blurred by a Gaussian of this standard deviation."""
    if blur_px == 0:
        return images
    return tuple(np.asarray(cv2.GaussianBlur(image, (0, 0), blur_px), np.float32) for image in images)


def noise_of(noise_ratio: float) -> float:
    """Return the variance of the noise of two aligned images, relative to what is expected of photons, from their residuals.

    `noise_ratio` is the mean squared residual relative to the expected variance. The noise is below 1 in the dark, where pixels
    hold less than a photon and no scale makes noise uniform, and for sensors whose counts scatter less than those of photons.
    Interpolation alone makes residuals smaller, but not the noise.
    """
    return max(noise_ratio, min(1.0, noise_ratio / _INTERPOLATED), 1e-6)


def free_parameters(depth: int, layers: int) -> tuple[int, ...]:
    """Return which of p1..p8 to estimate on a layer of a pyramid, by its depth, 0 for the finest of the `layers`.

    Few pixels determine few parameters: a translation on the coarsest layer, an affine map on the next, then all eight, as
    always on the finest.
    """
    from_coarsest = layers - 1 - depth
    return (TRANSLATION, _AFFINE)[from_coarsest] if depth > 0 and from_coarsest < 2 else ALL_PARAMETERS


def coarse_to_fine(
    moving: Sequence[View],
    fixed: Sequence[View],
    start: Homography,
    align: Callable[[View, View, Homography, int], Homography | NotLocated],
) -> tuple[list[Homography], NotLocated | None]:
    """Align two pyramids layer by layer. A layer that fails is skipped: the next one starts where it started.

    Args:
        moving: views of one exposure, finest first.
        fixed: views of the other one.
        start: (3, 3) initial map, in pixels of the finest views.
        align: returns the map between two views, given an initial one and the depth of the layer, in pixels of these views.

    Returns:
        The maps of the layers that could be aligned, coarsest first, in pixels of the finest views; and why the finest layer
        could not be aligned, None if it could.
    """
    found: list[Homography] = []
    failure = None
    for depth in reversed(range(len(moving))):
        pixel = moving[depth].pixel
        outcome = align(moving[depth], fixed[depth], rescaled(start, 1 / pixel), depth)
        failure = outcome if isinstance(outcome, NotLocated) else None
        if not isinstance(outcome, NotLocated):
            start = rescaled(outcome, pixel)
            found.append(start)
    return found, failure


def motion_from_images(
    moving: View,
    fixed: View,
    homography: Homography,
    limits: ImageLimits,
    *,
    free: Sequence[int] = ALL_PARAMETERS,
    efficiency: float = 1.0,
    evidence: Mapping[str, float] | None = None,
) -> Located | NotLocated:
    """Accept or reject the homography that aligns two images, and compute its information. Raises nothing.

    With J the derivatives of brightness and W the inverse variances of the difference, the information is J^T W J over the
    ratio of the squared difference to photon noise. In the dark, noise has larger derivatives than the scene; so J^T J is the
    product of the derivatives of one image and those of the other, which have only the scene in common.

    Convention:
        The map takes pixels of `moving` to pixels of `fixed`; points are (x, y), integers are pixel centres.

    Args:
        moving: one image.
        fixed: the other one, of the same shape and blur.
        homography: (3, 3) estimate of the backend.
        limits: thresholds of acceptance.
        free: indices of the parameters p1..p8 that the backend estimated; the others get a weak prior.
        efficiency: fraction of the photons' information that the estimator uses; 1 for least squares.
        evidence: counts of the backend, for the record.

    Returns:
        `Located` with its information, the expected error of a corner as `residual_px`, `evidence`, and the numbers that
        decided; `NotLocated` if no camera moves like that, if the overlap is too small, if the images differ or have no
        texture, or if they leave the corners uncertain.
    """
    found = dict(evidence or {})
    if reason := why_implausible(homography, moving.shape, limits.min_overlap):
        return NotLocated(reason, found)
    there = fixed.seen_from(homography)
    both = moving.seen & there.seen
    found["overlap"] = float(both.mean())
    if found["overlap"] < limits.min_overlap:
        return NotLocated(
            f"after alignment both exposures see {found['overlap']:.0%} of the image, "
            f"less than min_overlap = {limits.min_overlap:.0%}",
            found,
        )
    similarity = _similarity(moving, there)
    found |= similarity.evidence
    if reason := similarity.why_different(limits.min_agreement):
        return NotLocated(reason, found)
    weight = np.asarray(1 / (1 / moving.weight[both] + 1 / there.weight[both]), np.float32)
    squares = weight * np.square(moving.image[both] - there.image[both])
    found["noise_ratio"] = float(squares.mean(dtype=np.float64)) / moving.noise_left
    curvature = _common_curvature(_derivatives(moving, both), _derivatives(there, both), weight)
    if curvature is None:
        return NotLocated("where the images overlap after alignment, there is no texture", found)
    curvature, estimated = curvature * efficiency / noise_of(found["noise_ratio"]), list(free)
    # Errors of the parameters that are held bias those that are estimated.
    rows = curvature[estimated]
    information = rows.T @ np.linalg.solve(curvature[np.ix_(estimated, estimated)], rows)
    held = [index for index in ALL_PARAMETERS if index not in estimated]
    information[held, held] += PRIOR_STD**-2.0
    # Derivatives (8, 8) of mapped corners by a small step in unit coordinates, and of a step by p1..p8.
    rows = np.concatenate([corners(moving.shape), np.ones((4, 1))], axis=1).T
    to_corners = slopes(homography @ rows, homography @ generators(moving.shape) @ rows)
    to_step = np.linalg.solve(to_corners, jacobian(homography, corners(moving.shape)).reshape(8, 8))
    covariance = np.linalg.inv(curvature[np.ix_(estimated, estimated)])
    std_px = float(np.sqrt(np.trace(to_corners[:, estimated] @ covariance @ to_corners[:, estimated].T) / 4))
    if not std_px <= limits.max_std_px:
        return NotLocated(
            f"the images leave the corners uncertain by {pixels(std_px)} px, more than max_std_px = {limits.max_std_px:g}",
            found,
        )
    return Located(homography, to_step.T @ information @ to_step, std_px, found)


def _similarity(moving: View, there: View) -> Similarity:
    """Return the similarity of two images on one grid, in large pixels."""
    while moving.pixel < _COMPARED_PIXEL and min(moving.shape) >= 2 * SMALLEST_SIDE:
        moving, there = moving.halved(), there.halved()
    both = moving.seen & there.seen
    pixels = int(np.count_nonzero(both))
    if not pixels:
        return Similarity(0.0, 0.0, 0.0)
    first, second = (without_local_mean(view.image, both) for view in (moving, there))
    noise = [view.noise_left * float(np.mean(1 / view.weight[both])) for view in (moving, there)]
    return similarity_of(
        np.cov(first[both], second[both]),
        (noise[0], noise[1]),
        pixels,
        pixels * min(1.0, moving.noise_left),
        (autocorrelation(first), autocorrelation(second)),
    )


def _derivatives(view: View, where: BoolArray) -> NDArray[np.float32]:
    """Return the derivatives of pixels with respect to p1..p8 in unit coordinates: (N, 8)."""
    height, width = view.shape
    unit = unit_coordinates(view.shape)
    rows, columns = np.nonzero(where)
    x, y = ((unit[axis, axis] * at + unit[axis, 2]).astype(np.float32) for axis, at in enumerate((columns, rows)))
    half = np.float32(max(height, width) / 2)
    along = []
    for kernel in (np.array([[-0.5, 0, 0.5]]), np.array([[-0.5], [0], [0.5]])):
        # Central differences; 0 where a neighbour is masked.
        neighbours = cv2.erode(view.seen.astype(np.uint8), np.ones(kernel.shape, np.uint8), borderValue=0)
        difference = np.where(neighbours, cv2.filter2D(view.image, -1, kernel), np.float32(0)).astype(np.float32)
        along.append(half * difference[where])
    along_x, along_y = along
    inwards = along_x * x + along_y * y
    return np.stack([along_x * x, along_y * x, along_x * y, along_y * y, along_x, along_y, -inwards * x, -inwards * y], axis=1)


def _common_curvature(
    moving: NDArray[np.float32], there: NDArray[np.float32], weight: NDArray[np.float32]
) -> FloatArray | None:
    """Return the (8, 8) curvature that two images have in common, which is that of the scene; None without texture."""
    weighted = weight[:, None] * there
    own = (moving.T @ (weight[:, None] * moving) + there.T @ weighted).astype(np.float64) / 2
    between = (moving.T @ weighted).astype(np.float64)
    try:
        root = np.linalg.cholesky(own)
    except np.linalg.LinAlgError:
        return None
    # Whitened by their own curvature, so that all parameters have the same scale.
    whitening = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(whitening @ (between + between.T) @ whitening.T / 2)
    half = root @ vectors * np.sqrt(np.maximum(values, MIN_COMMON_CURVATURE))
    return np.asarray(half @ half.T)


_SIDE_PX = 7  # side of the square in which two images are compared, px
# Relative variance of the difference of two aligned images from which on they differ: 0 for equal, 1 for unrelated images.
_DIFFERENT = 0.5
_STANDARD_ERRORS = 4.0  # by which the variances must exceed those of noise
_ALIKE = 0.25  # largest relative variance of an aligned part
_BORDER_PX = 2  # width of the mixed border around parts that move otherwise, px
_REST_PX = 4.0  # standard deviation of the Gaussian that smooths the weights of what does not follow, px
_SUSPECT = 0.12  # mean difference, each at most 0.5, above which other motions are tried: noise and blur leave less
# Share of the image from which on a part that shows something different may move otherwise: noise leaves no such part.
_SUSPECT_SHARE = 0.03
_CLEARLY = 0.5  # a pixel clearly follows the motion that leaves less than half of the difference of another one


class Follows(NamedTuple):
    """What follows a motion."""

    # (H, W) float32, local variance of the difference of the aligned images relative to the sum of their variances, from 0 to
    # 1; NaN without enough texture
    difference: NDArray[np.float32]

    @property
    def part(self) -> BoolArray:
        """(H, W), True where the image follows, and where it lacks texture."""
        return ~(self.difference > _ALIKE)

    @property
    def inner(self) -> BoolArray:
        """(H, W), that part without the border of larger parts that do not follow."""
        beyond = cv2.dilate(_opened(~self.part), np.ones((2 * _BORDER_PX + 1, 2 * _BORDER_PX + 1), np.uint8)) > 0
        return np.asarray(self.part & ~beyond)

    @property
    def rest(self) -> NDArray[np.float32]:
        """(H, W) weights of what does not follow, without edges that would correlate with themselves."""
        smooth = cv2.GaussianBlur(np.nan_to_num(self.difference), (0, 0), _REST_PX)
        return np.asarray(np.maximum(2 * smooth / max(float(smooth.max()), 1e-6) - 1, 0), np.float32)

    def rather_than(self, other: Follows) -> BoolArray:
        """(H, W), True where the image clearly follows this motion and not another one."""
        return np.asarray(self.difference < _CLEARLY * other.difference)

    @property
    def suspect(self) -> bool:
        """Whether a part of the image may move otherwise."""
        textured = self.difference[np.isfinite(self.difference)]
        mean = float(np.minimum(textured, _DIFFERENT).mean()) if textured.size else 0.0
        return mean > _SUSPECT or float(_opened(self.difference > _DIFFERENT).mean()) > _SUSPECT_SHARE

    def extent_beyond(self, other: Follows) -> float:
        """Return how large the part is that clearly follows this motion and not another one, and how far it spreads.

        The scene surrounds an object, so an area counts by its extent: the number of its pixels times the standard deviations
        of their coordinates.
        """
        y, x = np.nonzero(self.rather_than(other))
        return float(len(y) * y.std() * x.std()) if len(y) else 0.0

    def more_than(self, other: Follows, trust: float = 1.0) -> bool:
        """Whether the part that clearly follows this motion is larger, and spreads further, than that of another motion.

        `trust` is a factor on the extent of this part, for a motion that is known from elsewhere.
        """
        return trust * self.extent_beyond(other) > other.extent_beyond(self)


def follows(
    moving: NDArray[np.float32], fixed: NDArray[np.float32], noise: NDArray[np.float32], noise_left: float = 1.0
) -> Follows:
    """Find the part of an image that follows the motion by which another one was aligned to it.

    Args:
        moving: (H, W) the image.
        fixed: (H, W) the other one, seen along the motion.
        noise: (H, W) variance of the noise of their difference; infinite where either was not seen.
        noise_left: share of the variance of white noise that the blur of the images left, which makes neighbours alike.
    """
    seen = np.isfinite(noise).astype(np.float32)
    near = _averaged(seen)
    own = np.asarray(_averaged(np.where(seen > 0, noise, np.float32(0))) / np.maximum(near, np.float32(1e-6)), np.float32)
    difference, first, second = (_variance(image * seen, near) for image in (fixed - moving, moving, fixed))
    chance = np.float32(_STANDARD_ERRORS * np.sqrt(2 / (_SIDE_PX**2 * noise_left))) * own
    texture = first + second - own
    textured = (near > _DIFFERENT) & (seen > 0) & (texture > chance)
    relative = np.clip((difference - own) / np.maximum(texture, np.float32(1e-12)), 0, 1)
    return Follows(np.where(textured, relative, np.float32(np.nan)).astype(np.float32))


def _opened(part: BoolArray) -> NDArray[np.uint8]:
    """Return the squares that fit into a part of an image: 1 there, 0 elsewhere."""
    square = np.ones((_SIDE_PX, _SIDE_PX), np.uint8)
    return np.asarray(cv2.morphologyEx(part.astype(np.uint8), cv2.MORPH_OPEN, square), np.uint8)


def _variance(image: NDArray[np.float32], near: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the variance in the square around each pixel; `image` is 0 where nothing is seen."""
    near = np.maximum(near, np.float32(1e-6))
    return np.asarray(_averaged(image * image) / near - (_averaged(image) / near) ** 2, np.float32)


def _averaged(image: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(cv2.blur(image, (_SIDE_PX, _SIDE_PX)), np.float32)


_TAPER = 0.25  # the window falls to 0 at masked pixels, over this fraction of the shorter side


def shift_between(moving: View, fixed: View, peak_px: float = 1.5) -> FloatArray | None:
    """Return the shift (x, y) in px that maps `moving` to `fixed`, on one grid; None without overlap or without texture.

    For `peak_px`, see `shift_of_spectra`.
    """
    both = moving.seen & fixed.seen
    if not both.any():
        return None
    # Without a window, which falls to 0 at the borders of what was seen, these would correlate: they do not move.
    distance = cv2.distanceTransform(np.pad(both, 1).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    window = np.sin(np.pi / 2 * np.minimum(distance / (_TAPER * min(both.shape)), 1)) ** 2
    first, second = (window * (view.image - view.image[both].mean()) for view in (moving, fixed))
    return shift_of_spectra(fft.rfft2(first), fft.rfft2(second), both.shape, peak_px, gaussian_peak=True)


def shift_of_spectra(
    moving: NDArray[np.complexfloating],
    fixed: NDArray[np.complexfloating],
    shape: tuple[int, ...],
    peak_px: float,
    *,
    gaussian_peak: bool,
) -> FloatArray | None:
    """Return the shift (x, y) in px between two windowed images of mean 0, (H, W), from their spectra; None without texture.

    The inverse transform of the normalised cross-power spectrum peaks at the shift. All frequencies have the same weight in it,
    also those that hold only noise; so it is blurred, which makes the peak a Gaussian of the standard deviation `peak_px`. It
    is located by a Gaussian through three values, or by a parabola. The spectra are (H, W // 2 + 1).
    """
    surface = correlation_surface(fixed * moving.conj(), shape, peak_px)
    if surface is None:
        return None
    row, column = np.unravel_index(int(surface.argmax()), surface.shape)
    return _refined(surface, int(row), int(column), gaussian_peak)


def correlation_surface(cross: NDArray[np.complexfloating], shape: tuple[int, ...], peak_px: float) -> FloatArray | None:
    """Return the phase correlation of two images at each cyclic shift, (H, W), row by row from 0; None without texture.

    `cross`, (H, W // 2 + 1), is the spectrum of the fixed image times the conjugate spectrum of the moving one. Spectra of
    several pairs with one shift may be summed. The shape is (height, width) of the images, `peak_px` the standard deviation of
    the peak.
    """
    amplitude = np.abs(cross)
    if not amplitude.max() > 0:
        return None
    return np.asarray(fft.irfft2(_blur(shape, peak_px) * cross / np.maximum(amplitude, 1e-12 * amplitude.max()), s=shape))


def correlation_peaks(surface: FloatArray, least: float, most: int = 8) -> tuple[FloatArray, FloatArray]:
    """Return the shifts (x, y) of the highest local maxima of a `correlation_surface`, (P, 2) in px, and their heights, (P,).

    The lowest has the share `least` of the height of the highest. There are `most` at most, the highest first.
    """
    padded = np.pad(surface.astype(np.float32), 1, mode="wrap")
    highest_near = cv2.dilate(padded, np.ones((3, 3), np.uint8))[1:-1, 1:-1]
    rows, columns = np.nonzero((padded[1:-1, 1:-1] >= highest_near) & (surface >= least * surface.max()))
    order = np.argsort(-surface[rows, columns], kind="stable")[:most]
    shifts = [_refined(surface, int(rows[index]), int(columns[index]), gaussian=True) for index in order]
    return np.array(shifts).reshape(-1, 2), np.asarray(surface[rows[order], columns[order]])


def _refined(surface: FloatArray, row: int, column: int, gaussian: bool) -> FloatArray:
    """Return the shift (x, y) of a local maximum, to a fraction of a pixel."""
    height, width = surface.shape
    y = row + _vertex(surface[[row - 1, row, (row + 1) % height], column], gaussian)
    x = column + _vertex(surface[row, [column - 1, column, (column + 1) % width]], gaussian)
    # Shifts beyond half of the image come out as negative ones.
    return np.array([(x + width / 2) % width - width / 2, (y + height / 2) % height - height / 2])


@cache
def _blur(shape: tuple[int, ...], peak_px: float) -> FloatArray:
    """Return the spectrum of a Gaussian: (H, W // 2 + 1)."""
    height, width = shape
    down, across = np.meshgrid(fft.fftfreq(height), fft.rfftfreq(width), indexing="ij")
    return np.asarray(np.exp(-2 * (np.pi * peak_px) ** 2 * (down**2 + across**2)))


def _vertex(values: FloatArray, gaussian: bool) -> float:
    """Return where the curve through three values is highest, from the middle one, which is the largest of them."""
    before, here, after = np.log(np.maximum(values, 1e-3 * values[1])) if gaussian else values
    curvature = before - 2 * here + after
    return float((before - after) / (2 * curvature)) if curvature < 0 else 0.0
