"""The expected errors of a solved motion graph, and what its measurements say of a node."""

from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest

from photonpano import Group
from photonpano.geometry import corners, from_parameters, inverse, rotation_matrices, translation
from photonpano.motion.adjustment import std_of
from photonpano.motion.graph import GraphSolution, solve
from photonpano.motion.locate import LocatedLevel
from photonpano.motion.models import MotionModel

from .measured_graphs import (
    NOISE_PX,
    SHAPE,
    confident,
    edge,
    graph,
    groups_of,
    measured,
    noise_of,
    pairs,
    seen_by_points,
    squared_errors,
    true_motion,
)

pytestmark = pytest.mark.usefixtures("one_thread")

SEEDS = 16
UNEQUAL = np.array([0.3, 0.1, 0.1, 0.2, 0.1, 0.3, 0.2, 0.2, 0.1, 0.3])


class Measured(NamedTuple):
    """How a motion of ten exposures is measured: of which frames, by which pairs, and how well."""

    groups: list[Group]
    skips: tuple[int, ...]
    std_px: np.ndarray | float = NOISE_PX
    own_px: float = 0.0  # error that pairs that are no neighbours add by themselves


GRAPHS = {
    "a chain": Measured(groups_of(10), (1,)),
    "unequal noise": Measured(groups_of(10), (1, 2), UNEQUAL),
    "dense": Measured(groups_of(10, 40, 10), (4, 5, 6, 7)),
    "pairs with errors of their own": Measured(groups_of(10), (1, 2, 4), NOISE_PX, 0.2),
}


