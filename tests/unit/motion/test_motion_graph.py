"""The motion graph: its solution with outliers and in several parts, and its normal equations."""

from dataclasses import replace
from typing import Any

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
from photonpano.motion.graph import components, solve
from photonpano.values import Edge

from .measured_graphs import (
    NOISE_PX,
    SHAPE,
    apart,
    confident,
    edge,
    error_px,
    graph,
    groups_of,
    measured,
    moved,
    true_motion,
    without_information,
)

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.parametrize("skips", [(1,), (1, 2, 4), (1, 29)], ids=["chain", "loops", "closed once"])
@pytest.mark.parametrize("anchor", [0, 15, 29])
def test_solve_follows_pairs_that_are_known_exactly(skips: tuple[int, ...], anchor: int) -> None:
    """Pairs of a ten thousandth of a pixel leave the prior nothing to say; the path is 600 px long."""
    true = true_motion(30)
    solution = solve(groups_of(30), confident(measured(true, skips), 1000), anchor, frame_shape=SHAPE)
    assert error_px(solution.homographies, true, anchor) < 1e-6
    np.testing.assert_array_equal(solution.homographies[anchor], np.eye(3))
    np.testing.assert_array_equal(solution.homographies[:, 2, 2], 1)
    assert solution.located.all()
    assert solution.outliers == ()
    assert solution.residual_px < 1e-6


@pytest.mark.parametrize("weighted_by", ["information", "residual_px"])
def test_solve_weights_edges_by_information_or_residual(weighted_by: str) -> None:
    """Every second measurement of a pair is twenty times as noisy."""
    true, rng = true_motion(40), np.random.default_rng(0)
    good = apart(true, (1, 2), rng)
    noisy = [edge(true, each.moving, each.fixed, own=(rng, 20 * NOISE_PX)) for each in good]
    best = error_px(solve(groups_of(40), good, 20, frame_shape=SHAPE).homographies, true, 20)
    edges = good + noisy
    if weighted_by == "residual_px":
        stds = np.repeat([NOISE_PX, 20 * NOISE_PX], len(good))
        edges = [
            Edge(each.moving, each.fixed, replace(each.motion, residual_px=std_px))
            for each, std_px in zip(without_information(edges), stds, strict=True)
        ]
    weighted = error_px(solve(groups_of(40), edges, 20, frame_shape=SHAPE).homographies, true, 20)
    unweighted = error_px(solve(groups_of(40), without_information(good + noisy), 20, frame_shape=SHAPE).homographies, true, 20)
    # Bad pairs count as much as good ones in the number of pairs of an exposure, which their weights are divided by.
    assert weighted < 1.6 * best
    assert unweighted > 3 * weighted


def test_solve_error_falls_with_more_edges_than_a_chain() -> None:
    """Errors of 0.1 px a pair: a chain drifts; second and fourth neighbours leave a third of that."""
    errors: dict[tuple[int, ...], list[float]] = {(1,): [], (1, 2, 4): [], (1, 2, 4, 40): []}
    for seed in range(2):
        true, rng = true_motion(120, seed), np.random.default_rng(seed)
        for skips, found in errors.items():
            found.append(error_px(solve(groups_of(120), apart(true, skips, rng), 60, frame_shape=SHAPE).homographies, true, 60))
    chain, neighbours, closures = (float(np.mean(found)) for found in errors.values())
    assert chain > 0.5
    assert neighbours < 0.35 * chain
    assert closures < 0.15 * chain


def test_solve_drops_one_gross_outlier_at_any_edge() -> None:
    true, edges = graph(9)
    clean = error_px(solve(groups_of(9), edges, 4, frame_shape=SHAPE).homographies, true, 4)
    for index in range(0, len(edges), 4):
        each = edges[index]
        solution = solve(groups_of(9), [*edges[:index], moved(each, 40, -30), *edges[index + 1 :]], 4, frame_shape=SHAPE)
        assert solution.outliers == (index,)
        assert error_px(solution.homographies, true, 4) < 1.5 * clean


