from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import find_peaks

from photonpano import FrameSpan, Group
from photonpano.geometry import translation
from photonpano.motion.closures import _PROMINENCE, _visits, closure_candidates
from photonpano.motion.graph import GraphSolution
from photonpano.motion.pairs import pairs_of, shared_share
from photonpano.specs.settings import GraphSettings

SHAPE = (40, 60)


def groups(*starts: int, size: int = 100) -> list[Group]:
    return [Group(FrameSpan(start, start + size), start + (size - 1) / 2) for start in starts]


def test_without_skips_it_is_a_chain() -> None:
    assert pairs_of(groups(0, 100, 200, 300), ()) == [(1, 0), (2, 1), (3, 2)]


def test_side_by_side_a_group_length_is_the_neighbour() -> None:
    assert pairs_of(groups(0, 100, 200, 300), (1.0, 2.0)) == [(1, 0), (2, 0), (2, 1), (3, 1), (3, 2)]


def test_groups_that_overlap_are_paired_with_those_that_share_no_frame() -> None:
    """Half a group apart, as at the second level: two before, the one beyond, and four before; not the neighbour."""
    pairs = pairs_of(groups(0, 50, 100, 150, 200, 250), (1.0, 2.0))
    assert [pair for pair in pairs if pair[0] == 5] == [(5, 1), (5, 2), (5, 3)]
    assert [pair for pair in pairs if pair[0] == 2] == [(2, 0)]


def test_neighbours_tie_what_falls_apart_without_them() -> None:
    assert pairs_of(groups(0, 30, 60), (1.0,)) == [(1, 0), (2, 1)]


def test_where_groups_are_spread_the_nearest_instant_is_taken() -> None:
    pairs = pairs_of(groups(0, 45, 90, 135, 180), (1.0,))
    assert [pair for pair in pairs if pair[0] == 4] == [(4, 1), (4, 2)]


def test_end_groups_count_by_their_instant() -> None:
    ends = [Group(FrameSpan(0, 100), 0.0), *groups(0, 50, 100), Group(FrameSpan(100, 200), 199.0)]
    pairs = pairs_of(ends, (1.0,))
    # Instants 0, 49.5, 99.5, 149.5, 199: a hundred frames before the last lies the third.
    assert [pair for pair in pairs if pair[0] == 4] == [(4, 1), (4, 2)]
    assert (2, 0) in pairs


def test_every_exposure_looks_both_ways() -> None:
    """A hundred frames before the last lies the second, but a hundred frames after the first lies the last."""
    pairs = pairs_of(groups(0, 30, 60, 120), (1.0,))
    assert {(3, 1), (3, 0)} <= set(pairs)


def test_between_groups_of_different_lengths_their_mean_counts() -> None:
    """An exposure of a hundred frames touches the next one, of fifty, 75 frames away; the third is the one beyond;
    the last two have nothing else that is nearer to a group length away."""
    spans = FrameSpan(0, 100), FrameSpan(100, 150), FrameSpan(135, 185)
    assert pairs_of([Group(span, span.centre) for span in spans], (1.0,)) == [(1, 0), (2, 0), (2, 1)]


@given(
    gaps=st.lists(st.integers(1, 200), min_size=1, max_size=30),
    skips=st.lists(st.floats(0.1, 10), max_size=3),
)
def test_pairs_are_ordered_and_tie_every_exposure_to_the_others(gaps: list[int], skips: list[float]) -> None:
    spread = groups(*(int(start) for start in np.cumsum(gaps)))
    pairs = pairs_of(spread, skips)
    assert pairs == sorted(set(pairs))
    assert all(0 <= fixed < moving < len(spread) for moving, fixed in pairs)
    assert {edge for pair in pairs for edge in pair} == set(range(len(spread))) or len(spread) == 1
    reached = {0}
    for _ in spread:
        reached |= {index for pair in pairs for index in pair if reached & set(pair)}
    assert reached == set(range(len(spread)))
    assert len(pairs) <= (len(spread) - 1) + 2 * (len(skips) + 1) * len(spread)


