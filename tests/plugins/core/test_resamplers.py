"""Checks that all resamplers share, and the groups of those other than midpoint."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from photonpano import FrameSpan, Group, InputError, StageContext, StreamInfo
from photonpano_core.configs import MidpointConfig
from photonpano_core.hooks import photonpano_resamplers
from photonpano_core.resamplers import MidpointResampler

NAMES = ("constant-groups", "sliding-window", "stratified")
CONTRIBUTIONS = {each.name: each for each in photonpano_resamplers()}


def groups(name: str, n_frames: int, level: int = 1, group_size: int = 100, seed: int = 0, **config: Any) -> tuple[Group, ...]:
    contribution = CONTRIBUTIONS[name]
    context = StageContext(StreamInfo(n_frames, 8, 8, None), response=None, seed=seed)
    built = contribution.build(contribution.config(group_size=group_size, **config), context)
    return tuple(built.groups(n_frames, level))


def starts(found: tuple[Group, ...]) -> list[int]:
    return [group.span.start for group in found]


def midpoint(n_frames: int, level: int, group_size: int = 100, **config: bool) -> tuple[Group, ...]:
    return MidpointResampler(MidpointConfig(group_size=group_size, **config)).groups(n_frames, level)


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


@pytest.mark.parametrize("name", ["midpoint", *NAMES])
def test_resamplers_refuse_capture_shorter_than_a_group(name: str) -> None:
    with pytest.raises(InputError) as caught:
        groups(name, 99)
    assert str(caught.value) == TOO_SHORT
    contribution = CONTRIBUTIONS[name]
    assert contribution.check(contribution.config(group_size=100), StreamInfo(99, 8, 8, None)) == [TOO_SHORT]
    assert contribution.check(contribution.config(group_size=100), StreamInfo(100, 8, 8, None)) == []


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
