from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from photonpano import Located, NotLocated
from photonpano.geometry import (
    corner_displacements,
    corners,
    from_parameters,
    inverse,
    jacobian,
    normalised,
    parameters,
    rescaled,
    translation,
)
from photonpano.pipeline.graph import largest_component, solve
from photonpano.values import Edge

SHAPE = (254, 496)
NOISE_PX = 0.1


def true_motion(n_nodes: int, seed: int = 0) -> np.ndarray:
    """A camera that wanders by about 20 px from exposure to exposure, and turns."""
    steps = np.random.default_rng(seed).normal(size=(n_nodes, 8)) * [2e-3, 2e-3, 2e-3, 2e-3, 20, 5, 2e-6, 2e-6]
    return from_parameters(np.cumsum(steps, axis=0))


def edge(true: np.ndarray, moving: int, fixed: int, rng: np.random.Generator | None = None, std_px: float = NOISE_PX) -> Edge:
    """Measure a pair; with a generator, every corner errs by `std_px` along each axis, and the information says so."""
    homography = normalised(inverse(true[fixed]) @ true[moving])
    to_corners = jacobian(homography, corners(SHAPE)).reshape(8, 8)
    information = to_corners.T @ to_corners / std_px**2
    if rng is not None:
        change = np.linalg.solve(to_corners, rng.normal(scale=std_px, size=8))
        homography = from_parameters(parameters(homography) + change)
    return Edge(moving, fixed, Located(homography, information))


def measured(true: np.ndarray, skips: tuple[int, ...], rng: np.random.Generator | None = None) -> list[Edge]:
    return [edge(true, moving, moving - skip, rng) for moving in range(len(true)) for skip in skips if skip <= moving]


def error_px(homographies: np.ndarray, true: np.ndarray, anchor: int) -> float:
    moved = inverse(normalised(inverse(true[anchor]) @ true)) @ homographies
    return float(corner_displacements(moved, np.eye(3), SHAPE).mean())


def without_information(edges: list[Edge]) -> list[Edge]:
    return [Edge(each.moving, each.fixed, replace(each.motion, information=None)) for each in edges]


@pytest.mark.parametrize("skips", [(1,), (1, 2, 4), (1, 29)], ids=["chain", "loops", "closed once"])
@pytest.mark.parametrize("anchor", [0, 15, 29])
def test_without_noise_it_is_exact(skips: tuple[int, ...], anchor: int) -> None:
    true = true_motion(30)
    solution = solve(30, measured(true, skips), anchor, SHAPE)
    assert error_px(solution.homographies, true, anchor) < 1e-9
    assert solution.located.all()
    assert solution.contradictions == ()
    assert solution.residual_px < 1e-9


def test_the_anchor_is_the_identity() -> None:
    solution = solve(30, measured(true_motion(30), (1, 2, 4), np.random.default_rng(0)), 7, SHAPE)
    np.testing.assert_array_equal(solution.homographies[7], np.eye(3))
    np.testing.assert_array_equal(solution.homographies[:, 2, 2], 1)


def test_a_pair_may_be_measured_in_either_direction_and_twice() -> None:
    true = true_motion(4)
    edges = [edge(true, 1, 0), edge(true, 1, 2), edge(true, 2, 1), edge(true, 2, 3), edge(true, 0, 3), edge(true, 1, 0)]
    assert error_px(solve(4, edges, 0, SHAPE).homographies, true, 0) < 1e-9


def test_more_edges_beat_the_chain() -> None:
    """Errors of 0.1 px a pair: over 120 exposures a chain drifts by 0.7 px; second and fourth neighbours leave 0.14 px."""
    errors: dict[tuple[int, ...], list[float]] = {(1,): [], (1, 2, 4): [], (1, 2, 4, 40): []}
    for seed in range(2):
        true, rng = true_motion(120, seed), np.random.default_rng(seed)
        for skips, found in errors.items():
            found.append(error_px(solve(120, measured(true, skips, rng), 60, SHAPE).homographies, true, 60))
    chain, neighbours, revisits = (float(np.mean(found)) for found in errors.values())
    assert chain > 0.5
    assert neighbours < 0.35 * chain
    assert revisits < 0.15 * chain


