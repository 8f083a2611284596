"""One image of a pyramid, with what alignment needs of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Layer(NamedTuple):
    """One level of a pyramid.

    Attributes:
        image: (H, W) float32, variance-stabilised and blurred.
        weight: (H, W) float32, inverse noise variance of a pixel before the blur; 0 where nothing was seen.
        blur_px: standard deviation of the Gaussian that leaves as much of white noise as the blur and the halving did, in px
            of the layer.
        gradients: (2, H, W) float32, the derivatives of the image along x and y.
        smoothed: (2, H, W) float32, the same, blurred once more as the noise was.
    """

    image: NDArray[np.float32]
    weight: NDArray[np.float32]
    blur_px: float
    gradients: NDArray[np.float32]
    smoothed: NDArray[np.float32]
