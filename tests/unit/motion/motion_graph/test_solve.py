"""The solution of the motion graph, with outliers and in several parts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from photonpano import NotLocated
from photonpano.geometry import corner_displacements, inverse, normalised, rescaled, translation
from photonpano.motion.graph import components, solve
from photonpano.values import Edge

from .measured_graphs import NOISE_PX, SHAPE, confident, edge, measured, true_motion

pytestmark = pytest.mark.usefixtures("one_thread")


def error_px(homographies: np.ndarray, true: np.ndarray, anchor: int) -> float:
    moved = inverse(normalised(inverse(true[anchor]) @ true)) @ homographies
    return float(corner_displacements(moved, np.eye(3), SHAPE).mean())


def moved(wrong: Edge, x_px: float, y_px: float) -> Edge:
    """Return the edge with an error of (x_px, y_px)."""
    return replace(wrong, motion=replace(wrong.motion, homography=translation(x_px, y_px) @ wrong.motion.homography))


def without_information(edges: list[Edge]) -> list[Edge]:
    return [Edge(each.moving, each.fixed, replace(each.motion, information=None)) for each in edges]


@pytest.mark.parametrize("skips", [(1,), (1, 2, 4), (1, 29)], ids=["chain", "loops", "closed once"])
@pytest.mark.parametrize("anchor", [0, 15, 29])
def test_solve_is_exact_without_noise(skips: tuple[int, ...], anchor: int) -> None:
    true = true_motion(30)
    solution = solve(30, measured(true, skips), anchor, SHAPE)
    assert error_px(solution.homographies, true, anchor) < 1e-9
    assert solution.located.all()
    assert solution.outliers == ()
    assert solution.residual_px < 1e-9


def test_solve_keeps_anchor_at_identity() -> None:
    solution = solve(30, measured(true_motion(30), (1, 2, 4), np.random.default_rng(0)), 7, SHAPE)
    np.testing.assert_array_equal(solution.homographies[7], np.eye(3))
    np.testing.assert_array_equal(solution.homographies[:, 2, 2], 1)


def test_solve_accepts_pairs_in_either_direction_and_twice() -> None:
    true = true_motion(4)
    edges = [edge(true, 1, 0), edge(true, 1, 2), edge(true, 2, 1), edge(true, 2, 3), edge(true, 0, 3), edge(true, 1, 0)]
    assert error_px(solve(4, edges, 0, SHAPE).homographies, true, 0) < 1e-9


def test_solve_error_falls_with_more_edges_than_a_chain() -> None:
    """Errors of 0.1 px a pair: over 120 exposures a chain drifts by 0.7 px; second and fourth neighbours leave 0.14 px."""
    errors: dict[tuple[int, ...], list[float]] = {(1,): [], (1, 2, 4): [], (1, 2, 4, 40): []}
    for seed in range(2):
        true, rng = true_motion(120, seed), np.random.default_rng(seed)
        for skips, found in errors.items():
            found.append(error_px(solve(120, measured(true, skips, rng), 60, SHAPE).homographies, true, 60))
    chain, neighbours, closures = (float(np.mean(found)) for found in errors.values())
    assert chain > 0.5
    assert neighbours < 0.35 * chain
    assert closures < 0.15 * chain


def test_residual_is_that_of_the_measurements() -> None:
    """Every corner has an error of 0.1 px along two axes; the unknowns absorb half of the residuals."""
    true = true_motion(200)
    edges = measured(true, (1, 2), np.random.default_rng(0))
    solution = solve(200, edges, 100, SHAPE)
    assert solution.residual_px == pytest.approx(NOISE_PX * np.sqrt(2) * np.sqrt(1 - 199 / len(edges)), rel=0.05)


@pytest.mark.parametrize("weighted_by", ["information", "residual_px"])
def test_solve_weights_edges_by_information_or_residual(weighted_by: str) -> None:
    """Every second measurement of a pair is twenty times as noisy."""
    true, rng = true_motion(40), np.random.default_rng(0)
    good = measured(true, (1, 2), rng)
    noisy = [edge(true, each.moving, each.fixed, rng, 20 * NOISE_PX) for each in good]
    best = error_px(solve(40, good, 20, SHAPE).homographies, true, 20)
    edges = good + noisy
    if weighted_by == "residual_px":
        stds = np.repeat([NOISE_PX, 20 * NOISE_PX], len(good))
        edges = [
            Edge(each.moving, each.fixed, replace(each.motion, residual_px=std_px))
            for each, std_px in zip(without_information(edges), stds, strict=True)
        ]
    weighted = error_px(solve(40, edges, 20, SHAPE).homographies, true, 20)
    unweighted = error_px(solve(40, without_information(good + noisy), 20, SHAPE).homographies, true, 20)
    assert weighted < 1.2 * best
    assert unweighted > 1.5 * weighted


def test_solve_drops_one_gross_outlier_at_any_edge() -> None:
    true = true_motion(9)
    edges = measured(true, (1, 2, 4), np.random.default_rng(0))
    clean = error_px(solve(9, edges, 4, SHAPE).homographies, true, 4)
    for index, each in enumerate(edges):
        solution = solve(9, [*edges[:index], moved(each, 40, -30), *edges[index + 1 :]], 4, SHAPE)
        assert solution.outliers == (index,)
        assert error_px(solution.homographies, true, 4) < 1.5 * clean


def test_solve_with_outliers_equals_solve_without_them() -> None:
    true = true_motion(20)
    edges = measured(true, (1, 2, 4), np.random.default_rng(0))
    wrong = {7: moved(edges[7], 3, 0), 30: moved(edges[30], 40, -30), 31: moved(edges[31], 0, 500)}
    solution = solve(20, [wrong.get(index, each) for index, each in enumerate(edges)], 10, SHAPE)
    without = solve(20, [each for index, each in enumerate(edges) if index not in wrong], 10, SHAPE)
    assert solution.outliers == tuple(wrong)
    assert without.outliers == ()
    assert corner_displacements(solution.homographies, without.homographies, SHAPE).max() < 1e-3
    assert solution.residual_px == pytest.approx(without.residual_px, rel=1e-4)
    assessed, assessed_without = solution.assess(), without.assess()
    np.testing.assert_allclose(
        assessed.information, assessed_without.information, rtol=0.01, atol=1e-4 * assessed.information.max()
    )
    # Both are estimated from 64 draws.
    np.testing.assert_allclose(assessed.std_px, assessed_without.std_px, rtol=0.25)


def test_solve_keeps_outliers_if_graph_disconnects_without_them() -> None:
    """The last exposure has two pairs that are 40 px apart: either may be right, and the expected error includes both."""
    still = np.broadcast_to(np.eye(3), (21, 3, 3))
    edges = [*measured(still[:20], (1, 2)), moved(edge(still, 20, 19), 20, 0), moved(edge(still, 20, 19), -20, 0)]
    solution = solve(21, without_information(edges), 10, SHAPE)
    assert solution.located.all()
    assert solution.outliers == ()
    assert error_px(solution.homographies, still, 10) < 1e-6
    assert solution.residual_px == pytest.approx(20 * np.sqrt(2 / len(edges)))
    std_px = solution.assess().std_px
    assert std_px[:20].max() < 2 < 5 < std_px[20] < 40


def test_outlier_positions_count_failed_edges() -> None:
    true = true_motion(20)
    edges = measured(true, (1, 2, 4), np.random.default_rng(0))
    failure = Edge(5, 3, NotLocated("nothing to see"))
    given = [failure, *edges[:30], failure, moved(edges[30], 40, -30), *edges[31:]]
    assert solve(20, given, 10, SHAPE).outliers == (32,)


def test_solve_keeps_edges_outside_the_spanning_tree_it_starts_from() -> None:
    """The spanning tree contains one pair in two; errors are three times what the information predicts."""
    true = true_motion(60)
    edges = confident(measured(true, (1, 2), np.random.default_rng(0)), 3)
    solution = solve(60, edges, 30, SHAPE)
    assert solution.outliers == ()
    assert solution.residual_px == pytest.approx(NOISE_PX * np.sqrt(2) * np.sqrt(1 - 59 / len(edges)), rel=0.1)


@pytest.mark.parametrize(("skips", "n"), [((1, 2, 8), 400), ((2, 3, 8), 600)], ids=["disjoint", "half overlapping"])
def test_solve_of_a_long_capture_does_not_depend_on_its_start(skips: tuple[int, ...], n: int) -> None:
    """Errors of 8 px a pair, as of blurred exposures: along skips of 8, paths to neighbours drift apart by far more."""
    true = true_motion(n)
    edges = measured(true, skips, np.random.default_rng(0), 8.0)
    found, expected = (solve(n, edges, n // 2, SHAPE, start) for start in (None, true))
    assert found.residual_px == pytest.approx(expected.residual_px, rel=0.01)
    neighbours = inverse(found.homographies[:-1]) @ found.homographies[1:]
    assert corner_displacements(neighbours, inverse(true[:-1]) @ true[1:], SHAPE).mean() < 8


def test_solve_leaves_nodes_not_tied_to_the_anchor_unknown() -> None:
    true = true_motion(7)
    edges = [edge(true, 1, 0), edge(true, 2, 1), edge(true, 2, 0), Edge(3, 2, NotLocated("lost")), edge(true, 5, 4)]
    solution = solve(7, edges, 1, SHAPE)
    np.testing.assert_array_equal(solution.located, [True, True, True, False, False, False, False])
    assert error_px(solution.homographies[:3], true[:3], 1) < 1e-9
    assert np.isnan(solution.homographies[3:]).all()
    assessed = solution.assess()
    information, std_px = assessed.information, assessed.std_px
    assert (information.shape, std_px.shape) == ((3, 8, 8), (3,))
    assert np.isfinite(information).all()
    assert np.isfinite(std_px).all()


def test_solve_without_edges_locates_anchor_alone() -> None:
    solution = solve(3, [], 2, SHAPE)
    np.testing.assert_array_equal(solution.located, [False, False, True])
    np.testing.assert_array_equal(solution.homographies[2], np.eye(3))
    assert np.isnan(solution.homographies[:2]).all()
    assessed = solution.assess()
    information, std_px = assessed.information, assessed.std_px
    np.testing.assert_array_equal(information, np.full((1, 8, 8), np.nan))
    np.testing.assert_array_equal(std_px, [np.nan])


def test_solve_does_not_depend_on_the_unit_of_length() -> None:
    true = true_motion(20)
    edges = without_information(measured(true, (1, 2, 4), np.random.default_rng(0)))
    halved = [
        Edge(each.moving, each.fixed, replace(each.motion, homography=rescaled(each.motion.homography, 0.5))) for each in edges
    ]
    whole = solve(20, edges, 10, SHAPE)
    # Rescaling keeps pixel edges in place, so that corner pixels are not quite the same points: to 1/1000 px it is one motion.
    half = solve(20, halved, 10, (SHAPE[0] // 2, SHAPE[1] // 2))
    moved = inverse(whole.homographies) @ rescaled(half.homographies, 2)
    assert corner_displacements(moved, np.eye(3), SHAPE).max() < 1e-3


def test_components_are_numbered_from_the_largest() -> None:
    true = true_motion(7)
    edges = [edge(true, 1, 0), Edge(2, 1, NotLocated("lost")), edge(true, 3, 2), edge(true, 4, 3), edge(true, 6, 4)]
    assert [len(np.flatnonzero(components(7, edges) == part)) for part in (0, 1, 2)] == [4, 2, 1]
    np.testing.assert_array_equal(components(7, edges) == 0, [False, False, True, True, True, False, True])
    assert sorted(components(3, [])) == [0, 1, 2]
