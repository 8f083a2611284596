from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from photonpano import FrameSpan, Group, VirtualExposure
from photonpano.geometry import translation
from photonpano.photometry import BinaryResponse
from photonpano_simulator.config import StreetScene
from photonpano_simulator.scenes import scene_flux

if TYPE_CHECKING:
    from collections.abc import Callable

SHAPE = (160, 240)
FRAMES = 250
RESPONSE = BinaryResponse()


@pytest.fixture(scope="session")
def street() -> np.ndarray:
    """(682, 1024) of flux, 0.5 photons per pixel and frame on average."""
    return scene_flux(StreetScene(width=1024, height=682), 0.5)


@pytest.fixture(scope="session")
def photograph() -> Callable[..., VirtualExposure]:
    """Take a virtual exposure of (160, 240) px from an image of flux: 250 frames, without motion, with photon noise."""

    def photograph(flux: np.ndarray, seed: int = 0) -> VirtualExposure:
        counts = np.random.default_rng(seed).binomial(FRAMES, -np.expm1(-flux.astype(float)))
        weight = np.full(flux.shape, FRAMES, np.float32)
        estimate = RESPONSE.flux((counts / FRAMES).astype(np.float32), weight)
        return VirtualExposure(estimate, weight, Group(FrameSpan(0, FRAMES), 0), 1.0, RESPONSE)

    return photograph


@pytest.fixture(scope="session")
def seen_from(street: np.ndarray, photograph: Callable) -> Callable[..., VirtualExposure]:
    """Take an exposure of the street: `motion` maps its pixels to those of the exposure that the identity gives."""

    def seen_from(motion: np.ndarray, seed: int = 0, brightness: float = 1.0) -> VirtualExposure:
        to_street = translation(400, 280) @ motion
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return photograph(cv2.warpPerspective(street, to_street, SHAPE[::-1], flags=flags) * brightness, seed)

    return seen_from
