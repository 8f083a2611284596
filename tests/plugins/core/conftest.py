from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from photonpano import StageContext, StreamInfo, Trajectory, discover
from photonpano.geometry import from_parameters, normalised

FRAME_SHAPE = (254, 496)
FOCAL_PX = 1500.0


@pytest.fixture(autouse=True, scope="session")
def one_thread() -> Iterator[None]:
    """Keep BLAS from starting threads for small matrices, as a run does."""
    with threadpool_limits(1):
        yield


@pytest.fixture(scope="session")
def fit() -> Callable[..., Trajectory]:
    """Fit by name: `fit("lie", instants, homographies, information=None, **config)`."""
    catalog = discover()
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
