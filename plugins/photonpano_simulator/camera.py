"""The simulated camera: views of a plane or an equirectangular panorama through its lens, and a sensor that detects photons."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from functools import lru_cache
from pathlib import Path
from typing import Literal, TypeAlias

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from photonpano import Bayer, FloatArray, InputError
from photonpano.compiling import compiled
from photonpano.geometry import Camera, corners, transform_points, translation
from photonpano.photometry import BinaryResponse, IntensityResponse
from photonpano.reading import COLOURS, bayer_array, read_array, read_filter_array
from photonpano_simulator.config import FrameObject, IntensitySensor, Lens, Sensor, SimulationConfig, TurnPath

_KEPT = 16  # frames that are remembered for those that follow them, read by several threads
Incident: TypeAlias = Callable[[int], NDArray[np.float32]]

# The range of the draws, negated: 2^32 - 2^8 is the largest number below 2^32 that float32 represents.
_MINUS_RANGE = np.float32(2.0**8 - 2.0**32)
_POINTS_OF_A_SIDE = 16


"""Returns the photons that are detected per pixel in a frame that is taken, without dark counts: (H, W), a new array."""


class Draw(IntEnum):
    """The random quantities of a simulation, each with a generator of its own."""

    PHOTONS = 0
    HOT_PIXELS = 1
    SHAKE = 2
    PATH = 3
    GAINS = 4
    DIRT = 5
    TEXTURE = 6
    SCENE = 7
    GAZE = 8
    CLUTTER = 9
    PEOPLE = 10
    AFTERPULSES = 11
    CROSSTALK = 12
    DEAD_TIME = 13


def generator(seed: int, draw: Draw, index: int = 0) -> np.random.Generator:
    """Return a generator that depends on these three numbers alone."""
    # SFC64 is the fastest generator of numpy. The numbers are hashed, not added, so that the streams are independent.
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed, spawn_key=(draw, index))))


class SpadSensor:
    """Pixels that are 1 with the probability `1 - exp(-(q * flux + dark))` (paper, equation 2), and 0 else.

    Attributes:
        dark_rates: (H, W) float32, dark counts per frame period, those of hot pixels included.
        hot: (H, W) bool, the hot pixels.
        valid: (H, W) bool, False for hot pixels if the config masks them.
        gains: (H, W) float32, the sensitivity of each pixel, dirt included; 1 for an ideal one.
    """

    kind: Literal["binary"] = "binary"
    bits = 1
    exposure = 0.0

    def __init__(self, config: Sensor, frame_shape: tuple[int, int], seed: int) -> None:
        self.response = BinaryResponse()
        self._config, self._seed = config, seed
        if config.afterpulsing:
            self._detected = lru_cache(_KEPT)(self._detected)  # type: ignore[method-assign]
        self._rate, self._blind_after = lru_cache(_KEPT)(self._rate_of), lru_cache(_KEPT)(self._blinded)
        rng = generator(seed, Draw.HOT_PIXELS)
        self.hot: NDArray[np.bool_] = rng.random(frame_shape) < config.hot_fraction
        if config.hot_pixels is not None:
            mask = read_array(config.hot_pixels, "a mask")
            if mask.shape != frame_shape or mask.dtype != np.bool_:
                found = f"{mask.dtype} of shape {mask.shape}"
                raise InputError(f"{config.hot_pixels} holds {found}; a mask is bool of the frame's shape {frame_shape}")
            self.hot |= mask
        self.dark_rates: NDArray[np.float32] = np.full(frame_shape, config.dark_rate, np.float32)
        if config.dark_rates is not None:
            rates = read_array(config.dark_rates, "a file of rates")
            if rates.shape != frame_shape or rates.dtype.kind not in "fiu":
                found = f"{rates.dtype} of shape {rates.shape}"
                raise InputError(f"{config.dark_rates} holds {found}; rates are numbers of the frame's shape {frame_shape}")
            if not (np.all(np.isfinite(rates)) and np.all(rates >= 0)):
                raise InputError(f"{config.dark_rates} holds rates that are negative or not finite")
            self.dark_rates += rates.astype(np.float32)
        low, high = np.log(config.hot_rate)
        hot_rates = np.exp(rng.uniform(float(low), float(high), frame_shape)).astype(np.float32)
        self.dark_rates[self.hot] += hot_rates[self.hot]
        self._minus_dark_rates = -self.dark_rates
        self.valid: NDArray[np.bool_] = ~self.hot if config.mask_hot_pixels else np.ones(frame_shape, np.bool_)
        gains = np.maximum(1 + config.gain_std * generator(seed, Draw.GAINS).standard_normal(frame_shape), 0)
        if config.dirt is not None:
            dirt, (height, width) = config.dirt, frame_shape
            through = np.ones(frame_shape)  # the share of the light that passes the specks
            for x, y in generator(seed, Draw.DIRT).uniform((0, 0), (width, height), (dirt.specks, 2)):
                across = np.exp(-((np.arange(width) - x) ** 2) / (2 * dirt.radius_px**2))
                down = np.exp(-((np.arange(height) - y) ** 2) / (2 * dirt.radius_px**2))
                through *= 1 - dirt.loss * np.outer(down, across)
            gains *= through
        self.gains: NDArray[np.float32] = gains.astype(np.float32)

    def truth(self) -> dict[str, NDArray[np.generic]]:
        """Return the ground truth of the sensor: `dark_rates` and `hot_pixels`."""
        return {"dark_rates": self.dark_rates, "hot_pixels": self.hot}

    def frame(self, index: int, incident: Incident) -> NDArray[np.bool_]:
        """Take a frame with afterpulses and crosstalk, which depends on this frame and those before alone.

        Only detections have afterpulses, and these trigger no further ones; neither does crosstalk.
        """
        fired, shape = self._detected(index, incident), self.dark_rates.shape
        if self._config.afterpulsing and index:
            draws = generator(self._seed, Draw.AFTERPULSES, index).random(shape, np.float32)
            fired = fired | (self._detected(index - 1, incident) & (draws < self._config.afterpulsing))
        if self._config.crosstalk:
            draws = generator(self._seed, Draw.CROSSTALK, index).random((4, *shape), np.float32)
            right, left, down, up = (fired & (each < self._config.crosstalk) for each in draws)
            fired = fired.copy()
            fired[:, 1:] |= right[:, :-1]
            fired[:, :-1] |= left[:, 1:]
            fired[1:] |= down[:-1]
            fired[:-1] |= up[1:]
        return fired

    def _detected(self, index: int, incident: Incident) -> NDArray[np.bool_]:
        """Return which pixels detect a photon, or a dark count: (H, W)."""
        rng = generator(self._seed, Draw.PHOTONS, index)
        if not self._config.dead_time:
            return self.expose(incident(index), rng)
        # A detection in the last dead time of a frame is drawn first. A pixel that has none is dark with the probability with
        # which it is dark in all of the frame, exp(-rate * seeing), divided by that of none there.
        rate, late = self._rate(index, incident), self._blind_after(index, incident) > 0
        seeing = 1 - self._blind_after(index - 1, incident) if index else np.float32(1)
        dark = np.exp(-rate * seeing) * (1 + self._config.dead_time * rate)
        return np.asarray(late | (rng.random(rate.shape, np.float32) >= dark))

    def _rate_of(self, index: int, incident: Incident) -> NDArray[np.float32]:
        return incident(index) + self.dark_rates

    def _blinded(self, index: int, incident: Incident) -> NDArray[np.float32]:
        """Return for how long pixels are blind in the next frame, in frame periods: (H, W).

        A pixel that is blind for d after each detection detects rate / (1 + d rate) photons, and at most one in the time d: as
        many in the last d of a frame, each at any time there.
        """
        dead = np.float32(self._config.dead_time)
        expected = dead * self._rate(index, incident)
        chance = np.maximum(expected / (1 + expected), np.finfo(np.float32).tiny)
        draws = generator(self._seed, Draw.DEAD_TIME, index).random(chance.shape, np.float32)
        return np.where(draws < chance, dead * (1 - draws / chance), np.float32(0))

    def expose(self, flux: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.bool_]:
        """Take a frame of (H, W) photons that are detected per pixel, without dark counts; `flux` is overwritten."""
        # -p: the probability that no photon is detected, minus 1.
        chance = np.expm1(np.subtract(self._minus_dark_rates, flux, out=flux), out=flux)
        threshold = np.multiply(chance, _MINUS_RANGE, out=chance).astype(np.uint32)
        # Integers of 64 bits, each for two pixels, are drawn faster than floats.
        n_pixels = flux.size
        draws = rng.integers(0, 2**64, -(-n_pixels // 2), dtype=np.uint64).view(np.uint32)[:n_pixels]
        return draws.reshape(flux.shape) < threshold


class IntensityCamera:
    """Pixels of level `black_level + (photons + read noise) / photons_per_level`, rounded and clipped at the highest level."""

    kind: Literal["intensity"] = "intensity"

    def __init__(self, config: IntensitySensor, frame_shape: tuple[int, int], seed: int) -> None:
        self._seed = seed
        self.bits, self.exposure = config.bits, config.exposure
        self._top, self._read_noise = 2**config.bits - 1, config.read_noise
        photons_per_level = config.full_well / (self._top - config.black_level)
        noise = float(np.hypot(config.read_noise, photons_per_level / np.sqrt(12)))
        self.response = IntensityResponse(photons_per_level, config.black_level, self._top, noise)
        self.valid: NDArray[np.bool_] = np.ones(frame_shape, np.bool_)
        self.gains: NDArray[np.float32] = np.ones(frame_shape, np.float32)

    def frame(self, index: int, incident: Incident) -> NDArray[np.uint16]:
        """Take a frame."""
        return self.expose(incident(index), generator(self._seed, Draw.PHOTONS, index))

    def expose(self, flux: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.uint16]:
        """Take a frame of (H, W) expected detected photons per pixel."""
        photons = rng.poisson(flux) + self._read_noise * rng.standard_normal(flux.shape, np.float32)
        levels = photons / self.response.photons_per_level + self.response.black_level
        return np.clip(np.rint(levels), 0, self._top).astype(np.uint16)

    def truth(self) -> dict[str, NDArray[np.generic]]:
        """Return the ground truth of the sensor: nothing."""
        return {}


def bayer_of(config: Sensor | IntensitySensor) -> Bayer | None:
    """Return the Bayer array before the pixels; None for other filters."""
    filters = config.filters if isinstance(config, Sensor) else None
    return None if isinstance(filters, Path) else filters


def filter_array(config: Sensor, frame_shape: tuple[int, int]) -> NDArray[np.float32] | None:
    """Return what each pixel sees of red, green and blue, 1 or 0: (H, W, 3); None for a sensor without colour filters."""
    if config.filters is None:
        return None
    if isinstance(config.filters, Path):
        places = read_filter_array(config.filters)
        if places.shape != frame_shape:
            raise InputError(
                f"{config.filters} has the shape {places.shape}; sensor.filters needs that of the frame, {frame_shape}"
            )
    else:
        places = bayer_array(config.filters, frame_shape)
    return (np.array(list(COLOURS.values())) / 255).astype(np.float32)[places]


def undistorted(config: SimulationConfig, points: ArrayLike) -> FloatArray:
    """Return where a lens without distortion images what this lens images at (..., 2) points: see `Lens` and `Distortion`."""
    points = np.asarray(points, dtype=np.float64)
    if not any(config.distortion.coefficients):
        middle = middle_of(config.frame_shape)
        offsets = points - middle
        squared = _squared_distance(offsets, middle)[..., None]
        return np.asarray(middle + offsets / (1 + squared * (config.lens.k1 + squared * config.lens.k2)))
    ideal = camera(config).ideal(points)
    if np.isnan(ideal).any():
        raise InputError(
            f"distortion folds the image of {config.frame_shape[0]}x{config.frame_shape[1]} px at the focal length of "
            f"{config.focal_length_px:g} px, so that nothing is imaged at its border; take smaller coefficients"
        )
    return ideal


def camera(config: SimulationConfig) -> Camera:
    """Return the camera with OpenCV's distortion, which looks through the middle of its frames."""
    return Camera.of(config.focal_length_px, config.frame_shape, config.distortion.coefficients)


