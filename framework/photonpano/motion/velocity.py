"""The constant velocity at which photons of different frames fit together best, where pairs of exposures show nothing.

Sums of photons along the right motion have the highest contrast, as in event-camera work (Gallego et al. 2018). Photon noise
adds to the contrast, too, by the product of each frame with itself; only products of different frames are therefore summed.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft, optimize

from photonpano.contracts.protocols import Source
from photonpano.errors import InputError, LocationError
from photonpano.execution.context import Context
from photonpano.geometry import corners, transform_points
from photonpano.merging import binned_mean, binning_of
from photonpano.robust import robust_std
from photonpano.values import FloatArray, FrameSpan

_SPANS = 128  # a capture is divided into at most this many spans
_FEWEST_SPANS = 8
_FEWEST_PIXELS = 2  # binned pixels of the shorter side of a frame
_LAGS = 4  # spans that are up to this many apart are compared in the search over all velocities
_FASTEST_SHIFT = 8.0  # fastest shift that is considered, in binned pixels from span to span
# Standard deviations of the Gaussians between whose scales structure is compared, in binned pixels. Brightness that varies over
# longer distances is light rather than scene, and has no sharp optimum.
_FINE, _COARSE = 1.0, 4.0
# Steps of the search, in binned pixels between the two farthest spans that are compared, at the border of the frame.
_STEP_PX = 1.0
# Least height of the peak, in standard deviations over all velocities: of noise alone, the highest reaches 5 to 6.5.
_SIGNIFICANT = 8.0
# Contrast over its noise falls to 0.71 when windows double, if the photons of their halves do not fit together at all.
_STEADY = 0.8
_LEAST_PX = 1.0  # what moves by less over the whole capture, in binned pixels, stands still
_WITHOUT = "; if the velocity is not constant, leave out motion.start"


_FASTEST = np.radians(20)  # fastest turn that is considered, in radians from span to span

Images = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Velocity:
    """A constant velocity of the image.

    Convention:
        Points are (x, y), y down, integers are pixel centres. A positive turn is clockwise as one sees the picture.
    """

    turn: float  # of the image, in radians per frame period
    shift: FloatArray  # (2,) velocity of what is at `middle`, in px per frame period
    middle: FloatArray  # (2,) point of the frame

    @property
    def centre(self) -> FloatArray:
        """The (2,) point about which the image turns; not finite if it only shifts."""
        x, y = self.shift
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(self.middle + np.divide([-y, x], self.turn))

    def after(self, periods: ArrayLike) -> FloatArray:
        """Return where the image is N times some frame periods later: (N, 3, 3) from pixels now to pixels then."""
        periods = np.asarray(periods, dtype=np.float64)
        angles = self.turn * periods
        cosine, sine = np.cos(angles), np.sin(angles)
        moved = np.zeros((len(periods), 3, 3))
        moved[:, 0, 0], moved[:, 0, 1], moved[:, 1, 0], moved[:, 1, 1], moved[:, 2, 2] = cosine, -sine, sine, cosine, 1
        shifts = periods[:, None] * mean_shift(self.shift, angles)
        moved[:, :2, 2] = self.middle + shifts - moved[:, :2, :2] @ self.middle
        return moved


class ConstantVelocity:
    """The trajectory of an image that moves at a constant velocity; the reference frame's homography is the identity."""

    def __init__(self, velocity: Velocity, reference: float) -> None:
        self._velocity, self._reference = velocity, reference

    def at(self, frame_indices: ArrayLike) -> FloatArray:
        """Return the homographies of N instants, in frames, to the reference frame: (N, 3, 3)."""
        return self._velocity.after(self._reference - np.asarray(frame_indices, dtype=np.float64))


