"""Scenes, what a binary camera sees of them, and captures and motions in memory: inputs of the components under test."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photonpano.contracts.protocols import Closing, Trajectory
from photonpano.geometry import rotation_vectors, transform_points, translation
from photonpano.photometry import BinaryResponse
from photonpano.values import BoolArray, Counts, FloatArray, FrameSpan, Group, Homography, StreamInfo, VirtualExposure

_WAVES = 64
_PERIODS_PX = (6.0, 120.0)
_CONTRAST = 2.5  # slope of the sigmoid that maps the sum of waves to flux, which gives blobs and edges
_DETAIL_PX = (1, 2, 4, 8)  # standard deviations of the Gaussian kernels that make a texture of white noise
Number = TypeVar("Number", bound=np.generic)


class Scene:
    """A plane with a random texture that does not repeat, with details of 3 to 60 px.

    It is a sum of waves, not an image: nothing is interpolated, and a pixel samples a point.

    Convention:
        Points of the plane are (x, y) in px; flux is photons per pixel per frame.
    """

    def __init__(self, seed: int = 0, flux: tuple[float, float] = (0.1, 1.2)) -> None:
        """Draw a scene.

        Args:
            seed: seed of the texture.
            flux: lowest and highest flux.
        """
        rng = np.random.default_rng(seed)
        periods_px = np.geomspace(*_PERIODS_PX, _WAVES)
        directions = rng.uniform(0, np.pi, _WAVES)
        self._waves = 2 * np.pi / periods_px * np.stack([np.cos(directions), np.sin(directions)])
        self._phases = rng.uniform(0, 2 * np.pi, _WAVES)
        self._amplitudes = np.sqrt(periods_px) / np.sqrt(periods_px.sum() / 2)
        self._low, self._high = flux

    def flux(self, points: ArrayLike) -> FloatArray:
        """Return the flux at points of the plane: (N, 2) to (N,)."""
        return self._of(np.sin(np.asarray(points) @ self._waves + self._phases) @ self._amplitudes)

    def view(self, homography: Homography, shape: tuple[int, int]) -> FloatArray:
        """Return the view of a camera: (H, W) flux, where the homography maps pixels to points of the plane."""
        if homography[2, :2].any():
            return self.flux(transform_points(homography, np.indices(shape)[::-1].reshape(2, -1).T)).reshape(shape)
        # Along an affine map, each wave is the product of one of x and one of y.
        *steps, phases = (homography[:2] / homography[2, 2]).T @ self._waves
        x, y = (np.exp(1j * np.outer(np.arange(n), step)) for n, step in zip(shape[::-1], steps, strict=True))
        return self._of((self._amplitudes * np.exp(1j * (phases + self._phases)) * y @ x.T).imag)

    def _of(self, waves: FloatArray) -> FloatArray:
        return np.asarray(self._low + (self._high - self._low) / (1 + np.exp(-_CONTRAST * waves)))


def textured(shape: tuple[int, int], flux: float = 0.5, contrast: float = 0.8, seed: int = 0) -> FloatArray:
    """Return an image of flux, (H, W), with details of 2 to 20 px: its mean, and the standard deviation of its logarithm."""
    import cv2

    rng = np.random.default_rng(seed)
    noise = np.sum([size * cv2.GaussianBlur(rng.normal(0, 1, shape), (0, 0), size) for size in _DETAIL_PX], axis=0)
    scene = np.exp(contrast * noise / noise.std())
    return np.asarray(scene * (flux / scene.mean()))


def seen_along(scene: ArrayLike, homographies: ArrayLike, shape: tuple[int, int]) -> FloatArray:
    """Return what frames of (height, width) see of an image of flux, (Hs, Ws), mirrored at its border: (T, H, W) flux.

    The homographies, (T, 3, 3), map pixels of a frame to pixels of the scene, which is interpolated linearly.
    """
    import cv2

    scene, size = np.asarray(scene), shape[::-1]
    flags, border = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, cv2.BORDER_REFLECT
    maps = np.asarray(homographies, np.float64).reshape(-1, 3, 3)
    return np.stack([cv2.warpPerspective(scene, there, size, flags=flags, borderMode=border) for there in maps])


def detected(flux: ArrayLike, seed: int | np.random.Generator = 0) -> BoolArray:
    """Draw the frames of a binary camera (paper, equation 2): 1 with the probability 1 - exp(-flux), of the shape of `flux`."""
    flux = np.asarray(flux)
    return np.asarray(np.random.default_rng(seed).random(flux.shape, np.float32) < -np.expm1(-flux), np.bool_)


class MemorySource(Closing):
    """Binary frames held in memory: a `photonpano.Source`."""

    def __init__(self, frames: ArrayLike, valid: BoolArray | None = None) -> None:
        """Take (n, H, W) frames of zeros and ones, and the (H, W) mask of usable pixels, by default all."""
        self._frames = np.asarray(frames, dtype=np.uint8)
        n_frames, height, width = self._frames.shape
        self.info = StreamInfo(n_frames, height, width, frame_rate_hz=None)
        self.response = BinaryResponse()
        self.valid = np.ones((height, width), np.bool_) if valid is None else valid

    def counts(self, span: FrameSpan) -> Counts:
        """Sum the frames of a span: (H, W) uint32."""
        self.info.require(span)
        return np.asarray(self._frames[span.start : span.stop].sum(axis=0, dtype=np.uint32))

    def frames(self, span: FrameSpan) -> NDArray[np.uint8]:
        """Return the frames of a span: (n, H, W) of zeros and ones."""
        self.info.require(span)
        return self._frames[span.start : span.stop].copy()


class ReadOnlySource(MemorySource):
    """A `MemorySource` whose arrays are read-only."""

    def __init__(self, frames: ArrayLike, valid: BoolArray | None = None) -> None:
        super().__init__(frames, valid)
        self.valid = read_only(self.valid)

    def counts(self, span: FrameSpan) -> Counts:
        """Sum the frames of a span: (H, W) uint32."""
        return read_only(super().counts(span))

    def frames(self, span: FrameSpan) -> NDArray[np.uint8]:
        """Return the frames of a span: (n, H, W) of zeros and ones."""
        return read_only(super().frames(span))


class KnownMotion:
    """A `photonpano.Trajectory` defined by a function of one instant."""

    def __init__(self, at: Callable[[float], Homography]) -> None:
        self._at = at

    def at(self, frame_indices: ArrayLike) -> FloatArray:
        """Return the homographies of N instants: (N, 3, 3)."""
        return np.array([self._at(frame) for frame in np.atleast_1d(frame_indices)]).reshape(-1, 3, 3)


def rolled(degrees: float, shape: tuple[int, int]) -> Homography:
    """Return a roll about the centre of an image of (height, width)."""
    angle = np.deg2rad(degrees)
    cos, sin = np.cos(angle), np.sin(angle)
    centre = translation((shape[1] - 1) / 2, (shape[0] - 1) / 2)
    return np.asarray(centre @ np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ np.linalg.inv(centre))


def read_only(array: NDArray[Number]) -> NDArray[Number]:
    """Return a read-only copy."""
    array = array.copy()
    array.flags.writeable = False
    return array


def recorded(scene: Scene, motion: Trajectory, n_frames: int, shape: tuple[int, int], seed: int = 0) -> NDArray[np.uint8]:
    """Simulate frames of a scene from a binary camera (paper, equation 2): (n_frames, H, W) of zeros and ones.

    The shape is (height, width) of a frame. The motion maps pixels of a frame to points of the scene; `seed` is that of the
    photon noise.
    """
    rng = np.random.default_rng(seed)
    frames = np.empty((n_frames, *shape), np.uint8)
    for frame, homography in zip(frames, motion.at(np.arange(n_frames)), strict=True):
        frame[:] = rng.random(shape) < -np.expm1(-scene.view(homography, shape))
    return frames


def photographed(flux: FloatArray, n_frames: int = 1000, seed: int = 0, unseen: BoolArray | None = None) -> VirtualExposure:
    """Simulate a virtual exposure of a still camera, with the photon noise of `n_frames` binary frames.

    Flux is (H, W), photons per pixel per frame; `unseen`, (H, W), is true for pixels without any observation.
    """
    response = BinaryResponse()
    counts = np.random.default_rng(seed).binomial(n_frames, -np.expm1(-flux))
    weight = np.full(flux.shape, n_frames, np.float32)
    estimate = response.flux((counts / n_frames).astype(np.float32), weight)
    if unseen is not None:
        estimate[unseen], weight[unseen] = np.nan, 0
    span = FrameSpan(0, n_frames)
    return VirtualExposure(estimate, weight, Group(span, span.centre), 1.0, response)


def measured_rates(
    rotations: ArrayLike,
    frame_rate_hz: float,
    *,
    bias_deg_s: ArrayLike = (0.0, 0.0, 0.0),
    offset_s: float = 0.0,
    noise_deg_s_sqrt_hz: float = 0.01,
    seed: int = 0,
) -> str:
    """Simulate a gyroscope on a camera, at 1,000 Hz, from 0.1 s before the first frame to 0.1 s after the last.

    Args:
        rotations: (T, 3, 3), from the camera at each frame to any other one, such as `rotations` of a simulated truth.
        frame_rate_hz: of the frames.
        bias_deg_s: constant error about x (to the right), y (down) and z (ahead).
        offset_s: time of the gyroscope at the first frame.
        noise_deg_s_sqrt_hz: density of its white noise.
        seed: of the noise.

    Returns:
        The content of a CSV file for `motion.prior.imu`.
    """
    rotations = np.asarray(rotations)
    between = rotation_vectors(np.swapaxes(rotations[:-1], -1, -2) @ rotations[1:]) * frame_rate_hz
    times_s = np.arange(-0.1, len(rotations) / frame_rate_hz + 0.1, 1e-3)
    middles_s = (np.arange(len(between)) + 0.5) / frame_rate_hz
    rates = np.stack([np.interp(times_s, middles_s, each) for each in between.T], axis=1)
    noise = noise_deg_s_sqrt_hz * np.sqrt(500) * np.random.default_rng(seed).normal(size=rates.shape)
    rows = np.column_stack([times_s + offset_s, np.rad2deg(rates) + noise + np.asarray(bias_deg_s)])
    lines = [",".join(f"{number:.9g}" for number in row) for row in rows]
    return "\n".join(["t_s,wx_deg_s,wy_deg_s,wz_deg_s", *lines, ""])