def distorts(config: SimulationConfig) -> bool:
    """Return whether straight lines become curves."""
    return bool(config.lens.k1 or config.lens.k2 or any(config.distortion.coefficients))


def outline(config: SimulationConfig) -> FloatArray:
    """Return points around the frame, (N, 2), as a lens without distortion images them."""
    around = corners(config.frame_shape)
    if not distorts(config):
        return around
    shares = np.arange(_POINTS_OF_A_SIDE)[:, None, None] / _POINTS_OF_A_SIDE
    return undistorted(config, ((1 - shares) * around + shares * np.roll(around, -1, axis=0)).reshape(-1, 2))


def pixel_grid(frame_shape: tuple[int, int]) -> FloatArray:
    """Return the centres of all pixels: (H, W, 2)."""
    height, width = frame_shape
    return np.stack(np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height)), axis=-1)


def transmission(lens: Lens, frame_shape: tuple[int, int]) -> NDArray[np.float32]:
    """Return the share of the light in the middle that reaches each pixel: (H, W)."""
    middle = middle_of(frame_shape)
    squared = _squared_distance(pixel_grid(frame_shape) - middle, middle)
    return (1 - lens.vignette * squared).astype(np.float32)


def middle_of(shape: tuple[float, float]) -> FloatArray:
    """Return the middle of an image of (height, width): (x, y)."""
    height, width = shape
    return np.array([(width - 1) / 2, (height - 1) / 2])


