"""Files as cameras write them, and curves of homographies."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import photonpano_baselines
from photonpano import StageContext, StreamInfo, Trajectory
from photonpano.geometry import from_parameters, normalised

FRAME_SHAPE = (254, 496)
FOCAL_PX = 1500.0


def swissspad_half(frames: np.ndarray) -> bytes:
    return np.packbits(frames, axis=-1, bitorder="little").tobytes()


def swissspad_full(frames: np.ndarray) -> bytes:
    """Write the top half and the bottom half upside down, 128 columns of each in turn."""
    zones = []
    for left in range(0, 512, 128):
        zones += [frames[:, :256, left : left + 128], frames[:, :255:-1, left : left + 128]]
    return np.packbits(np.concatenate(zones, axis=2), axis=-1, bitorder="little").tobytes()


def spad512(frames: np.ndarray) -> bytes:
    return np.packbits(frames, axis=-1).tobytes() + b"foot"


def spad512_sparse(frames: np.ndarray) -> bytes:
    return b"".join(np.append(np.flatnonzero(frame), 512 * 512).astype("<u4").tobytes() for frame in frames)


WRITERS = {
    "swissspad-half": swissspad_half,
    "swissspad-full": swissspad_full,
    "spad512": spad512,
    "spad512-sparse": spad512_sparse,
}


@pytest.fixture(scope="session")
def bin_file() -> Callable[[str, np.ndarray], bytes]:
    """Make the content of a .bin file of a source from frames (n, H, W)."""
    return lambda source, frames: WRITERS[source](frames)


@pytest.fixture
def moving() -> Callable[..., np.ndarray]:
    """Return frames, (n, 48, 66) uint8, of a pattern that moves by a pixel a frame, so that each differs from all others."""

    def make(n_frames: int = 40) -> np.ndarray:
        rows = np.linspace(40, 200, 48)[:, None]
        wave = 25 * np.sin(np.arange(66 + n_frames) / 3)
        return np.stack([rows + wave[first : first + 66] for first in range(n_frames)]).astype(np.uint8)

    return make


@pytest.fixture(scope="session")
def fit() -> Callable[..., Trajectory]:
    """Fit by name: `fit("lie", instants, homographies, information=None, **config)`."""
    catalog = photonpano_baselines.catalog()
    context = StageContext(StreamInfo(1000, *FRAME_SHAPE, None), response=None)

    def fit(name: str, instants: Any, homographies: np.ndarray, information: np.ndarray | None = None, **config: float) -> Any:
        contribution = catalog.find("interpolator", name).contribution
        interpolator = contribution.build(contribution.config(**config), context)
        return interpolator.fit(np.asarray(instants, dtype=float), homographies, information)

    return fit


@pytest.fixture(scope="session")
def turning() -> Callable[[np.ndarray], np.ndarray]:
    """Return the homographies of a phone camera rotated by (T, 3) rotation vectors, in radians."""
    height, width = FRAME_SHAPE
    lens = np.array([[FOCAL_PX, 0, (width - 1) / 2], [0, FOCAL_PX, (height - 1) / 2], [0, 0, 1]])

    def turning(vectors: np.ndarray) -> np.ndarray:
        return normalised(lens @ Rotation.from_rotvec(vectors).as_matrix() @ np.linalg.inv(lens))

    return turning


@pytest.fixture(scope="session")
def motions() -> Callable[[int, int], np.ndarray]:
    """Return (N, 3, 3) random homographies, of more than rotating cameras: `motions(n, seed)`."""

    def motions(n: int, seed: int) -> np.ndarray:
        sizes = np.array([1e-2, 1e-2, 1e-2, 1e-2, 30, 30, 1e-5, 1e-5])
        return from_parameters(np.random.default_rng(seed).normal(size=(n, 8)) * sizes)

    return motions
