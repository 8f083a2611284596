from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from photonpano import FrameSpan, Group
from photonpano.motion.pairs import pairs_of, shared_share


def groups(*starts: int, size: int = 100) -> list[Group]:
    return [Group(FrameSpan(start, start + size), start + (size - 1) / 2) for start in starts]


def test_pairs_without_skips_are_a_chain() -> None:
    assert pairs_of(groups(0, 100, 200, 300), ()) == [(1, 0), (2, 1), (3, 2)]


def test_pairs_of_adjacent_groups_one_length_apart_are_neighbours() -> None:
    assert pairs_of(groups(0, 100, 200, 300), (1.0, 2.0)) == [(1, 0), (2, 0), (2, 1), (3, 1), (3, 2)]


def test_pairs_of_overlapping_groups_share_no_frame() -> None:
    """Half a group apart, as at the second level: two before, the next one beyond, and four before; not the neighbour."""
    pairs = pairs_of(groups(0, 50, 100, 150, 200, 250), (1.0, 2.0))
    assert [pair for pair in pairs if pair[0] == 5] == [(5, 1), (5, 2), (5, 3)]
    assert [pair for pair in pairs if pair[0] == 2] == [(2, 0)]


def test_pairs_include_neighbours_if_graph_disconnects_without_them() -> None:
    assert pairs_of(groups(0, 30, 60), (1.0,)) == [(1, 0), (2, 1)]


def test_pairs_take_the_nearest_instant() -> None:
    pairs = pairs_of(groups(0, 45, 90, 135, 180), (1.0,))
    assert [pair for pair in pairs if pair[0] == 4] == [(4, 1), (4, 2)]


def test_pairs_of_end_groups_count_by_their_instant() -> None:
    ends = [Group(FrameSpan(0, 100), 0.0), *groups(0, 50, 100), Group(FrameSpan(100, 200), 199.0)]
    pairs = pairs_of(ends, (1.0,))
    # Instants 0, 49.5, 99.5, 149.5, 199: a hundred frames before the last lies the third.
    assert [pair for pair in pairs if pair[0] == 4] == [(4, 1), (4, 2)]
    assert (2, 0) in pairs


def test_pairs_include_partners_before_and_after_each_exposure() -> None:
    """A hundred frames before the last lies the second, but a hundred frames after the first lies the last."""
    pairs = pairs_of(groups(0, 30, 60, 120), (1.0,))
    assert {(3, 1), (3, 0)} <= set(pairs)


def test_pairs_of_groups_of_different_lengths_count_in_their_mean_length() -> None:
    """An exposure of a hundred frames touches the next one, of fifty, 75 frames away; the third is the one beyond;
    the last two have nothing else that is nearer to a group length away."""
    spans = FrameSpan(0, 100), FrameSpan(100, 150), FrameSpan(135, 185)
    assert pairs_of([Group(span, span.centre) for span in spans], (1.0,)) == [(1, 0), (2, 0), (2, 1)]


@given(
    gaps=st.lists(st.integers(1, 200), min_size=1, max_size=30),
    skips=st.lists(st.floats(0.1, 10), max_size=3),
)
def test_pairs_are_ordered_and_connect_all_exposures(gaps: list[int], skips: list[float]) -> None:
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
def test_shared_share_is_relative_to_the_shorter_span(first: tuple[int, int], second: tuple[int, int], share: float) -> None:
    assert shared_share(FrameSpan(*first), FrameSpan(*second)) == share
    assert shared_share(FrameSpan(*second), FrameSpan(*first)) == share