def _squared_distance(offsets: FloatArray, middle: FloatArray) -> FloatArray:
    """Return r^2 of (..., 2) offsets from the middle."""
    return np.asarray((offsets**2).sum(axis=-1) / (middle**2).sum())


_DETAIL_PX = (1.5, 5.0, 15.0)  # standard deviations of the Gaussian kernels that make a texture of white noise


class Views:
    """Renders frames of a scene.

    The flux between the pixels of the scene is interpolated linearly. Pixels of the camera have an area if the scene is finer
    than they are: its flux is averaged over squares of whole pixels of the scene, and the averages are interpolated.
    """

    def __init__(self, config: SimulationConfig) -> None:
        self._shape = config.frame_shape
        self._is_round = isinstance(config.path, TurnPath)
        self._points = None
        if distorts(config) or self._is_round:
            # (2, H, W), x and y of the pixels of a lens without distortion.
            points = undistorted(config, pixel_grid(config.frame_shape))
            self._points = np.ascontiguousarray(np.moveaxis(points, -1, 0))
        self._to_rays = np.linalg.inv(camera(config).matrix)
        # The side of the area of a pixel, in px of the scene. Averages over it are sampled where their middles lie.
        self._side = max(1, round(config.scene_scale * config.fill_factor**0.5))
        self._offset = (self._side - 1) / 2

    def averaged(self, scene: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the averages of squares of pixels of a scene, each where its first pixel lies."""
        if self._side == 1:
            return scene
        if self._is_round:
            scene = np.concatenate([scene, scene[:, : self._side]], axis=1)
        averages = cv2.boxFilter(scene, -1, (self._side, self._side), anchor=(0, 0), borderType=cv2.BORDER_REPLICATE)
        return np.asarray(averages[:, : -self._side] if self._is_round else averages, np.float32)

    def view(self, averages: NDArray[np.float32], homography: FloatArray) -> NDArray[np.float32]:
        """Return the flux of a scene in a frame, (H, W) or (H, W, 3), from `averaged`.

        The homography is (3, 3), pixels of the frame to pixels of the scene; before a panorama, K R K^-1, scaled by a positive
        number, where R turns directions of the frame to those of the panorama.
        """
        if self._points is not None and self._is_round:
            columns, rows = np.empty(self._shape, np.float32), np.empty(self._shape, np.float32)
            size = averages.shape[1], averages.shape[0]
            _look_around(self._points, self._to_rays @ homography, *size, self._offset, columns, rows)
            return np.asarray(cv2.remap(averages, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP))
        height, width = self._shape
        homography = translation(-self._offset, -self._offset) @ homography
        # The path lies inside the scene, up to rounding errors.
        border = cv2.BORDER_REPLICATE
        if self._points is None:
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            return np.asarray(cv2.warpPerspective(averages, homography, (width, height), flags=flags, borderMode=border))
        x, y = transform_points(homography, self._points.reshape(2, -1).T).T.reshape(2, height, width).astype(np.float32)
        return np.asarray(cv2.remap(averages, x, y, cv2.INTER_LINEAR, borderMode=border))


@compiled
def _look_around(  # noqa: PLR0917
    points: FloatArray,
    rays: FloatArray,
    width: int,
    height: int,
    offset: float,
    columns: NDArray[np.float32],
    rows: NDArray[np.float32],
) -> None:
    """Write where `points` (2, H, W), pixels that `rays` (3, 3) maps to directions, lie in a panorama of 360 degrees.

    `columns` and `rows` (H, W) are the outputs, less `offset`: columns from 0 to below `width`; the middle row is the horizon.
    """
    per_radian = width / (2 * np.pi)
    for i in range(columns.shape[0]):
        xs, ys, column_of, row_of = points[0, i], points[1, i], columns[i], rows[i]
        for j in range(len(xs)):
            x, y = xs[j], ys[j]
            right = rays[0, 0] * x + rays[0, 1] * y + rays[0, 2]
            down = rays[1, 0] * x + rays[1, 1] * y + rays[1, 2]
            ahead = rays[2, 0] * x + rays[2, 1] * y + rays[2, 2]
            azimuth, pitch = _angle(right, ahead), _angle(down, np.sqrt(right * right + ahead * ahead))
            column = per_radian * azimuth + (width - 1) / 2 - offset
            column_of[j] = column if column >= 0 else column + width
            row_of[j] = min(max(per_radian * pitch + (height - 1) / 2 - offset, 0.0), height - 1.0)


@compiled
def _angle(y: float, x: float) -> float:
    """Return the arc tangent of y / x, from -pi to pi, within 2e-9: a Chebyshev fit, which is vectorised."""
    up, along = abs(y), abs(x)
    ratio = min(up, along) / max(up, along, 1e-300)
    s = ratio * ratio
    angle = 0.05746355779882009 + s * (-0.030717508855215514 + s * (0.010680719419709784 - s * 0.0017437011378649602))
    angle = -0.14261573680082928 + s * (0.1094019896411271 + s * (-0.08372063945103504 + s * angle))
    angle = ratio * (0.9999999975460201 + s * (-0.33333282295510946 + s * (0.19998230640355844 + s * angle)))
    angle = np.pi / 2 - angle if up > along else angle
    angle = np.pi - angle if x < 0 else angle
    return -angle if y < 0 else angle


class DrawnObject:
    """A rectangle or a disc with texture, drawn over frames.

    `flux`, in photons per pixel per frame, is that of the texture where `config.flux` is 1; `scene_motion` (T, 2) is how far
    the scene has moved through the frame since the first frame, in px.
    """

    def __init__(self, config: FrameObject, frame_shape: tuple[int, int], flux: float, scene_motion: FloatArray) -> None:
        height, width = frame_shape
        self._size = np.array(config.size) * (width, height)
        self._is_disc = config.shape == "disc"
        last = len(scene_motion) if config.frames is None else config.first + config.frames
        self._frames = range(config.first, last)
        begin = min(config.first, len(scene_motion) - 1)
        elapsed = np.arange(len(scene_motion))[:, None] - config.first
        middle = np.array(config.at) * (width, height) - 0.5
        centres = middle + elapsed * config.moves_px + config.follows * (scene_motion - scene_motion[begin])
        self._corners = centres - self._size / 2
        self._texture = texture_of(self._size, config.seed) * np.float32(flux * config.flux)

    def draw(self, view: NDArray[np.float32], frame: int) -> None:
        """Replace the flux of the pixels, or of the parts of pixels, that it covers in a frame; `view` is (H, W)."""
        if frame not in self._frames:
            return
        left, top = self._corners[frame]
        height, width = view.shape
        there = np.array([[1, 0, left + 0.5], [0, 1, top + 0.5]])
        seen = cv2.warpAffine(self._texture, there, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        view += self.covered(view.shape, frame).astype(np.float32) * (seen - view)

    def covered(self, shape: tuple[int, ...], frame: int) -> FloatArray:
        """Return the share of each pixel that it covers in a frame: (H, W)."""
        if frame not in self._frames:
            return np.zeros(shape)
        left, top = self._corners[frame]
        if self._is_disc:  # its edge is a ramp of one pixel
            y, x = np.ogrid[: shape[0], : shape[1]]
            from_middle = np.hypot(x - (left + self._size[0] / 2), y - (top + self._size[1] / 2))
            return np.asarray(np.clip(self._size.min() / 2 - from_middle + 0.5, 0, 1))
        return np.outer(_covered(top, self._size[1], shape[0]), _covered(left, self._size[0], shape[1]))


def _covered(start: float, length: float, n_pixels: int) -> FloatArray:
    """Return the share of each pixel along an axis that lies between `start` and `start + length`."""
    pixels = np.arange(n_pixels)
    return np.asarray(np.clip(np.minimum(pixels + 0.5, start + length) - np.maximum(pixels - 0.5, start), 0, 1))


def texture_of(size: FloatArray, seed: int) -> NDArray[np.float32]:
    """Return an image of mean 1 with detail from fine to coarse; `size` is (width, height) in px."""
    width, height = np.maximum(1, np.ceil(size)).astype(int)
    noise = generator(seed, Draw.TEXTURE).standard_normal((height, width), np.float32)
    layers = [sigma * cv2.GaussianBlur(noise, (0, 0), sigma) for sigma in _DETAIL_PX]
    texture = np.exp(np.sum(layers, axis=0))
    return np.asarray(texture / texture.mean(), dtype=np.float32)
