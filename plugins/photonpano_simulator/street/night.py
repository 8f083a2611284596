"""The street at night: a few lamps, lit windows and signs, and shadows in between."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano.photometry import srgb_to_linear
from photonpano_simulator.street.scene import street

_HEIGHT = 1365.0
"""Height of the street in its own units, as it is painted."""
_LAMP_EVERY = 330.0
"""Distance between lamps, in units."""
_LAMP_TOP = (700.0, 800.0)
"""Heights between which lamps hang, in units from the top."""
_POOL = 100.0
"""Radius within which a lamp lights the street about evenly, in units."""
_BULB = 9.0
"""Radius of the lamp itself, in units."""
_BULB_LIGHT = 1000.0
"""Brightness of a lamp itself, relative to a white wall beside it."""
_WINDOWS = 0.7
"""Lit windows for each lamp."""
_WINDOW = (26.0, 40.0)
"""Width and height of a lit window, in units."""
_WINDOW_LIGHT = 4.0
_SKY = 1e-3
"""Light that comes from everywhere, relative to that beside a lamp."""
_BLUR_PX = 1.0
"""Standard deviation of the blur of the lens, in px: nothing is sharper than a pixel."""


def night(shape: tuple[int, int], seed: int, range_db: float) -> NDArray[np.float32]:
    """Draw a street at night.

    Args:
        shape: (height, width), px.
        seed: another seed is another street.
        range_db: ratio of the brightest and the darkest pixel, in dB: 20 for a factor of ten.

    Returns:
        (height, width) linear intensities, at most 1.
    """
    rng = np.random.default_rng((seed, 1))
    height, width = shape
    unit = height / _HEIGHT
    paint = np.maximum(srgb_to_linear(street(shape, seed)), np.float32(0.02))
    y, x = np.mgrid[:height, :width].astype(np.float32)
    light, glow = np.full(shape, _SKY, np.float32), np.zeros(shape, np.float32)
    n_lamps = max(2, round(width / unit / _LAMP_EVERY))
    for place in range(n_lamps):
        lamp_x = (place + rng.uniform(0.25, 0.75)) * width / n_lamps
        lamp_y, strength = rng.uniform(*_LAMP_TOP) * unit, 10 ** rng.uniform(-0.7, 0)
        distance2 = ((x - lamp_x) ** 2 + (y - lamp_y) ** 2) / (_POOL * unit) ** 2
        light += np.float32(strength) / (1 + distance2) ** 1.5
        glow += np.float32(strength * _BULB_LIGHT) * np.exp(-distance2 * np.float32((_POOL / _BULB) ** 2))
    for _ in range(round(_WINDOWS * n_lamps)):
        left, top = rng.uniform(0, width), rng.uniform(0.25, 0.6) * height
        box = np.s_[int(top) : int(top + _WINDOW[1] * unit) + 1, int(left) : int(left + _WINDOW[0] * unit) + 1]
        light[box] += np.float32(_WINDOW_LIGHT * 10 ** rng.uniform(-1, 0))
    scene = cv2.GaussianBlur(paint * light + glow, (0, 0), _BLUR_PX).astype(np.float32)
    stops = np.log(scene / scene.max())
    return np.asarray(np.exp(stops * (range_db / 20 * np.log(10) / -stops.min())), np.float32)