def test_the_residual_is_that_of_the_measurements() -> None:
    """Every corner errs by 0.1 px along two axes; half of the residuals are taken up by the unknowns."""
    true = true_motion(200)
    edges = measured(true, (1, 2), np.random.default_rng(0))
    solution = solve(200, edges, 100, SHAPE)
    assert solution.residual_px == pytest.approx(NOISE_PX * np.sqrt(2) * np.sqrt(1 - 199 / len(edges)), rel=0.05)


@pytest.mark.parametrize("told_by", ["information", "residual_px"])
def test_edges_count_by_what_they_say_of_themselves(told_by: str) -> None:
    """Every second measurement of a pair is twenty times as noisy."""
    true, rng = true_motion(40), np.random.default_rng(0)
    good = measured(true, (1, 2), rng)
    noisy = [edge(true, each.moving, each.fixed, rng, 20 * NOISE_PX) for each in good]
    best = error_px(solve(40, good, 20, SHAPE).homographies, true, 20)
    told = good + noisy
    if told_by == "residual_px":
        stds = np.repeat([NOISE_PX, 20 * NOISE_PX], len(good))
        told = [
            Edge(each.moving, each.fixed, replace(each.motion, residual_px=std_px))
            for each, std_px in zip(without_information(told), stds, strict=True)
        ]
    weighted = error_px(solve(40, told, 20, SHAPE).homographies, true, 20)
    alike = error_px(solve(40, without_information(good + noisy), 20, SHAPE).homographies, true, 20)
    assert weighted < 1.2 * best
    assert alike > 1.5 * weighted


def test_one_gross_outlier_is_outvoted_and_reported_wherever_it_is() -> None:
    true = true_motion(12)
    edges = measured(true, (1, 2, 4), np.random.default_rng(0))
    clean = error_px(solve(12, edges, 6, SHAPE).homographies, true, 6)
    for index, each in enumerate(edges):
        wrong = replace(each.motion, homography=translation(40, -30) @ each.motion.homography)
        solution = solve(12, [*edges[:index], Edge(each.moving, each.fixed, wrong), *edges[index + 1 :]], 6, SHAPE)
        assert solution.contradictions == (index,)
        assert error_px(solution.homographies, true, 6) < 1.5 * clean


def test_failures_are_skipped_and_positions_are_those_of_the_whole_list() -> None:
    true = true_motion(20)
    edges = measured(true, (1, 2, 4), np.random.default_rng(0))
    wrong = replace(edges[30].motion, homography=translation(40, -30) @ edges[30].motion.homography)
    failure = Edge(5, 3, NotLocated("nothing to see"))
    given = [failure, *edges[:30], failure, Edge(edges[30].moving, edges[30].fixed, wrong), *edges[31:]]
    assert solve(20, given, 10, SHAPE).contradictions == (32,)


def test_what_is_not_tied_to_the_anchor_is_unknown() -> None:
    true = true_motion(7)
    edges = [edge(true, 1, 0), edge(true, 2, 1), edge(true, 2, 0), Edge(3, 2, NotLocated("lost")), edge(true, 5, 4)]
    solution = solve(7, edges, 1, SHAPE)
    np.testing.assert_array_equal(solution.located, [True, True, True, False, False, False, False])
    assert np.isnan(solution.homographies[3:]).all()
    assert error_px(solution.homographies[:3], true[:3], 1) < 1e-9


def test_a_graph_without_edges_is_its_anchor() -> None:
    solution = solve(3, [], 2, SHAPE)
    np.testing.assert_array_equal(solution.located, [False, False, True])
    np.testing.assert_array_equal(solution.homographies[2], np.eye(3))
    assert np.isnan(solution.homographies[:2]).all()


def test_the_solution_does_not_depend_on_the_unit_of_length() -> None:
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


def test_the_largest_component_is_the_one_with_most_exposures() -> None:
    true = true_motion(7)
    edges = [edge(true, 1, 0), Edge(2, 1, NotLocated("lost")), edge(true, 3, 2), edge(true, 4, 3), edge(true, 6, 4)]
    np.testing.assert_array_equal(largest_component(7, edges), [False, False, True, True, True, False, True])
    assert largest_component(3, []).sum() == 1