def mean_shift(shift: FloatArray, angle: ArrayLike) -> FloatArray:
    """Return the mean of shifts, (..., 2) at first, that turn at a constant rate by angles (...) in radians: (..., 2)."""
    angle = np.asarray(angle, dtype=np.float64)
    along, across = np.sinc(angle / np.pi), np.sinc(angle / 2 / np.pi) * np.sin(angle / 2)
    x, y = shift[..., 0], shift[..., 1]
    return np.stack([along * x - across * y, across * x + along * y], axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class FoundVelocity:
    """A velocity that was found, and how certain it is."""

    velocity: Velocity
    covariance: FloatArray  # (3, 3) of the turn and the shift, from the scatter of the spans
    significance: float  # height of the peak, in standard deviations over all velocities
    halves: tuple[Velocity, Velocity]  # the velocities that the first and second half of the capture show each by itself

    @property
    def std_turn(self) -> float:
        """Standard deviation of the turn, in radians per frame period."""
        return float(np.sqrt(self.covariance[0, 0]))

    @property
    def text(self) -> str:
        """The velocity in words, with its standard deviation."""
        turn, std = np.degrees([self.velocity.turn, self.std_turn])
        if abs(turn) < 3 * std:
            (x, y), (std_x, std_y) = self.velocity.shift, np.sqrt(np.diagonal(self.covariance)[1:])
            return f"a shift by ({x:.4g} +- {std_x:.1g}, {y:.4g} +- {std_y:.1g}) px a frame"
        x, y = self.velocity.centre
        return f"a turn by {turn:.4g} +- {std:.1g} degrees a frame about ({x:.1f}, {y:.1f}) px"


def find_velocity(source: Source, context: Context) -> FoundVelocity:
    """Find the constant velocity of the image in all of a capture: a turn about any point, or a shift.

    First, spans of a few frames are compared with the next ones, for all velocities. The best one is then refined over windows
    that double until one holds the whole capture.

    Raises:
        InputError: the capture has fewer than 8 frames, or they are tiny.
        LocationError: no velocity stands out, what stands out stands still, or the velocity changes.
    """
    varying, seen, n_frames = varying_spans(source, context)
    velocity, significance = _searched(structure_of(halved(varying), halved(seen[None])[0]), context)
    velocity *= [1, 2, 2]
    images = structure_of(varying, seen)
    if significance < _SIGNIFICANT:
        raise LocationError(
            "motion.start: no constant velocity stands out from photon noise: the sharpest sum of photons is "
            f"{significance:.2g} standard deviations above those along other velocities, and {_SIGNIFICANT:g} are needed; "
            f"the scene may stand still or change its speed, or the capture is too dark or too short{_WITHOUT}"
        )
    whole = _Turning(images, len(images))
    if whole.moved_px(velocity) < _LEAST_PX:
        raise LocationError(
            "motion.start: what varies over time stays at its place in the frame, and so shows no motion; "
            f"if it is a lamp or a reflection, mask it (corrections: mask){_WITHOUT}"
        )
    size, before = min(4 * _LAGS, len(images)), -np.inf
    while True:
        contrast = _Turning(images, size)
        velocity = contrast.sharpest(velocity)
        if (height := contrast.height(velocity)) < _STEADY * before:
            raise LocationError(
                f"motion.start: the image does not move at a constant velocity: photons of {size * n_frames} frames fit "
                "together less well than those of half as many; take a shorter part of the capture "
                f"(source: with: frames){_WITHOUT}"
            )
        if size == len(images):
            break
        size, before = min(2 * size, len(images)), height
    half = len(images) // 2
    halves = tuple(_Turning(each, half).sharpest(velocity) for each in (images[:half], images[-half:]))
    scale, factor = binning_of(source), 1 / n_frames

    def of_frames(found: FloatArray) -> Velocity:
        return Velocity(float(found[0]) * factor, found[1:] * scale * factor, (whole.middle + 0.5) * scale - 0.5)

    units = factor * np.array([1, scale, scale])
    covariance = whole.covariance(velocity) * units[:, None] * units
    return FoundVelocity(of_frames(velocity), covariance, significance, (of_frames(halves[0]), of_frames(halves[1])))


def varying_spans(source: Source, context: Context) -> tuple[Images, Images, int]:
    """Return what varies over time, in binned pixels: (S, h, w), which pixels are seen: (h, w), and the frames of a span.

    What stands still, such as hot pixels and the light on the scene, is subtracted in proportion to the brightness of a span.
    """
    images, seen, n_frames = span_means(source, context, _SPANS)
    brightness = images.sum(axis=(1, 2))
    still = np.tensordot(brightness, images, 1) / max(float(brightness @ brightness), 1e-12)
    return images - brightness[:, None, None] * still, seen, n_frames


def span_means(source: Source, context: Context, most: int, binning: int | None = None) -> tuple[Images, Images, int]:
    """Return the means of up to `most` spans, in binned pixels: (S, h, w), which pixels are seen, and the frames of a span."""
    n_frames = -(-source.info.n_frames // most)
    spans = [FrameSpan(start, start + n_frames) for start in range(0, source.info.n_frames - n_frames + 1, n_frames)]
    if len(spans) < _FEWEST_SPANS:
        raise InputError(f"motion.start: {len(spans)} frames are too few to find a motion; at least {_FEWEST_SPANS} are needed")
    means = np.stack(list(context.in_order(partial(binned_mean, source, binning=binning), spans)))
    if min(means.shape[1:]) < _FEWEST_PIXELS:
        raise InputError(f"motion.start: frames of {source.info.height}x{source.info.width} px are too small to show a motion")
    known, images = np.isfinite(means), np.nan_to_num(means)
    n_known = known.sum(axis=0)
    seen = (n_known > 0).astype(np.float32)
    # What is masked for a time shows neither motion nor edges.
    images = np.where(known, images, images.sum(axis=0) / np.maximum(n_known, 1).astype(np.float32))
    return images, seen, n_frames


def structure_of(images: Images, seen: Images) -> Images:
    """Return the structure of images at the scales that fix a velocity: (S, h, w), with 0 where `seen`, (h, w), is 0."""
    share = cv2.GaussianBlur(seen, (0, 0), _COARSE) + np.float32(1e-6)
    found = [cv2.GaussianBlur(each, (0, 0), _FINE) - cv2.GaussianBlur(each, (0, 0), _COARSE) / share for each in images]
    return np.asarray(np.stack(found) * seen, np.float32)


def halved(images: Images) -> Images:
    """Return images at half the size."""
    size = (images.shape[-1] // 2, images.shape[-2] // 2)
    return np.stack([cv2.resize(each, size, interpolation=cv2.INTER_AREA) for each in images])


def _searched(images: Images, context: Context) -> tuple[FloatArray, float]:
    """Return the velocity at which spans (S, h, w) fit the next ones best, and its height in standard deviations over all.

    It is (3,): the turn, and the shift in binned pixels, from one span to the next. For each turn, the correlation of images
    that are turned back, as a function of the shift, is computed for all pairs of spans of each distance at once: the motion
    between them is the same.
    """
    step = _STEP_PX / _LAGS
    turn_step = step / (min(images.shape[1:]) / 2)
    turns = turn_step * np.arange(-(_FASTEST // turn_step), _FASTEST // turn_step + 1)
    shifts = np.arange(-_FASTEST_SHIFT, _FASTEST_SHIFT + step / 2, step)
    velocities = np.stack(np.meshgrid(shifts, shifts), axis=-1).reshape(-1, 2)
    shape = tuple(fft.next_fast_len(side + side // 2, real=True) for side in images.shape[1:])
    spectra = fft.rfft2(images, shape)
    found = list(context.in_order(partial(_fits, images, spectra, shape, velocities), turns.tolist()))
    fits = np.stack(found)
    best = np.unravel_index(int(fits.argmax()), fits.shape)
    height = float(fits[best]) / max(robust_std(fits), 1e-30)
    return np.array([turns[best[0]], *velocities[best[1]]]), height


def _fits(
    images: Images, spectra: NDArray[np.complexfloating], shape: tuple[int, ...], velocities: FloatArray, turn: float
) -> FloatArray:
    """Return how well pairs of spans fit each other for one turn, and (N, 2) shifts: (N,)."""
    height, width = images.shape[1:]
    middle, fits = (np.array([width, height]) - 1) / 2, np.zeros(len(velocities))
    for lag in range(1, min(_LAGS, len(images) - 1) + 1):
        turned = np.stack([warped(each, Velocity(turn, np.zeros(2), middle).after([lag])[0]) for each in images[lag:]])
        products = np.zeros_like(spectra[0])
        for later, earlier in zip(turned, spectra, strict=False):
            products += fft.rfft2(later, shape) * earlier.conj()
        surface = fft.irfft2(products, shape).astype(np.float32)
        # An image that is turned back is shifted along the direction that the shift had when the turn began.
        points = lag * mean_shift(velocities, -turn * lag)
        # Beyond, less than half of the frames overlap, and the correlation wraps around.
        inside = (np.abs(points) < middle).all(axis=1)
        at = np.mod(points, [shape[1], shape[0]]).astype(np.float32)
        sampled = cv2.remap(surface, at[:, 0], at[:, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        fits += np.where(inside, sampled.ravel(), 0)
    return fits


def warped(image: Images, there: FloatArray) -> Images:
    """Return an image at the points to which a motion takes its pixels; 0 outside."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    if there[2, :2].any():
        return np.asarray(cv2.warpPerspective(image, there, image.shape[::-1], flags=flags), np.float32)
    return np.asarray(cv2.warpAffine(image, there[:2], image.shape[::-1], flags=flags), np.float32)


class Contrast(ABC):
    """The contrast of sums of spans (S, h, w) along a motion, over windows of some spans, without that of each by itself.

    Subclasses define the motion by its (k,) unknowns.
    """

    def __init__(self, images: Images, size: int) -> None:
        height, width = images.shape[1:]
        self.middle: FloatArray = (np.array([width, height]) - 1) / 2
        n_windows = len(images) // size
        start = (len(images) - n_windows * size) // 2
        self.spans, self._windows = slice(start, start + n_windows * size), n_windows
        self._images, self.size, self._corners = images[self.spans], size, corners((height, width))

    @abstractmethod
    def there(self, motion: FloatArray) -> FloatArray:
        """Return where pixels of the middle of each of W windows lie in each of its spans: (W, size, 3, 3) or (size, 3, 3)."""

    @property
    @abstractmethod
    def steps(self) -> FloatArray:
        """(k,) changes of the motion by which the border of the frame moves by about a binned pixel at the ends of a window."""

    def of_spans(self, motion: FloatArray) -> FloatArray:
        """Return the products of each span with all others of its window: (S,). Their sum is the contrast."""
        there = np.broadcast_to(self.there(motion), (self._windows, self.size, 3, 3))
        products: list[float] = []
        for start, maps in zip(range(0, len(self._images), self.size), there, strict=True):
            window = self._images[start : start + self.size]
            moved = np.stack([warped(*each) for each in zip(window, maps, strict=True)]).reshape(self.size, -1)
            products += (moved @ moved.sum(axis=0) - np.einsum("ij,ij->i", moved, moved)).tolist()
        return np.array(products)

    def height(self, motion: FloatArray) -> float:
        """Return the contrast in units of its noise, but for a factor that does not depend on the size of windows."""
        return float(self.of_spans(motion).sum()) / float(np.sqrt(len(self._images) * (self.size - 1)))

    def moved_px(self, motion: FloatArray) -> float:
        """Return how far corners of the frame move within a window, at most, in binned pixels."""
        there = self.there(motion)
        ends = (transform_points(there[..., end, :, :], self._corners) for end in (-1, 0))
        return float(np.linalg.norm(np.subtract(*ends), axis=-1).max())

    def sharpest(self, motion: FloatArray) -> FloatArray:
        """Return the motion of highest contrast near another one (Nelder and Mead 1965)."""
        steps = self.steps[: len(motion)]  # without that of the time, where this is known
        simplex = motion + np.concatenate([np.zeros((1, len(motion))), np.diag(steps)])
        scale = abs(float(self.of_spans(motion).sum())) or 1.0

        def lost(units: FloatArray) -> float:
            return -float(self.of_spans(units * steps).sum()) / scale

        found = optimize.minimize(
            lost,
            motion / steps,
            method="Nelder-Mead",
            options={"initial_simplex": simplex / steps, "xatol": 0.01, "fatol": 1e-5, "maxiter": 200},
        )
        return np.asarray(found.x * steps)

    def covariance(self, motion: FloatArray) -> FloatArray:
        """Return the covariance of the sharpest motion: (k, k), by the infinitesimal jackknife over spans (Efron 1982).

        It is inv(H) J inv(H): H are the second derivatives of the contrast, and J is the sum over spans of the squares of what
        each adds to the first ones.
        """
        steps = self.steps[: len(motion)] / 2
        centre = self.of_spans(motion)
        ahead, back = ([self.of_spans(motion + sign * step) for step in np.diag(steps)] for sign in (1, -1))
        # The contrast loses twice the products of a span with all others if that is left out.
        slopes = np.stack([2 * (one - other) / 2 for one, other in zip(ahead, back, strict=True)], axis=-1)
        curvature = np.zeros((len(motion), len(motion)))
        for i in range(len(motion)):
            for j in range(i):
                both = np.diag(steps)[i] + np.diag(steps)[j]
                mixed = self.of_spans(motion + both) + self.of_spans(motion - both) - ahead[i] - back[i] - ahead[j] - back[j]
                curvature[i, j] = curvature[j, i] = float((mixed + 2 * centre).sum()) / 2
            curvature[i, i] = float((ahead[i] + back[i] - 2 * centre).sum())
        inverted = np.linalg.pinv(curvature)
        return np.asarray(inverted @ (slopes.T @ slopes) @ inverted * steps[:, None] * steps)


class _Turning(Contrast):
    """The contrast along a constant velocity: the turn, and the shift of the middle, from one span to the next."""

    def there(self, motion: FloatArray) -> FloatArray:
        return Velocity(float(motion[0]), motion[1:], self.middle).after(np.arange(self.size) - (self.size - 1) / 2)

    @property
    def steps(self) -> FloatArray:
        ahead = (self.size - 1) / 2
        return np.array([1 / (float(self.middle.min()) * ahead), 1 / ahead, 1 / ahead])
