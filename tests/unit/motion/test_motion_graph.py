"""The motion graph: its solution with outliers and in several parts, and its normal equations."""

import numpy as np
import pytest
from scipy import sparse

from photonpano import Located, NotLocated
from photonpano.geometry import (
    corner_displacements,
    from_parameters,
    inverse,
    normalised,
)
from photonpano.motion import adjustment
from photonpano.motion.graph import _Tied, components, solve
from photonpano.values import Edge

from .measured_graphs import (
    SHAPE,
    apart,
    edge,
    error_px,
    graph,
    groups_of,
    measured,
    moved,
    true_motion,
)

pytestmark = pytest.mark.usefixtures("one_thread")


def test_solve_error_falls_with_more_edges_than_a_chain() -> None:
    """Errors of 0.1 px a pair: over 120 exposures a chain drifts by 0.7 px; second and fourth neighbours leave 0.14 px."""
    errors: dict[tuple[int, ...], list[float]] = {(1,): [], (1, 2, 4): [], (1, 2, 4, 40): []}
    for seed in range(2):
        true, rng = true_motion(120, seed), np.random.default_rng(seed)
        for skips, found in errors.items():
            found.append(error_px(solve(groups_of(120), apart(true, skips, rng), 60, SHAPE).homographies, true, 60))
    chain, neighbours, closures = (float(np.mean(found)) for found in errors.values())
    assert chain > 0.5
    assert neighbours < 0.35 * chain
    assert closures < 0.15 * chain


def test_solve_drops_one_gross_outlier_at_any_edge() -> None:
    true, edges = graph(9)
    clean = error_px(solve(groups_of(9), edges, 4, SHAPE).homographies, true, 4)
    for index, each in enumerate(edges):
        solution = solve(groups_of(9), [*edges[:index], moved(each, 40, -30), *edges[index + 1 :]], 4, SHAPE)
        assert solution.outliers == (index,)
        assert error_px(solution.homographies, true, 4) < 1.5 * clean


@pytest.mark.parametrize(("skips", "n"), [((1, 2, 8), 300), ((2, 3, 8), 400)], ids=["disjoint", "half overlapping"])
def test_solve_of_a_long_capture_does_not_depend_on_its_start(skips: tuple[int, ...], n: int) -> None:
    """Errors of 8 px a pair, as of blurred exposures: along skips of 8, paths to neighbours drift apart by far more."""
    true = true_motion(n)
    edges = apart(true, skips, np.random.default_rng(0), 8.0)
    found, expected = (solve(groups_of(n), edges, n // 2, SHAPE, start) for start in (None, true))
    assert found.residual_px == pytest.approx(expected.residual_px, rel=0.01)
    neighbours = inverse(found.homographies[:-1]) @ found.homographies[1:]
    assert corner_displacements(neighbours, inverse(true[:-1]) @ true[1:], SHAPE).mean() < 8


def test_components_are_numbered_from_the_largest() -> None:
    true = true_motion(7)
    edges = [edge(true, 1, 0), Edge(2, 1, NotLocated("lost")), edge(true, 3, 2), edge(true, 4, 3), edge(true, 6, 4)]
    assert [len(np.flatnonzero(components(7, edges) == part)) for part in (0, 1, 2)] == [4, 2, 1]
    np.testing.assert_array_equal(components(7, edges) == 0, [False, False, True, True, True, False, True])
    assert sorted(components(3, [])) == [0, 1, 2]


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
    for seed in range(15):
        n_nodes, edges = any_edges(seed)
        solution = solve(groups_of(n_nodes), edges, 0, SHAPE)
        assessed = solution.assess()
        for each in (solution.homographies[solution.located], assessed.information, assessed.std_px):
            assert np.isfinite(each).all(), f"seed {seed}"


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


def test_start_of_the_graph_follows_exact_edges_in_both_directions() -> None:
    """Edges lead from each exposure to an earlier one, and the anchor is in the middle."""
    true, anchor = true_motion(9), 4
    tied = _Tied.of(groups_of(len(true)), measured(true, (1,)), anchor, SHAPE)
    start = normalised(tied.composed(tied.problem.observed))
    assert error_px(start, true, anchor) < 1e-6
