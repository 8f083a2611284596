from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from photonpano import FrameSpan, Group
from photonpano.pipeline.pairs import pairs_of, shared_share


def groups(*starts: int, size: int = 100) -> list[Group]:
    return [Group(FrameSpan(start, start + size), start + (size - 1) / 2) for start in starts]


def test_without_skips_it_is_a_chain() -> None:
    assert pairs_of(groups(0, 100, 200, 300), ()) == [(1, 0), (2, 1), (3, 2)]


def test_side_by_side_a_group_length_is_the_neighbour() -> None:
    assert pairs_of(groups(0, 100, 200, 300), (1.0, 2.0)) == [(1, 0), (2, 0), (2, 1), (3, 1), (3, 2)]


def test_groups_that_overlap_are_also_paired_with_the_one_that_shares_no_frame() -> None:
    """Half a group apart, as at the second level: the neighbour, two before and four before."""
    pairs = pairs_of(groups(0, 50, 100, 150, 200, 250), (1.0, 2.0))
    assert [pair for pair in pairs if pair[0] == 5] == [(5, 1), (5, 3), (5, 4)]
    assert [pair for pair in pairs if pair[0] == 2] == [(2, 0), (2, 1)]


def test_where_groups_are_spread_the_nearest_instant_is_taken() -> None:
    pairs = pairs_of(groups(0, 45, 90, 135, 180), (1.0,))
    assert [pair for pair in pairs if pair[0] == 4] == [(4, 2), (4, 3)]


def test_end_groups_count_by_their_instant() -> None:
    ends = [Group(FrameSpan(0, 100), 0.0), *groups(0, 50, 100), Group(FrameSpan(100, 200), 199.0)]
    pairs = pairs_of(ends, (1.0,))
    # Instants 0, 49.5, 99.5, 149.5, 199: a hundred frames before the last lies the third.
    assert [pair for pair in pairs if pair[0] == 4] == [(4, 2), (4, 3)]
    assert (2, 0) in pairs


@given(
    gaps=st.lists(st.integers(1, 200), min_size=1, max_size=30),
    skips=st.lists(st.floats(0.1, 10), max_size=3),
)
def test_pairs_are_ordered_and_tie_every_exposure_to_its_neighbour(gaps: list[int], skips: list[float]) -> None:
    spread = groups(*(int(start) for start in np.cumsum(gaps)))
    pairs = pairs_of(spread, skips)
    assert pairs == sorted(set(pairs))
    assert all(0 <= fixed < moving < len(spread) for moving, fixed in pairs)
    assert {(later, later - 1) for later in range(1, len(spread))} <= set(pairs)
    assert len(pairs) <= (1 + len(skips)) * (len(spread) - 1)


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
