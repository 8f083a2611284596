"""Walks of homographies beyond shift and roll: their widths are learnt from the pairs."""

import numpy as np
import pytest

from photonpano.geometry import align_planes, corner_displacements, inverse, normalised
from photonpano.motion.graph import solve
from photonpano.motion.model import MotionModel
from photonpano.motion.planar import basis_of, logarithms, moved

from .measured_graphs import SHAPE, groups_of, measured, noise_of

N_NODES = 24


def path(zoom: float) -> np.ndarray:
    """A pan with a roll, and a zoom that goes out and back again: (24, 3, 3)."""
    steps = np.zeros((N_NODES, 4))
    steps[:, 0], steps[:, 2] = 0.1, 0.003
    steps[:, 3] = zoom * np.where(np.arange(N_NODES) < N_NODES // 2, -1, 1) / N_NODES
    found = [np.eye(3)]
    for step in steps[1:]:
        found.append(moved(found[-1][None], step[None], basis_of("similarity"), SHAPE)[0])
    return np.array(found)


@pytest.mark.parametrize(("zoom", "told", "most"), [(0.0, "euclidean", 1.35), (0.8, "similarity", 1.35)])
def test_learnt_walks_are_as_accurate_as_the_model_that_moved(zoom: float, told: str, most: float) -> None:
    errors: dict[str, list[float]] = {"auto": [], told: []}
    for seed in range(3):
        true, groups = path(zoom), groups_of(N_NODES)
        edges = measured(true, (1, 2, 4), noise_of(groups, np.random.default_rng(seed)))
        for name in errors:
            solution = solve(groups, edges, N_NODES // 2, SHAPE, model=MotionModel(name))
            plane = align_planes(solution.homographies, true, SHAPE)
            apart = corner_displacements(inverse(true) @ plane @ solution.homographies, np.eye(3), SHAPE)
            errors[name].append(float(apart.mean()))
            assert not solution.outliers
        assert ("zoom" in solution.walks_px) == (zoom > 0) or told == "euclidean"
    assert np.mean(errors["auto"]) < most * np.mean(errors[told])


def test_logarithms_undo_exponentials() -> None:
    steps = np.random.default_rng(0).uniform(-0.3, 0.3, (8, 8))
    np.testing.assert_allclose(logarithms(normalised(moved(np.eye(3)[None], steps, np.eye(8), SHAPE)), SHAPE), steps, atol=1e-6)
