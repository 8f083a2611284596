"""The expected errors of a solved motion graph, and what its measurements say of a node."""

from collections.abc import Callable

import numpy as np
import pytest

from photonpano.geometry import (
    align_planes,
    corners,
    from_parameters,
    inverse,
    normalised,
    parameters,
    transform_points,
)
from photonpano.motion.graph import solve
from photonpano.values import Edge

from .measured_graphs import (
    NOISE_PX,
    SHAPE,
    confident,
    edge,
    graph,
    measured,
    true_motion,
)

pytestmark = pytest.mark.usefixtures("one_thread")


def squared_errors(homographies: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Return the mean square distance of the corners from where they should be, after the best alignment of planes: (N,)."""
    frame = corners(SHAPE)
    missed = transform_points(np.linalg.inv(true) @ align_planes(homographies, true, SHAPE) @ homographies, frame) - frame
    return np.sum(missed**2, axis=-1).mean(axis=-1)


def unequal(true: np.ndarray, skips: tuple[int, ...], rng: np.random.Generator) -> list[Edge]:
    """Measure pairs with errors of 0.03 to 0.3 px, and matching information."""
    stds = np.random.default_rng(1).choice([0.03, 0.1, 0.3], size=len(true) * len(skips))
    pairs = [(moving, moving - skip) for moving in range(len(true)) for skip in skips if skip <= moving]
    return [edge(true, *pair, rng, std_px) for pair, std_px in zip(pairs, stds, strict=False)]


GRAPHS: dict[str, Callable[..., list[Edge]]] = {
    "a chain": lambda true, rng: measured(true, (1,), rng),
    "second neighbours": lambda true, rng: measured(true, (1, 2), rng),
    "closed at the end": lambda true, rng: measured(true, (1, len(true) - 1), rng),
    "closed in a part": lambda true, rng: [*measured(true, (1,), rng), edge(true, 8, 1, rng)],
    "unequal noise": lambda true, rng: unequal(true, (1, 2), rng),
    "overconfident": lambda true, rng: confident(measured(true, (1, 2), rng), 3),
}


@pytest.mark.parametrize("graph", GRAPHS)
def test_expected_error_matches_actual_error_of_every_exposure(graph: str) -> None:
    """Sixteen measurements of one motion: the error of every exposure is as large as expected."""
    true = true_motion(10)
    found = [solve(10, GRAPHS[graph](true, np.random.default_rng(seed)), 5, SHAPE) for seed in range(16)]
    squares = np.array([squared_errors(solution.homographies, true) for solution in found])
    expected = np.array([solution.assess().std_px for solution in found])
    ratios = np.sqrt(squares.mean(axis=0) / (expected**2).mean(axis=0))
    assert 0.7 < ratios.min() < ratios.max() < 1.2
    # A single loop hardly determines the scale of errors; the larger one is taken.
    assert 0.8 < np.sqrt(squares.mean() / (expected**2).mean()) < 1.1
    assert np.mean(np.sqrt(squares) < 3 * expected) > 0.99


@pytest.mark.parametrize("n_nodes", [9, 36])
def test_expected_error_of_a_chain_is_that_of_a_random_walk(n_nodes: int) -> None:
    """Step j of a walk over N exposures weighs j / N in the distance of those after it from the mean, (N - j) / N before.

    The camera stands still, so that the best alignment of planes takes out the mean.
    """
    true = np.broadcast_to(np.eye(3), (n_nodes, 3, 3))
    solution = solve(n_nodes, measured(true, (1,)), 0, SHAPE)
    steps = np.arange(1, n_nodes)
    shares = [np.where(steps <= k, steps, n_nodes - steps) / n_nodes for k in range(n_nodes)]
    walk = NOISE_PX * np.sqrt(2) * np.linalg.norm(shares, axis=1)
    np.testing.assert_allclose(solution.assess().std_px, walk, rtol=0.12)


def test_expected_error_does_not_depend_on_the_anchor() -> None:
    _, edges = graph(20, (1, 2))
    first, last = (solve(20, edges, anchor, SHAPE).assess().std_px for anchor in (0, 19))
    np.testing.assert_allclose(first, last, rtol=0.01)


@pytest.mark.parametrize("skips", [(1, 2), (1,)], ids=["loops", "chain"])
def test_expected_error_corrects_overconfident_edges_only_with_loops(skips: tuple[int, ...]) -> None:
    _, edges = graph(40, skips)
    honest, overconfident, modest = (
        solve(40, confident(edges, times), 20, SHAPE).assess().std_px.mean() for times in (1, 5, 0.2)
    )
    assert overconfident == pytest.approx(honest if skips == (1, 2) else honest / 5, rel=0.1)
    assert modest == pytest.approx(5 * honest, rel=0.15)


def test_information_of_a_node_is_the_curvature_of_the_cost_with_others_held() -> None:
    true = true_motion(5)
    edges = [
        edge(true, 1, 0),
        edge(true, 2, 1, std_px=0.2),
        edge(true, 2, 0),
        edge(true, 1, 3, std_px=0.05),
        edge(true, 4, 3),
        edge(true, 4, 2),
    ]
    solution = solve(5, edges, 1, SHAPE)
    found = solution.assess().information

    def cost(node: int, change: np.ndarray) -> float:
        homographies = solution.homographies.copy()
        homographies[node] = from_parameters(parameters(homographies[node]) + change)
        total = 0.0
        for each in (each for each in edges if node in (each.moving, each.fixed)):
            relative = normalised(inverse(homographies[each.fixed]) @ homographies[each.moving])
            missed = parameters(relative) - parameters(each.motion.homography)
            total += missed @ each.motion.information @ missed / 2
        return total

    # Each step moves the corners by about as much.
    steps = 1e-3 / np.array([250, 250, 250, 250, 1, 1, 250**2, 250**2])
    for node in range(5):
        curvature = np.zeros((8, 8))
        for first, second in np.ndindex(8, 8):
            for one, other in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
                change = one * steps * (np.arange(8) == first) + other * steps * (np.arange(8) == second)
                curvature[first, second] += one * other * cost(node, change) / 4
        information = found[node] * np.outer(steps, steps)
        np.testing.assert_allclose(information, curvature, rtol=0.01, atol=1e-3 * np.abs(information).max())
