"""A scene whose flux is defined at every point, so that every view of it is exact."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from photonpano.geometry import apply
from photonpano.values import FloatArray, Homography

_WAVES = 64
_PERIODS_PX = (6.0, 120.0)
# Slope of the sigmoid that limits the sum of waves to the range of the flux, and gives blobs and edges.
_CONTRAST = 2.5


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
        self._flux = flux

    def flux(self, points: ArrayLike) -> FloatArray:
        """Return the flux at points of the plane: (N, 2) to (N,)."""
        waves = np.sin(np.asarray(points) @ self._waves + self._phases) @ self._amplitudes
        low, high = self._flux
        return np.asarray(low + (high - low) / (1 + np.exp(-_CONTRAST * waves)))

    def view(self, homography: Homography, shape: tuple[int, int]) -> FloatArray:
        """Return the view of a camera: (H, W) flux.

        Args:
            homography: (3, 3), pixels of the image to points of the plane.
            shape: (height, width) of the image.
        """
        y, x = np.mgrid[: shape[0], : shape[1]]
        return self.flux(apply(homography, np.stack([x.ravel(), y.ravel()], axis=1))).reshape(shape)
