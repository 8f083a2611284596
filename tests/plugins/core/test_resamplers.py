"""Groups of the resamplers: those of midpoint are the measure of the others."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from photonpano import FrameSpan, Group, InputError, StageContext, StreamInfo
from photonpano_core.hooks import photonpano_resamplers

NAMES = ("midpoint", "constant-groups", "sliding-window", "stratified")
CONTRIBUTIONS = {each.name: each for each in photonpano_resamplers()}


def groups(name: str, n_frames: int, level: int = 1, group_size: int = 100, seed: int = 0, **config: Any) -> tuple[Group, ...]:
    contribution = CONTRIBUTIONS[name]
    context = StageContext(StreamInfo(n_frames, 8, 8, None), response=None, seed=seed)
    built = contribution.build(contribution.config(group_size=group_size, **config), context)
    return tuple(built.groups(n_frames, level))


def midpoint(n_frames: int, level: int, group_size: int = 100, **config: bool) -> tuple[Group, ...]:
    return groups("midpoint", n_frames, level, group_size, **config)


def starts(found: tuple[Group, ...]) -> list[int]:
    return [group.span.start for group in found]


def spans(*starts: int, size: int = 100) -> list[FrameSpan]:
    return [FrameSpan(start, start + size) for start in starts]


@pytest.mark.parametrize("name", NAMES)
@given(group_size=st.integers(1, 300), more=st.integers(0, 1500), level=st.integers(1, 4))
def test_resamplers_cover_any_capture_in_order(name: str, group_size: int, more: int, level: int) -> None:
    n_frames = group_size + more
    found = groups(name, n_frames, level, group_size)
    assert all(group.span.stop <= n_frames and group.reference == group.span.centre for group in found)
    assert all(earlier.reference < later.reference for earlier, later in pairwise(found))
    if n_frames >= 2 * group_size:
        assert (found[0].span.start, found[-1].span.stop) == (0, n_frames)


TOO_SHORT = (
    "the capture has 99 frames, fewer than one group of 100; set group_size to 24 or less, so that at least four groups fit"
)


@pytest.mark.parametrize("name", NAMES)
def test_resamplers_refuse_capture_shorter_than_a_group(name: str) -> None:
    with pytest.raises(InputError) as caught:
        groups(name, 99)
    assert str(caught.value) == TOO_SHORT
    contribution = CONTRIBUTIONS[name]
    assert contribution.check(contribution.config(group_size=100), StreamInfo(99, 8, 8, None)) == [TOO_SHORT]
    assert contribution.check(contribution.config(group_size=100), StreamInfo(100, 8, 8, None)) == []


@pytest.mark.parametrize(
    ("n_frames", "level", "found"),
    [
        (400, 1, spans(0, 100, 200, 300)),
        (400, 2, [FrameSpan(0, 50), *spans(0, 50, 100, 150, 200, 250, 300), FrameSpan(350, 400)]),
        (460, 1, spans(0, 120, 240, 360)),  # spare frames are left out between groups
        (160, 1, spans(30)),
        (160, 2, [FrameSpan(0, 50), *spans(30), FrameSpan(110, 160)]),
    ],
)
def test_midpoint_adds_group_between_every_two_and_shorter_ones_at_ends(
    n_frames: int, level: int, found: list[FrameSpan]
) -> None:
    assert midpoint(n_frames, level) == tuple(Group(span, (span.start + span.stop - 1) / 2) for span in found)


def test_midpoint_end_groups_get_shorter_down_to_four_frames() -> None:
    ends = midpoint(400, 3)
    assert [group.span for group in ends[:2]] == [FrameSpan(0, 25), FrameSpan(0, 50)]
    assert [group.span for group in ends[-2:]] == [FrameSpan(350, 400), FrameSpan(375, 400)]
    assert min(len(group.span) for group in midpoint(400, 9)) == 6


@pytest.mark.parametrize(("level", "count"), [(1, 10), (2, 19), (3, 37), (4, 73)])
def test_midpoint_has_as_many_groups_as_the_paper(level: int, count: int) -> None:
    ends = 2 * (level - 1)
    assert len(midpoint(1000, level)) == count + ends
    assert len(midpoint(1000, level, endpoints=False)) == count


@given(group_size=st.integers(1, 300), more=st.integers(0, 1500), level=st.integers(1, 4))
def test_midpoint_covers_any_capture_evenly(group_size: int, more: int, level: int) -> None:
    n_frames = group_size + more
    found = midpoint(n_frames, level, group_size)
    assert all(min(4, group_size) <= len(group.span) <= group_size and group.span.stop <= n_frames for group in found)
    assert all(group.reference == group.span.centre for group in found)
    references = [group.reference for group in found]
    assert all(earlier < later for earlier, later in pairwise(references))
    if level > 1 and group_size >= 8:
        assert (found[0].span.start, found[-1].span.stop) == (0, n_frames)
    centred = midpoint(n_frames, level, group_size, endpoints=False)
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
    found = midpoint(group_size * count + rest % group_size, 1, group_size)
    assert len(found) == count
    assert all(earlier.span.stop <= later.span.start for earlier, later in pairwise(found))


@pytest.mark.parametrize("level", [1, 2, 5])
@pytest.mark.parametrize("n_frames", [100, 160, 460, 1000])
def test_constant_groups_equal_midpoint_level_1_at_every_level(n_frames: int, level: int) -> None:
    assert groups("constant-groups", n_frames, level) == midpoint(n_frames, 1)


def test_sliding_window_steps_by_half_a_group_by_default() -> None:
    assert starts(groups("sliding-window", 400)) == [0, 50, 100, 150, 200, 250, 300]
    assert groups("sliding-window", 400, 3) == groups("sliding-window", 400, 1)


def test_sliding_window_steps_by_step_frames_or_slightly_less() -> None:
    assert starts(groups("sliding-window", 400, step_frames=100)) == [0, 100, 200, 300]
    assert starts(groups("sliding-window", 430, step_frames=100)) == [0, 82, 165, 248, 330]
    assert starts(groups("sliding-window", 105, step_frames=1)) == [0, 1, 2, 3, 4, 5]


def test_sliding_window_step_shrink_adds_groups_per_level() -> None:
    """With half the step at each level, they equal those of midpoint without its ends."""
    for level in (1, 2, 3, 4):
        found = groups("sliding-window", 1000, level, step_frames=100, step_shrink=2)
        assert found == midpoint(1000, level, endpoints=False)
    assert starts(groups("sliding-window", 110, 9, step_frames=100, step_shrink=4)) == list(range(11))


@pytest.mark.parametrize("level", [1, 2, 3])
def test_stratified_puts_one_group_in_each_stratum(level: int) -> None:
    found = groups("stratified", 4000, level)
    even = midpoint(4000, level)
    assert len(found) == len(even)
    half = 50 / 2 ** (level - 1)
    offsets = [one.reference - other.reference for one, other in zip(found, even, strict=True)]
    assert max(abs(offset) for offset in offsets) <= half + 1
    assert max(offsets) > 0.7 * half
    assert min(offsets) < -0.7 * half
    assert [len(group.span) for group in found] == [len(group.span) for group in even]


def test_stratified_starts_and_ends_with_the_capture() -> None:
    assert [group.span for group in groups("stratified", 4000)[::39]] == [FrameSpan(0, 100), FrameSpan(3900, 4000)]


def test_stratified_depends_on_seed_and_level_only() -> None:
    assert groups("stratified", 4000, 2, seed=1) == groups("stratified", 4000, 2, seed=1)
    assert groups("stratified", 4000, 2, seed=1) != groups("stratified", 4000, 2, seed=2)
    # Other chance at another level, and not the same places again.
    first, second = starts(groups("stratified", 4000, 1)), starts(groups("stratified", 4000, 2, endpoints=False))
    assert len({*first[1:-1]} & {*second[2:-2:2]}) < 10


@pytest.mark.parametrize("level", [1, 2, 3])
def test_stratified_without_jitter_equals_midpoint(level: int) -> None:
    for n_frames in (100, 160, 460, 1000):
        assert groups("stratified", n_frames, level, jitter=0) == midpoint(n_frames, level)


def test_stratified_has_one_group_per_stratum_of_one_frame() -> None:
    assert starts(groups("stratified", 104, 4, group_size=2, endpoints=False)) == list(range(103))