@pytest.mark.parametrize(
    ("first", "second", "share"),
    [
        ((0, 100), (100, 200), 0),
        ((0, 100), (50, 150), 0.5),
        ((0, 100), (0, 100), 1),
        ((0, 100), (20, 40), 1),
        ((0, 9), (20, 29), 0),
    ],
)
def test_the_share_of_common_frames(first: tuple[int, int], second: tuple[int, int], share: float) -> None:
    assert shared_share(FrameSpan(*first), FrameSpan(*second)) == share
    assert shared_share(FrameSpan(*second), FrameSpan(*first)) == share


def candidates(
    spread: list[Group],
    homographies: np.ndarray,
    located: np.ndarray,
    skips: tuple[float, ...] = (1.0, 2.0),
    min_overlap: float | None = 0.5,
) -> list[tuple[int, int]]:
    solution = GraphSolution(homographies, located, (), 0.0, lambda: (np.empty((0, 8, 8)), np.empty(0)))
    graph = GraphSettings(skips=skips, closure_overlap=min_overlap)
    return closure_candidates(spread, solution, SHAPE, graph)


def again(
    places: np.ndarray, *, step: int = 100, skips: tuple[float, ...] = (1.0, 2.0), min_overlap: float = 0.5
) -> list[tuple[int, int]]:
    """Visit (x, y) places with exposures of 100 frames, `step` frames apart."""
    homographies = np.array([translation(x, y) for x, y in places])
    spread = groups(*range(0, step * len(places), step))
    return candidates(spread, homographies, np.ones(len(places), bool), skips, min_overlap)


def line(*x_px: float) -> np.ndarray:
    return np.array([(x, 0.0) for x in x_px])


FORTH = np.arange(20) * 9.0
BACK = FORTH[::-1]


def raster(rows_px: float, n_rows: int = 3) -> np.ndarray:
    """Sweep over rows that lie so far apart, forth and back."""
    x = np.concatenate([FORTH if row % 2 == 0 else BACK for row in range(n_rows)])
    return np.stack([x, np.repeat(np.arange(n_rows) * rows_px, len(FORTH))], axis=1)


def test_on_the_way_back_every_exposure_meets_the_one_at_its_place() -> None:
    """Exposure 20 + i lies where 19 - i does; those around the turn are registered as neighbours."""
    assert again(line(*FORTH, *BACK)) == [(20 + i, 19 - i) for i in range(2, 20)]


def test_a_raster_meets_all_earlier_rows_within_sight() -> None:
    """Rows 8 px apart in a field of 40 px: the third row sees both others, apart from where they turn."""
    pairs = again(raster(8))
    assert {(40 + i, 39 - i) for i in range(3, 20)} <= set(pairs)
    assert {(40 + i, i) for i in range(17)} <= set(pairs)
    assert {(20 + i, 19 - i) for i in range(3, 20)} <= set(pairs)
    # Rows 24 px apart share less than half of the field of view.
    assert again(raster(24)) == []
    assert again(raster(24), min_overlap=0.3) != []


def test_the_least_overlap_is_what_is_asked_for() -> None:
    """On the way back the first place is missed by 20 of 60 px."""
    places = line(0, 60, 120, 180, 240, 180, 120, 60, 20)
    assert again(places, min_overlap=0.6) == [(6, 2), (7, 1), (8, 0)]
    assert again(places, min_overlap=0.7) == [(6, 2), (7, 1)]


def test_a_place_that_is_seen_often_is_paired_with_three_visits() -> None:
    """Those that it shares most with: of five visits of the left end, the closest three."""
    far = 200.0
    places = line(0, far, 2, far, 9, far, 12, far, 20, far, 3)
    assert [pair for pair in again(places, skips=()) if pair[0] == 10] == [(10, 0), (10, 2), (10, 4)]


def test_a_pan_meets_no_place_again() -> None:
    assert again(line(*(np.arange(60) * 9.0))) == []
    assert again(line(*(np.arange(60) * 0.5))) == []


@pytest.mark.parametrize("tremor_px", [0, 1e-6, 0.01, 1.0])
@pytest.mark.parametrize("seed", range(5))
def test_a_camera_that_stands_still_or_trembles_has_not_been_away(tremor_px: float, seed: int) -> None:
    assert again(np.random.default_rng(seed).normal(scale=tremor_px, size=(60, 2))) == []


