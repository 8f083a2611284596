"""Rectangles and discs in front of the scene, which move by themselves or stand still in the frame."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano import FloatArray
from photonpano_simulator.config import FrameObject
from photonpano_simulator.sensor import Draw, generator

_DETAIL_PX = (1.5, 5.0, 15.0)  # standard deviations of the Gaussian kernels that make a texture of white noise


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
        columns = _covered(left, self._size[0], width)
        rows = _covered(top, self._size[1], height)
        there = np.array([[1, 0, left + 0.5], [0, 1, top + 0.5]])
        seen = cv2.warpAffine(self._texture, there, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        covered = _disc(left, top, self._size, view.shape) if self._is_disc else np.outer(rows, columns)
        view += covered.astype(np.float32) * (seen - view)


def _covered(start: float, length: float, n_pixels: int) -> FloatArray:
    """Return the share of each pixel along an axis that lies between `start` and `start + length`."""
    pixels = np.arange(n_pixels)
    return np.asarray(np.clip(np.minimum(pixels + 0.5, start + length) - np.maximum(pixels - 0.5, start), 0, 1))


def _disc(left: float, top: float, size: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Return the share of each pixel, (H, W), that the largest disc in a rectangle covers: its edge is a ramp of one pixel."""
    y, x = np.ogrid[: shape[0], : shape[1]]
    from_middle = np.hypot(x - (left + size[0] / 2), y - (top + size[1] / 2))
    return np.asarray(np.clip(size.min() / 2 - from_middle + 0.5, 0, 1))


def texture_of(size: FloatArray, seed: int) -> NDArray[np.float32]:
    """Return an image of mean 1 with detail from fine to coarse; `size` is (width, height) in px."""
    width, height = np.maximum(1, np.ceil(size)).astype(int)
    noise = generator(seed, Draw.TEXTURE).standard_normal((height, width), np.float32)
    layers = [sigma * cv2.GaussianBlur(noise, (0, 0), sigma) for sigma in _DETAIL_PX]
    texture = np.exp(np.sum(layers, axis=0))
    return np.asarray(texture / texture.mean(), dtype=np.float32)
