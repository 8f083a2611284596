from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from photonpano import VirtualExposure
from photonpano.geometry import translation


@pytest.fixture(scope="session")
def shot(street: np.ndarray, photograph: Callable) -> Callable[..., VirtualExposure]:
    """Take an exposure of (120, 176) px, smaller than `seen_from` does: `motion` maps its pixels to those of the identity."""

    def shot(motion: np.ndarray, seed: int = 0, brightness: float = 1.0) -> VirtualExposure:
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        flux = cv2.warpPerspective(street, translation(430, 300) @ motion, (176, 120), flags=flags)
        return photograph(flux * brightness, seed)

    return shot
