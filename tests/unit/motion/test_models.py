"""Models of the motion: groups of homographies, and which of them pairs support."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from photonpano.geometry import align_planes, corner_displacements, inverse, normalised
from photonpano.motion.planar import PLANAR_NAMES, PlanarName, basis_of, moved, nearest
from photonpano.values import Edge

from .measured_graphs import SHAPE, edge

pytestmark = pytest.mark.usefixtures("one_thread")

# Standard deviation of the small motions between exposures: shifts by tenths of a frame, others by hundredths of it.
STEP = np.array([0.02, 0.02, 0.02, 0.02, 0.1, 0.05, 0.01, 0.01])
N_NODES = 24


def path(model: PlanarName, seed: int = 0) -> np.ndarray:
    """A camera that wanders within a model: (24, 3, 3)."""
    basis, rng = basis_of(model), np.random.default_rng(seed)
    found = [np.eye(3)]
    for _ in range(N_NODES - 1):
        steps = rng.normal(size=(1, basis.shape[1])) * (STEP @ (basis != 0) / (basis != 0).sum(axis=0))
        found.append(moved(found[-1][None], steps, basis, SHAPE)[0])
    return np.array(found)


def measured(true: np.ndarray, seed: int, std_px: float = 0.3) -> list[Edge]:
    """Pairs of neighbours at three distances, each with the errors of all eight parameters."""
    rng = np.random.default_rng(seed)
    return [edge(true, i, j, rng, std_px) for i in range(len(true)) for j in (i - 1, i - 2, i - 4) if j >= 0]


def error_px(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Corner errors after the best alignment of the planes: (N,)."""
    plane = align_planes(found, true, SHAPE)
    return corner_displacements(inverse(true) @ plane @ found, np.eye(3), SHAPE).mean(axis=-1)


@given(model=st.sampled_from(PLANAR_NAMES), steps=st.lists(st.floats(-0.5, 0.5), min_size=16, max_size=16))
def test_motions_of_a_model_stay_within_it(model: PlanarName, steps: list[float]) -> None:
    basis = basis_of(model)
    first, second = np.array(steps).reshape(2, 1, 8)[:, :, : basis.shape[1]] * (1 if model != "homography" else 0.3)
    once = moved(np.eye(3)[None], first, basis, SHAPE)
    for element in (once, moved(once, second, basis, SHAPE), normalised(inverse(once))):
        np.testing.assert_allclose(corner_displacements(nearest(model, element, SHAPE), element, SHAPE), 0, atol=1e-6)


def test_steps_that_follow_each_other_add_up() -> None:
    basis = basis_of("euclidean")
    step = np.array([[0.1, -0.05, 0.3]])
    np.testing.assert_allclose(moved(moved(np.eye(3)[None], step, basis, SHAPE), -step, basis, SHAPE)[0], np.eye(3), atol=1e-12)