@pytest.mark.parametrize("informed", [True, False])
def test_solve_keeps_outliers_if_graph_disconnects_without_them(informed: bool) -> None:
    """The last exposure has two pairs that are 40 px apart, either of which may be right."""
    still = np.broadcast_to(np.eye(3), (21, 3, 3))
    edges = [*measured(still[:20], (1, 2)), moved(edge(still, 20, 19), 20, 0), moved(edge(still, 20, 19), -20, 0)]
    solution = solve(groups_of(21), edges if informed else without_information(edges), 10, frame_shape=SHAPE)
    assert solution.located.all()
    assert solution.outliers == ()
    assert error_px(solution.homographies[:20], still[:20], 10) < 1e-6
    assert solution.residual_px == pytest.approx(20 * np.sqrt(2 / len(edges)), rel=0.05)


def test_expected_error_includes_both_of_two_places_that_pairs_show() -> None:
    still = np.broadcast_to(np.eye(3), (21, 3, 3))
    edges = [*measured(still[:20], (1, 2)), moved(edge(still, 20, 19), 20, 0), moved(edge(still, 20, 19), -20, 0)]
    std_px = solve(groups_of(21), edges, 10, frame_shape=SHAPE).assess().std_px
    assert std_px[:20].max() < 1 < 3 < std_px[20] < 40


@pytest.mark.parametrize(("skips", "n"), [((1, 2, 8), 100), ((2, 3, 8), 140)], ids=["disjoint", "half overlapping"])
def test_solve_of_a_long_capture_does_not_depend_on_its_start(skips: tuple[int, ...], n: int) -> None:
    """Errors of 8 px a pair, as of blurred exposures: along skips of 8, paths to neighbours drift apart by far more."""
    true = true_motion(n)
    edges = apart(true, skips, np.random.default_rng(0), 8.0)
    found, expected = (solve(groups_of(n), edges, n // 2, frame_shape=SHAPE, start=start) for start in (None, true))
    assert found.residual_px == pytest.approx(expected.residual_px, rel=0.01)
    neighbours = inverse(found.homographies[:-1]) @ found.homographies[1:]
    assert corner_displacements(neighbours, inverse(true[:-1]) @ true[1:], SHAPE).mean() < 8


def test_components_are_numbered_from_the_largest() -> None:
    true = true_motion(7)
    edges = [edge(true, 1, 0), Edge(2, 1, NotLocated("lost")), edge(true, 3, 2), edge(true, 4, 3), edge(true, 6, 4)]
    assert [len(np.flatnonzero(components(7, edges) == part)) for part in (0, 1, 2)] == [4, 2, 1]
    np.testing.assert_array_equal(components(7, edges) == 0, [False, False, True, True, True, False, True])
    assert sorted(components(3, [])) == [0, 1, 2]


@pytest.mark.parametrize(("closures", "most"), [(0, 20), (100, 50)])
def test_solve_of_a_large_graph_takes_few_steps_with_sparse_factors(
    monkeypatch: pytest.MonkeyPatch, closures: int, most: int
) -> None:
    """The factors of the normal equations stay sparse: at most `most` blocks for each exposure.

    What only shifts and rolls, which is solved for, too, has factors of less than a half of this size.
    """
    filled: list[int] = []
    factorise = adjustment.splu

    def counting(matrix: Any, **options: Any) -> Any:
        factors = factorise(matrix, **options)
        filled.append(factors.L.nnz + factors.U.nnz)
        return factors

    monkeypatch.setattr(adjustment, "splu", counting)
    true, rng = true_motion(300), np.random.default_rng(0)
    edges = apart(true, (1, 2, 4), rng)
    ends = np.sort(rng.choice(300, (closures, 2)))
    edges += [
        Edge(int(late), int(early), Located(normalised(inverse(true[early]) @ true[late])))
        for early, late in ends
        if late - early > 4
    ]
    solve(groups_of(300), edges, 150, frame_shape=SHAPE)
    assert sum(size > max(filled) / 2 for size in filled) <= 33  # thirty, one to compare, and those with wider walks
    assert len(filled) <= 40
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
    for seed in range(6):
        n_nodes, edges = any_edges(seed)
        solution = solve(groups_of(n_nodes), edges, 0, frame_shape=SHAPE)
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
