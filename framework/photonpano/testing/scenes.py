"""Scenes and what a binary camera sees of them: exact views, textures, pans, and photon noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from photonpano.geometry import transform_points
from photonpano.values import BoolArray, FloatArray, Homography

_WAVES = 64
_PERIODS_PX = (6.0, 120.0)
_CONTRAST = 2.5  # slope of the sigmoid that maps the sum of waves to flux, which gives blobs and edges
_DETAIL_PX = (1, 2, 4, 8)  # standard deviations of the Gaussian kernels that make a texture of white noise


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
        """Return the view of a camera: (H, W) flux.

        Args:
            homography: (3, 3), pixels of the image to points of the plane.
            shape: (height, width) of the image.
        """
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
    """Return what frames see of an image of flux.

    Args:
        scene: (Hs, Ws) flux; it is mirrored at its border, and interpolated linearly.
        homographies: (T, 3, 3), pixels of a frame to pixels of the scene.
        shape: (height, width) of a frame.

    Returns:
        (T, H, W) flux.
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


def z_scores(counts: ArrayLike, n_frames: int, flux: ArrayLike) -> FloatArray:
    """Return the deviations of counts of a binary camera from a flux, in standard deviations of photon noise."""
    chance = -np.expm1(-np.asarray(flux, np.float64))
    return np.asarray((np.asarray(counts) - n_frames * chance) / np.sqrt(n_frames * chance * (1 - chance)))
