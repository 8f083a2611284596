from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from photonpano import FrameSpan, Group
from photonpano_core.configs import MidpointConfig
from photonpano_core.resamplers import MidpointResampler


def groups(n_frames: int, level: int, group_size: int = 100, **config: bool) -> tuple[Group, ...]:
    return MidpointResampler(MidpointConfig(group_size=group_size, **config)).groups(n_frames, level)


def spans(*starts: int, size: int = 100) -> list[FrameSpan]:
    return [FrameSpan(start, start + size) for start in starts]


def test_midpoint_fills_capture_at_level_1() -> None:
    found = groups(400, 1)
    assert [group.span for group in found] == spans(0, 100, 200, 300)
    assert [group.reference for group in found] == [49.5, 149.5, 249.5, 349.5]


def test_midpoint_adds_group_between_every_two_and_shorter_ones_at_ends() -> None:
    found = groups(400, 2)
    assert [group.span for group in found] == [FrameSpan(0, 50), *spans(0, 50, 100, 150, 200, 250, 300), FrameSpan(350, 400)]
    assert [group.reference for group in found] == [24.5, 49.5, 99.5, 149.5, 199.5, 249.5, 299.5, 349.5, 374.5]
    ends = groups(400, 3)
    assert [group.span for group in (*ends[:2], *ends[-2:])] == [
        FrameSpan(0, 25),
        FrameSpan(0, 50),
        FrameSpan(350, 400),
        FrameSpan(375, 400),
    ]


def test_midpoint_end_groups_have_four_frames_at_least() -> None:
    assert min(len(group.span) for group in groups(400, 9)) == 6


def test_midpoint_leaves_out_spare_frames_between_groups() -> None:
    assert [group.span for group in groups(460, 1)] == spans(0, 120, 240, 360)


def test_midpoint_centres_single_group() -> None:
    assert [group.span for group in groups(160, 1)] == spans(30)
    assert [group.reference for group in groups(160, 2)] == [24.5, 79.5, 134.5]


@pytest.mark.parametrize(("level", "count"), [(1, 10), (2, 19), (3, 37), (4, 73)])
def test_midpoint_has_as_many_groups_as_the_paper(level: int, count: int) -> None:
    ends = 2 * (level - 1)
    assert len(groups(1000, level)) == count + ends
    assert len(groups(1000, level, endpoints=False)) == count


@given(group_size=st.integers(1, 300), more=st.integers(0, 1500), level=st.integers(1, 4))
def test_midpoint_covers_any_capture_evenly(group_size: int, more: int, level: int) -> None:
    n_frames = group_size + more
    found = groups(n_frames, level, group_size)
    assert all(min(4, group_size) <= len(group.span) <= group_size and group.span.stop <= n_frames for group in found)
    assert all(group.reference == group.span.centre for group in found)
    references = [group.reference for group in found]
    assert all(earlier < later for earlier, later in pairwise(references))
    if level > 1 and group_size >= 8:
        assert (found[0].span.start, found[-1].span.stop) == (0, n_frames)
    centred = groups(n_frames, level, group_size, endpoints=False)
    assert all(len(group.span) == group_size for group in centred)
    count = n_frames // group_size
    distance = (n_frames - group_size) / max(1, (count - 1) * 2 ** (level - 1))
    if distance >= 1:
        assert len(centred) == (count - 1) * 2 ** (level - 1) + 1
        assert all(abs(later.reference - earlier.reference - distance) <= 1 for earlier, later in pairwise(centred))
    if count > 1:
        assert (centred[0].span.start, centred[-1].span.stop) == (0, n_frames)


@given(group_size=st.integers(1, 300), count=st.integers(1, 20), rest=st.integers(0, 299))
def test_midpoint_level_1_has_as_many_disjoint_groups_as_fit(group_size: int, count: int, rest: int) -> None:
    found = groups(group_size * count + rest % group_size, 1, group_size)
    assert len(found) == count
    assert all(earlier.span.stop <= later.span.start for earlier, later in pairwise(found))
