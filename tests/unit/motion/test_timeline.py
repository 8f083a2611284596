"""Cuts and repeated frames: groups are divided, each piece is interpolated by itself, and repeated frames do not move."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from photonpano import FrameSpan, Group
from photonpano.context import Context
from photonpano.geometry import translation
from photonpano.motion.loop import LevelResult, estimate_motion
from photonpano.motion.timeline import Cut, Timeline
from photonpano.specs.settings import GraphSettings

N_FRAMES = 120


def groups(*spans: tuple[int, int]) -> list[Group]:
    return [Group(span, span.centre) for span in (FrameSpan(*each) for each in spans)]


def cut_at(frame: int, dark: FrameSpan | None = None) -> Cut:
    return Cut(frame, np.array([7.0, 0.0]), 20.0, dark)


def repeating(*frames: int) -> Timeline:
    return Timeline.with_repeats(np.isin(np.arange(N_FRAMES), frames))


@pytest.fixture
def estimated(memory_source: type, make_level: Callable, known_motion: type) -> Callable[..., LevelResult]:
    """Run two levels on a motion along x, in px by frame; return the last."""

    def estimated(x_px: Callable[[float], float], timeline: Timeline) -> LevelResult:
        source, motion = memory_source(np.zeros((N_FRAMES, 40, 60))), known_motion(lambda frame: translation(x_px(frame), 0))
        levels: list[Any] = [make_level(motion, number=number) for number in (1, 2)]
        return estimate_motion(source, levels, GraphSettings(), 60, Context(2), timeline=timeline)[-1]

    return estimated


def test_groups_of_regular_capture_stay_as_they_are() -> None:
    given = groups((0, 40), (20, 60), (80, 120))
    assert Timeline.regular(N_FRAMES).parts(given) == tuple(given)


def test_groups_are_divided_at_cut_and_short_parts_left_out() -> None:
    parts = Timeline.regular(N_FRAMES).cut_at([cut_at(50)]).parts(groups((0, 40), (20, 60), (48, 88), (80, 120)))
    assert [part.span for part in parts] == [
        FrameSpan(0, 40),
        FrameSpan(20, 50),
        FrameSpan(50, 60),
        FrameSpan(50, 88),
        FrameSpan(80, 120),
    ]
    assert [part.reference for part in parts] == [19.5, 34.5, 54.5, 68.5, 99.5]


def test_groups_leave_out_dark_frames_of_cut() -> None:
    parts = Timeline.regular(N_FRAMES).cut_at([cut_at(50, FrameSpan(45, 56))]).parts(groups((30, 70)))
    assert [part.span for part in parts] == [FrameSpan(30, 45), FrameSpan(56, 70)]


def test_groups_of_repeated_frames_are_left_out() -> None:
    parts = repeating(*range(31, 90)).parts(groups((0, 30), (30, 60), (50, 80), (90, 120)))
    assert [part.span for part in parts] == [FrameSpan(0, 30), FrameSpan(90, 120)]


def test_trajectory_jumps_at_cut_and_is_exact_beside_it(estimated: Callable[..., LevelResult]) -> None:
    def x_px(frame: float) -> float:
        return 0.3 * frame + 7 * (frame >= 49.5)

    result = estimated(x_px, Timeline.regular(N_FRAMES).cut_at([cut_at(50)]))
    # Between the outermost knots of each piece.
    frames = np.r_[5:45, 55:115]
    expected = [x_px(frame) - x_px(60) for frame in frames]
    np.testing.assert_allclose(result.trajectory.at(frames)[:, 0, 2], expected, atol=1e-9)
    assert not any(group.span.start < 50 < group.span.stop for group in result.groups)


def test_shift_of_cut_is_that_of_trajectory_beyond_its_motion(known_motion: type) -> None:
    moved = known_motion(lambda frame: translation(0.3 * frame + 7 * (frame >= 49.5), -2 * (frame >= 49.5)))
    np.testing.assert_allclose(cut_at(50).along(moved, (40, 60)).shift_px, [-7, 2], atol=1e-9)


def test_repeated_frames_stand_still(estimated: Callable[..., LevelResult]) -> None:
    """Every fifth frame is sent twice: the camera moves by 0.3 px in each of the others."""
    timeline = repeating(*range(5, N_FRAMES, 6))
    result = estimated(lambda frame: 0.3 * float(timeline.times(frame)), timeline)
    steps = np.diff(result.trajectory.at(np.arange(10, 110))[:, 0, 2])
    expected = np.where(np.arange(11, 110) % 6 == 5, 0, 0.3)
    np.testing.assert_allclose(steps, expected, atol=1e-9)


def test_expected_error_grows_towards_cut_and_covers_jump_in_the_dark(estimated: Callable[..., LevelResult]) -> None:
    def x_px(frame: float) -> float:
        return 0.3 * frame + 7 * (frame >= 49.5)

    whole = estimated(lambda frame: 0.3 * frame, Timeline.regular(N_FRAMES)).uncertainty
    cut = estimated(x_px, Timeline.regular(N_FRAMES).cut_at([cut_at(50)])).uncertainty
    dark = estimated(x_px, Timeline.regular(N_FRAMES).cut_at([cut_at(50, FrameSpan(46, 54))])).uncertainty
    assert cut.at([49])[0] > whole.at([49])[0]
    np.testing.assert_array_equal(dark.at(np.arange(46, 54)) >= 7, True)
    assert dark.at([45, 54]).max() < 2


def test_decisions_name_cuts_jumps_in_the_dark_and_repeated_frames() -> None:
    timeline = repeating(7, 8).cut_at([cut_at(50), cut_at(80, FrameSpan(75, 85))])
    assert [(each.what, each.value, each.reason) for each in timeline.decisions] == [
        ("repeated_frames", 2, "copies of the frame before; the motion stands still there"),
        (
            "cut",
            50,
            "the image jumps by 7 px (20 standard deviations) from the frame before to this one, as where frames are missing "
            "or doubled; the interpolation is cut there",
        ),
        (
            "jump_in_the_dark",
            "frames 75 to 84",
            "the image jumps by 7 px (20 standard deviations) while they show nothing; the interpolation is cut in the middle, "
            "at frame 80",
        ),
    ]