def errors_and_expected(solutions: list[GraphSolution], true: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean square errors of every exposure, and what was expected of them: (N,) each."""
    squares = np.array([squared_errors(solution.homographies, true) for solution in solutions])
    expected = np.array([solution.assess().std_px for solution in solutions])
    assert np.mean(np.sqrt(squares) < 3 * expected) > 0.99
    return squares.mean(axis=0), (expected**2).mean(axis=0)


@pytest.mark.parametrize("name", GRAPHS)
def test_expected_error_matches_actual_error_of_every_exposure(name: str) -> None:
    """Sixteen measurements of one motion, whose pairs err by the noise of their exposures."""
    groups, skips, std_px, own_px = GRAPHS[name]
    true, solutions = true_motion(10), []
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        noise = noise_of(groups, rng, std_px)
        edges = [
            edge(true, *pair, noise, std_px, (rng, own_px) if own_px and pair[0] - pair[1] > 1 else None)
            for pair in pairs(10, skips)
        ]
        solutions.append(solve(groups, edges, 5, frame_shape=SHAPE))
    squares, expected = errors_and_expected(solutions, true)
    assert 0.8 < np.sqrt(squares.mean() / expected.mean()) < 1.25
    ratios = np.sqrt(squares / expected)
    assert 0.55 < ratios.min() < ratios.max() < 1.5


@pytest.mark.parametrize("skips", [(1,), (1, 2, 3)], ids=["chain", "skips"])
@pytest.mark.parametrize("step_px", [0, 124])
def test_expected_error_holds_where_pairs_see_parts_of_their_exposures(step_px: float, skips: tuple[int, ...]) -> None:
    """Each exposure shows points of the scene with errors of its own; next to each other, pairs see other points."""
    steps, rng = np.arange(16.0), np.random.default_rng(7)
    true = from_parameters(
        np.stack([0 * steps] * 4 + [step_px * steps, *rng.normal(size=(1, 16)) * 5, 0 * steps, 0 * steps], axis=-1)
    )
    edges = [seen_by_points(true, skips, np.random.default_rng(seed), 0.5) for seed in range(SEEDS)]
    solutions = [solve(groups_of(16), each, 8, frame_shape=SHAPE, model=MotionModel(kind="euclidean")) for each in edges]
    squares, expected = errors_and_expected(solutions, true)
    assert 0.8 < np.sqrt(squares.mean() / expected.mean()) < 1.25


@pytest.mark.parametrize("n_nodes", [9, 36])
def test_expected_error_of_a_chain_is_the_noise_of_its_exposures_however_long_it_is(n_nodes: int) -> None:
    """The camera stands still: three of eight numbers are free, and the best alignment of planes takes out their mean."""
    still = np.broadcast_to(np.eye(3), (n_nodes, 3, 3))
    solution = solve(groups_of(n_nodes), measured(still, (1,)), 0, frame_shape=SHAPE)
    assert solution.walks_px == {}
    np.testing.assert_allclose(solution.assess().std_px, NOISE_PX * np.sqrt(3 / 8 * (1 - 1 / n_nodes)), rtol=0.25)


@pytest.mark.parametrize("roll_px", [0, 0.03, 0.3])
def test_roll_is_none_where_it_is_no_more_than_noise(roll_px: float) -> None:
    """A camera that shifts alone has none of the roll of its pairs' noise; one that rolls slowly, by less, keeps its own."""
    along, middle = np.linspace(-1, 1, 120), translation(*corners(SHAPE).mean(axis=0))
    radians = roll_px / np.linalg.norm(corners(SHAPE).mean(axis=0)) * np.sin(3 * along)
    true = middle @ rotation_matrices(np.stack([0 * along, 0 * along, radians], axis=-1)) @ inverse(middle)
    edges = measured(true, (1, 2), noise_of(groups_of(120), np.random.default_rng(0)))
    solution = solve(groups_of(120), edges, 60, frame_shape=SHAPE, model=MotionModel(kind="euclidean"))
    assert solution.without_roll is not None
    assert solution.rolls_by_chance(solution.assess().errors_px, SHAPE) == (not roll_px)
    alone = solution.without_roll()
    assert np.abs(alone.homographies[:, 1, 0]).max() < 1e-12
    if not roll_px:
        squares, expected = errors_and_expected([alone], true)
        assert 0.7 < np.sqrt(squares.mean() / expected.mean()) < 1.4
        assert squares.mean() < 0.9 * squared_errors(solution.homographies, true).mean()


@pytest.mark.parametrize("skips", [(1, 2), (1,)], ids=["loops", "chain"])
def test_expected_error_corrects_overconfident_edges_only_with_loops(skips: tuple[int, ...]) -> None:
    _, edges = graph(40, skips)
    honest, overconfident, modest = (
        solve(groups_of(40), confident(edges, times), 20, frame_shape=SHAPE).assess().std_px.mean() for times in (1, 5, 0.2)
    )
    assert overconfident == pytest.approx(honest if skips == (1, 2) else honest / 5, rel=0.2)
    # With less to tell, walks are narrower.
    assert 3 * honest < modest < 5.5 * honest


@pytest.mark.parametrize(("side_px", "share"), [(40, 1.0), (400, 0.66)])
def test_bend_of_a_path_is_shared_by_exposures_that_see_the_same(side_px: int, share: float) -> None:
    """Of x^2 from -1 to 1, 20 of 99 steps apart, half of the mean squared difference is 0.34 of the mean square."""
    rng, along = np.random.default_rng(0), np.linspace(-1, 1, 100)
    bent, alone = np.repeat(along[:, None, None] ** 2, 8, axis=1) * rng.normal(size=64), rng.normal(size=(100, 8, 64))

    def drift_share(errors: np.ndarray) -> float:
        level = SimpleNamespace(
            assessed=SimpleNamespace(errors_px=errors),
            solution=SimpleNamespace(rotations=None),
            homographies=np.array([translation(10.0 * number, 0) for number in range(100)]),
            frame_shape=(side_px, side_px),
            std_px=std_of(errors),
        )
        return LocatedLevel.drift_share.fget(level)

    assert drift_share(bent) == pytest.approx(share, abs=0.02)
    assert drift_share(alone) < 0.02