def test_a_pan_with_a_trembling_hand_meets_no_place_again() -> None:
    tremor = np.random.default_rng(0).normal(scale=1.0, size=(60, 2))
    assert again(line(*(np.arange(60) * 3.0)) + tremor) == []


def test_the_best_view_of_a_visit_counts_once_though_the_hand_trembles() -> None:
    tremor = np.random.default_rng(0).normal(scale=1.0, size=(40, 2))
    pairs = again(line(*FORTH, *BACK) + tremor)
    assert [moving for moving, _ in pairs] == list(range(22, 40))
    assert all(abs(moving + fixed - 39) <= 1 for moving, fixed in pairs)


def test_dense_exposures_are_thinned_out() -> None:
    """Four in a group length: as many pairs as with one."""
    sparse = again(line(*FORTH, *BACK))
    dense = again(line(*np.repeat(np.concatenate([FORTH, BACK]), 4)), step=25)
    assert {index % 4 for pair in dense for index in pair} == {0}
    assert len(dense) == len(sparse)


def test_places_seen_soon_again_are_left_to_the_skips() -> None:
    """Within twice the most distant skip, in group lengths."""
    for skips, nearest in (((1.0, 2.0), 5), ((1.0, 4.0), 9), ((6.0,), 13)):
        pairs = again(line(*FORTH, *BACK), skips=skips)
        assert min(moving - fixed for moving, fixed in pairs) == nearest


def test_what_is_not_located_meets_nothing() -> None:
    places = line(*FORTH, *BACK)
    homographies = np.array([translation(x, y) for x, y in places])
    located = np.ones(40, bool)
    located[[5, 30]] = False
    homographies[~located] = np.nan
    pairs = candidates(groups(*range(0, 4000, 100)), homographies, located)
    assert not {5, 30} & {index for pair in pairs for index in pair}
    assert len(pairs) >= 16


def test_groups_of_another_length_meet_nothing() -> None:
    """The first and the last group of a capture may be shorter; their exposures are noisier."""
    places = line(*FORTH, *BACK)
    homographies = np.array([translation(x, y) for x, y in places])
    spread = [Group(FrameSpan(0, 50), 0.0), *groups(*range(100, 4000, 100))]
    pairs = candidates(spread, homographies, np.ones(40, bool))
    assert {index for pair in pairs for index in pair} == set(range(1, 18)) | set(range(22, 40))


@pytest.mark.parametrize("n_groups", [1, 2])
def test_few_exposures_meet_nothing(n_groups: int) -> None:
    assert again(line(*[0.0] * n_groups)) == []


@given(
    places=st.lists(st.tuples(st.floats(-80, 80), st.floats(-40, 40)), min_size=1, max_size=40),
    step=st.integers(20, 150),
    skips=st.lists(st.floats(0.1, 4), max_size=3),
    min_overlap=st.floats(0.05, 0.95),
)
def test_pairs_that_meet_are_ordered_unique_and_beyond_the_skips(
    places: list[tuple[float, float]], step: int, skips: list[float], min_overlap: float
) -> None:
    pairs = again(np.array(places), step=step, skips=tuple(skips), min_overlap=min_overlap)
    assert pairs == sorted(set(pairs))
    assert all(step * (moving - fixed) >= 200 * max([1.0, *skips]) for moving, fixed in pairs)
    assert max(np.bincount([moving for moving, _ in pairs]), default=0) <= 3
    for moving, fixed in pairs:
        away = np.abs(np.subtract(places[moving], places[fixed]))
        # Counted on a grid of eight by eight.
        assert np.prod(np.maximum(0, 1 - away / [59, 39]) + 1 / 8) >= min_overlap


@pytest.mark.parametrize("seed", range(20))
def test_visits_are_the_prominent_peaks_of_the_overlap(seed: int) -> None:
    rng = np.random.default_rng(seed)
    overlap = np.cumsum(rng.normal(0, 0.15, rng.integers(1, 60))) % 1.0
    if seed % 2:
        overlap = np.round(overlap * 8) / 8
    expected, _ = find_peaks(np.concatenate([[0.0], overlap, [1.0]]), height=0.5, prominence=_PROMINENCE)
    np.testing.assert_array_equal(_visits(overlap, 0.5), expected - 1)
