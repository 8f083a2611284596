"""Groups of the resamplers: those of midpoint are the measure of the others; and the size that is chosen for a capture."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from photonpano import CaptureSummary, FrameSpan, Group, InputError, StageContext, StreamInfo
from photonpano_core.configs import MidpointConfig
from photonpano_core.hooks import photonpano_resamplers
from photonpano_core.resamplers import MidpointResampler, choose_group_size, whole_periods

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


@pytest.mark.parametrize(("level", "count"), [(1, 10), (2, 19), (3, 37), (4, 73)])
def test_midpoint_has_as_many_groups_as_the_paper(level: int, count: int) -> None:
    ends = 2 * (level - 1)
    assert len(midpoint(1000, level)) == count + ends
    assert len(midpoint(1000, level, endpoints=False)) == count


@pytest.mark.parametrize("level", [1, 2, 5])
@pytest.mark.parametrize("n_frames", [100, 160, 460, 1000])
def test_constant_groups_equal_midpoint_level_1_at_every_level(n_frames: int, level: int) -> None:
    assert groups("constant-groups", n_frames, level) == midpoint(n_frames, 1)


def test_sliding_window_steps_by_step_frames_or_slightly_less() -> None:
    assert starts(groups("sliding-window", 400, step_frames=100)) == [0, 100, 200, 300]
    assert starts(groups("sliding-window", 430, step_frames=100)) == [0, 82, 165, 248, 330]
    assert starts(groups("sliding-window", 105, step_frames=1)) == [0, 1, 2, 3, 4, 5]


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


def test_stratified_depends_on_seed_and_level_only() -> None:
    assert groups("stratified", 4000, 2, seed=1) == groups("stratified", 4000, 2, seed=1)
    assert groups("stratified", 4000, 2, seed=1) != groups("stratified", 4000, 2, seed=2)
    # Other chance at another level, and not the same places again.
    first, second = starts(groups("stratified", 4000, 1)), starts(groups("stratified", 4000, 2, endpoints=False))
    assert len({*first[1:-1]} & {*second[2:-2:2]}) < 10


HOW = "the second fastest of 12 places, from sums of 64 frames"


def choice(
    flux: float,
    speed_px: float | None,
    n_frames: int = 10_000,
    how: str = HOW,
    shortest: int = 16,
    away_frames: float | None = None,
) -> tuple[int, str]:
    return choose_group_size(CaptureSummary(flux, speed_px, how, away_frames=away_frames), n_frames, 254, shortest)


def built(stream: StreamInfo, name: str = "midpoint", **context: Any) -> Any:
    (contribution,) = (each for each in photonpano_resamplers() if each.name == name)
    return contribution.build(contribution.config(group_size="auto"), StageContext(stream, response=None, **context))


SPEED = f"px per frame ({HOW}) groups of"
SIDE = "of the shorter side of a frame, and at a flux of"
NO_SPEED = "no motion was found at any of 12 places"


@pytest.mark.parametrize(
    ("capture", "size", "reason"),
    [
        ((0.5, 0.15), 254, f"at 0.15 {SPEED} 254 frames are blurred by 38.1 px, 0.15 {SIDE} 0.5 hold 127 photons per pixel"),
        ((0.02, 0.3), 150, "hold 3 photons per pixel, so few that more blur is allowed"),
        ((0.001, 0.3), 254, "so few that more blur is allowed"),
        ((0.5, 0.0), 625, "; of longer groups there would be fewer than 16"),
        ((0.5, 0.001), 625, "; of longer groups there would be fewer than 16"),
        (
            (0.5, 10.0),
            16,
            f"{SPEED} 16 frames are blurred by 160 px, 0.63 {SIDE} 0.5 hold 8 photons per pixel; shorter groups would be "
            "mostly noise",
        ),
        (
            (2000, 0.5, 10_000, HOW, 1),
            20,
            "hold 4e+04 photons per pixel, enough to shorten groups for less blur",
        ),  # 0.04 of 254
        ((25, 0.5, 10_000, HOW, 1), 40, ", enough to shorten groups for less blur"),  # 1000 photons
        ((0.5, 0.07), 544, "photons per pixel"),  # which are too few
        ((0.01, None, 10_000, NO_SPEED), 500, f"{NO_SPEED}, so 500 frames are assumed"),
        ((0.01, None, 2000, NO_SPEED), 125, "so 500 frames are assumed; of longer groups there would be fewer than 16"),
        ((0.5, 0.15, 10_000, HOW, 16, 600.0), 254, "hold 127 photons per pixel"),
        (
            (1e-4, 0.003, 5919, HOW, 16, 116.3),
            58,
            "; in longer ones the motion averages away, since the image is farthest after 116 frames and returns",
        ),
        ((0.01, None, 10_000, NO_SPEED, 16, 300.0), 150, "the image is farthest after 300 frames and returns"),
        ((0.5, 0.001, 10_000, HOW, 16, 20.0), 16, "the image is farthest after 20 frames and returns"),
        # At 500 frames per second the image may move by tens of px per frame.
        ((20, 10.0, 10_000, HOW, 1), 4, "photons per pixel"),
        (
            (2000, 100.0, 10_000, HOW, 1),
            1,
            f"at 1e+02 {SPEED} 1 frame are blurred by 100 px, 0.39 {SIDE} 2e+03 hold 2e+03 photons per pixel",
        ),
    ],
)
def test_group_size_weighs_light_against_motion_blur(capture: tuple[Any, ...], size: int, reason: str) -> None:
    found, why = choice(*capture)
    assert found == size
    assert why.endswith(reason), why


def test_auto_resampler_chooses_and_records_size_once() -> None:
    measured, decided = [], []

    def capture() -> CaptureSummary:
        measured.append(1)
        return CaptureSummary(0.5, 0.381, HOW)

    resampler = built(StreamInfo(2000, 254, 496, None), capture=capture, decide=lambda *what: decided.append(what))
    assert not measured
    fixed = MidpointResampler(MidpointConfig(group_size=100))
    assert [resampler.groups(2000, level) for level in (1, 2, 3)] == [fixed.groups(2000, level) for level in (1, 2, 3)]
    assert measured == [1]
    assert [what[:2] for what in decided] == [("group_size", 100)]


def test_auto_resampler_doubles_groups_of_dim_capture_from_level_3() -> None:
    decided: list[tuple] = []
    resampler = built(
        StreamInfo(2000, 254, 496, None),
        capture=lambda: CaptureSummary(0.05, 0.381, HOW),
        decide=lambda *what: decided.append(what),
    )
    short, long = (MidpointResampler(MidpointConfig(group_size=size)) for size in (100, 200))
    assert [resampler.groups(2000, level) for level in (1, 2)] == [short.groups(2000, level) for level in (1, 2)]
    # As dense as the short ones would be.
    assert resampler.groups(2000, 3) == long.groups(2000, 4)
    assert decided[0][:2] == ("group_size", 100)
    assert decided[0][2].endswith("; from level 3 on, where the motion is known, groups are twice as long for more light")


@pytest.mark.parametrize(
    ("size", "period", "n_frames", "expected"),
    [
        (150, None, 3000, 150),
        (150, 200.0, 3000, 200),
        (210, 200.0, 3000, 200),
        (250, 200.0, 4000, 400),
        (50, 33.4, 3000, 67),
        (150, 200.0, 1500, 150),
        (3, 50.0, 3000, 3),
        (30, 50.0, 3000, 50),
    ],
)
def test_groups_are_lengthened_to_whole_periods(size: int, period: float | None, n_frames: int, expected: int) -> None:
    assert whole_periods(size, period, n_frames) == expected
