"""Photon noise of counts."""

from __future__ import annotations

import numpy as np

from photonpano import Response
from photonpano_core.dense_motion.field import Image

_MANY = 1e4
_SHARE = np.float32(0.01)


def count_variance(mean: Image, response: Response) -> Image:
    """Return the variance of the count of one frame, from the slope of the scale on which it is uniform.

    Args:
        mean: expected count of a frame.
        response: the camera's response.
    """
    low, high = mean * (1 - _SHARE), mean * (1 + _SHARE) + np.float32(1e-4)
    low_value, high_value = (response.stabilised(response.flux(each, _MANY), _MANY) for each in (low, high))
    per_unit = (high - low) / np.maximum(high_value - low_value, np.float32(1e-9))
    return np.asarray(_MANY * (response.stabilised_std(_MANY) * per_unit) ** 2, np.float32)
