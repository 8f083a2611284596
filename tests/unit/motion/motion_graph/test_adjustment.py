"""The normal equations: sparse for large graphs, and damped where they are nearly singular."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import sparse

from photonpano import Located
from photonpano.geometry import from_parameters, inverse, normalised
from photonpano.motion import adjustment
from photonpano.motion.graph import solve
from photonpano.values import Edge

from .measured_graphs import SHAPE, measured, true_motion

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.parametrize(("closures", "most"), [(0, 20), (100, 50)])
def test_solve_of_a_large_graph_takes_few_steps_with_sparse_factors(
    monkeypatch: pytest.MonkeyPatch, closures: int, most: int
) -> None:
    """The factors of the normal equations stay sparse: at most `most` blocks for each exposure."""
    filled: list[int] = []
    factorise = adjustment.splu

    def counting(matrix: Any, **options: Any) -> Any:
        factors = factorise(matrix, **options)
        filled.append(factors.L.nnz + factors.U.nnz)
        return factors

    monkeypatch.setattr(adjustment, "splu", counting)
    true, rng = true_motion(300), np.random.default_rng(0)
    edges = measured(true, (1, 2, 4), rng)
    ends = np.sort(rng.choice(300, (closures, 2)))
    edges += [
        Edge(int(late), int(early), Located(normalised(inverse(true[early]) @ true[late])))
        for early, late in ends
        if late - early > 4
    ]
    solve(300, edges, 150, SHAPE)
    assert len(filled) <= 12
    assert max(filled) < 300 * 8**2 * most


def any_edges(seed: int) -> tuple[int, list[Edge]]:
    """Draw a graph of edges that contradict each other, with information from nearly singular to far too certain."""
    rng = np.random.default_rng(seed)
    n_nodes, edges = int(rng.integers(2, 9)), []
    units = np.array([1e-2, 1e-2, 1e-2, 1e-2, 1, 1, 1e-4, 1e-4])
    for moving in range(1, n_nodes):
        for fixed in {moving - 1, int(rng.integers(0, moving))}:
            change = rng.normal(size=8) * units * [5, 5, 5, 5, 40, 40, 1, 1] * 10.0 ** rng.uniform(-3, 0)
            rotation, _ = np.linalg.qr(rng.normal(size=(8, 8)))
            span = float(rng.choice([0, 4, 7]))
            information = (rotation * 10.0 ** rng.uniform(-span, span, 8)) @ rotation.T / np.outer(units, units)
            residual_px = float(10.0 ** rng.uniform(-12, 12)) if rng.random() < 0.5 else None
            given = None if rng.random() < 0.3 else (information + information.T) / 2
            edges.append(Edge(moving, fixed, Located(from_parameters(change), given, residual_px)))
    return n_nodes, edges


def test_solve_is_finite_for_any_information() -> None:
    """Nearly singular systems are damped: nothing raises, and what is not determined is uncertain."""
    for seed in range(25):
        n_nodes, edges = any_edges(seed)
        solution = solve(n_nodes, edges, 0, SHAPE)
        assessed = solution.assess()
        information, std_px = assessed.information, assessed.std_px
        finite = [bool(np.isfinite(each).all()) for each in (solution.homographies[solution.located], information, std_px)]
        assert finite == [True] * 3, f"seed {seed}"


def test_singular_system_leaves_undetermined_unknowns_and_calls_them_uncertain() -> None:
    """Of four unknowns, the last two are only known to be equal."""
    jacobian = np.array([[2.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -1]])
    normal = sparse.csr_array(jacobian.T @ jacobian)
    right = np.array([8.0, 3.0, 1.0, -1.0])
    np.testing.assert_allclose(adjustment._solved(normal, right)[:2], [2, 3], rtol=1e-6)
    draws = np.random.default_rng(0).normal(size=(3, 500))
    std = adjustment._solved(normal, jacobian.T @ draws, draws=True).std(axis=1)
    np.testing.assert_allclose(std[:2], [0.5, 1], rtol=0.15)
    assert (std[2:] > 1e3).all()
