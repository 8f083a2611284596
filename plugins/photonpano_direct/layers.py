"""A level of an image pyramid, with its derivatives."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Layer(NamedTuple):
    """A level of an image pyramid.

    Attributes:
        image: (H, W) float32, variance-stabilised and blurred.
        weight: (H, W) float32, inverse noise variance of a pixel before the blur; 0 at masked pixels.
        blur_px: standard deviation of the Gaussian that reduces white noise as much as the blur and the halving did, in px of
            the layer.
        gradients: (2, H, W) float32, derivatives of the image along x and y.
        smoothed: (2, H, W) float32, the gradients, blurred by the same Gaussian once more.
    """

    image: NDArray[np.float32]
    weight: NDArray[np.float32]
    blur_px: float
    gradients: NDArray[np.float32]
    smoothed: NDArray[np.float32]
