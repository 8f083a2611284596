"""Levels of the motion, trajectories with the names of their plugins, and captures with cuts and repeated frames."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from photonpano import FrameSpan, Group, PluginError
from photonpano.contracts.attribution import attributed
from photonpano.execution.context import Context, Quiet
from photonpano.geometry import translation
from photonpano.motion.level import Cut, Level, Timeline
from photonpano.motion.locate import LoopSetting
from photonpano.motion.loop import LevelResult, converges, estimate_motion
from photonpano.residuals.findings import Findings
from photonpano.specs.settings import GraphSettings

N_FRAMES = 120


def groups(*spans: tuple[int, int]) -> tuple[Group, ...]:
    return tuple(Group(span, span.centre) for span in (FrameSpan(*each) for each in spans))


class Notes(Quiet):
    def __init__(self) -> None:
        self.lines: list[str] = []

    def note(self, message: str) -> None:
        self.lines.append(message)


@pytest.fixture(scope="module")
def source(memory_source: type) -> Any:
    return memory_source(np.zeros((N_FRAMES, 40, 60)))


@pytest.fixture
def run(source: Any) -> Callable[..., list]:
    def run(*levels: Level, reference: int = 60, notes: Any = None, timeline: Timeline | None = None, **options: Any) -> list:
        context = Context(threads=2) if notes is None else Context(threads=2, progress=notes)
        setting = LoopSetting(
            source=source,
            graph=GraphSettings(),
            context=context,
            reference=reference,
            timeline=timeline or Timeline.regular(N_FRAMES),
        )
        return estimate_motion(setting, levels, **options)

    return run


@pytest.mark.parametrize("reference", [0, 60, 119])
def test_reference_frame_is_the_identity_at_every_level(run: Callable, make_level: Callable, reference: int) -> None:
    results = run(make_level(), make_level(number=2), reference=reference)
    for result in results:
        np.testing.assert_allclose(result.trajectory.at([reference]), [np.eye(3)], atol=1e-12)
        inside = np.arange(5, 115)
        if 5 <= reference < 115:
            np.testing.assert_allclose(result.trajectory.at(inside)[:, 0, 2], 0.3 * (inside - reference), atol=1e-9)


def test_level_is_merged_along_the_motion_of_the_previous_one(run: Callable, make_level: Callable) -> None:
    merged_along: list[Any] = []
    merge = make_level().merger.merge

    class Watched:
        def merge(self, source: Any, group: Group, trajectory: Any, scale: float) -> Any:
            merged_along.append(trajectory)
            return merge(source, group, trajectory, scale)

    results = run(*(make_level(number=number, merger=Watched()) for number in (1, 2)))
    assert [len(result.groups) for result in results] == [12, 23]
    assert merged_along == [None] * 12 + [results[0].trajectory] * 23


@pytest.mark.parametrize(
    ("sway_px", "change_px"), [(2.0, pytest.approx(2 * 2 / np.pi, rel=0.15)), (0.0, pytest.approx(0, abs=1e-6))]
)
def test_change_is_the_mean_displacement_of_corners_between_levels(
    run: Callable, make_level: Callable, known_motion: type, sway_px: float, change_px: Any
) -> None:
    """The second level adds a sway with four periods, which no change of the reference plane explains."""
    swaying = known_motion(lambda frame: translation(0.3 * frame, sway_px * np.sin(2 * np.pi * frame / 30)))
    first, second = run(make_level(), make_level(swaying, number=2), reference=100)
    assert first.change_px is None
    assert second.change_px == change_px
    assert set(second.seconds) == {"resample", "merge", "locate", "interpolate"}


@pytest.mark.parametrize(("wanted", "levels"), [(True, 2), (False, 4)])
def test_estimate_motion_stops_on_convergence_only_if_asked_and_notes_a_line_for_each_level(
    run: Callable, make_level: Callable, wanted: bool, levels: int
) -> None:
    """Without information, the expected error is about a pixel; the second level changes nothing."""
    notes = Notes()
    results = run(*(make_level(number=number) for number in (1, 2, 3, 4)), notes=notes, until_converged=wanted)
    assert [result.converged for result in results] == [False, *[True] * (levels - 1)]
    assert len(notes.lines) == levels
    assert notes.lines[:2] == [
        "level 1: 12 of 12 exposures located",
        "level 2: 23 of 23 exposures located, the motion changed by 0.00 px",
    ]


@pytest.mark.parametrize(
    ("changes_px", "expected"),
    [((None,), True), ((None, 1.0), True), ((None, 1.0, 0.5), True), ((None, 1.0, 0.9), False), ((None, 0.1), False)],
)
def test_the_motion_converges_while_changes_shrink_and_exceed_their_error(
    changes_px: tuple[float | None, ...], *, expected: bool
) -> None:
    """As with a tremor, whose changes do not shrink; the expected error is 0.2 px."""
    results = [Mock(change_px=each, converged=each is not None and each < 0.2) for each in changes_px]
    assert converges(results) is expected


def raising(error: BaseException) -> Callable[..., Any]:
    def fail(*_: Any) -> Any:
        raise error

    return fail


@pytest.mark.parametrize(
    ("answer", "problem"),
    [
        (raising(KeyError("knot")), "failed at level 2: KeyError: 'knot'"),
        (
            lambda _: np.eye(3),
            "broke its contract at level 2: the result of at() must be (2, 3, 3) of float64, got (3, 3) of float64",
        ),
        (
            lambda _: [np.eye(3), np.diag([1.0, 1.0, 0.0])],
            "broke its contract at level 2: a homography is finite with h33 = 1, that of frame 7.5 is "
            "[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]]",
        ),
    ],
    ids=["raises", "shape", "h33"],
)
def test_attributed_trajectory_names_interpolator_on_exception_or_broken_contract(
    answer: Callable[..., Any], problem: str
) -> None:
    class Odd:
        at = staticmethod(answer)

    with pytest.raises(PluginError) as caught:
        attributed(Odd(), "interpolator 'toy' of toys 1.0", "level 2").at([3, 7.5])
    assert str(caught.value) == f"interpolator 'toy' of toys 1.0 {problem}"


REGULAR = Timeline.regular(N_FRAMES)


def cut_at(frame: int, dark: FrameSpan | None = None) -> Cut:
    return Cut(frame, np.array([7.0, 0.0]), 20.0, dark)


def repeating(*frames: int) -> Timeline:
    return Timeline.with_repeats(np.isin(np.arange(N_FRAMES), frames))


def jumping(frame: float) -> float:
    return 0.3 * frame + 7 * (frame >= 49.5)


@pytest.fixture
def estimated(run: Callable, make_level: Callable, known_motion: type) -> Callable[..., LevelResult]:
    """Run two levels on a motion along x, in px by frame; return the last."""

    def estimated(x_px: Callable[[float], float], timeline: Timeline) -> LevelResult:
        motion = known_motion(lambda frame: translation(x_px(frame), 0))
        return run(*(make_level(motion, number=number) for number in (1, 2)), timeline=timeline)[-1]

    return estimated


@pytest.mark.parametrize(
    ("timeline", "given", "expected"),
    [
        (REGULAR, [(0, 40), (20, 60), (80, 120)], [(0, 40), (20, 60), (80, 120)]),
        # The second part of the third group is short.
        (
            REGULAR.cut_at([cut_at(50)]),
            [(0, 40), (20, 60), (48, 88), (80, 120)],
            [(0, 40), (20, 50), (50, 60), (50, 88), (80, 120)],
        ),
        (REGULAR.cut_at([cut_at(50, FrameSpan(45, 56))]), [(30, 70)], [(30, 45), (56, 70)]),
        (replace(REGULAR, dark=(FrameSpan(45, 90),)), [(30, 70), (50, 80)], [(30, 45)]),
        (REGULAR.in_shots([FrameSpan(0, 50), FrameSpan(50, 120)]), [(0, 40), (20, 60), (80, 120)], [(50, 60), (80, 120)]),
        (repeating(*range(31, 90)), [(0, 30), (30, 60), (50, 80), (90, 120)], [(0, 30), (90, 120)]),
    ],
    ids=["regular", "cut", "jump in the dark", "dark frames", "shots", "repeated frames"],
)
def test_groups_are_divided_at_cuts_and_leave_out_dark_and_repeated_frames_and_other_shots(
    timeline: Timeline, given: list[tuple[int, int]], expected: list[tuple[int, int]]
) -> None:
    assert timeline.parts(list(groups(*given))) == groups(*expected)


def test_trajectory_jumps_at_cut_and_is_exact_beside_it(estimated: Callable[..., LevelResult]) -> None:
    result = estimated(jumping, REGULAR.cut_at([cut_at(50)]))
    # Between the outermost knots of each piece.
    frames = np.r_[5:45, 55:115]
    expected = [jumping(frame) - jumping(60) for frame in frames]
    np.testing.assert_allclose(result.trajectory.at(frames)[:, 0, 2], expected, atol=1e-9)
    assert not any(group.span.start < 50 < group.span.stop for group in result.groups)


def test_expected_error_grows_towards_cut_and_covers_jump_in_the_dark(estimated: Callable[..., LevelResult]) -> None:
    whole = estimated(lambda frame: 0.3 * frame, REGULAR).uncertainty
    cut = estimated(jumping, REGULAR.cut_at([cut_at(50)])).uncertainty
    dark = estimated(jumping, REGULAR.cut_at([cut_at(50, FrameSpan(46, 54))])).uncertainty
    assert cut.at([49])[0] > whole.at([49])[0]
    np.testing.assert_array_equal(dark.at(np.arange(46, 54)) >= 7, True)
    assert dark.at([45, 54]).max() < 2


def test_pieces_end_in_long_darkness_and_other_shots_are_not_shown() -> None:
    timeline = replace(REGULAR, dark=(FrameSpan(0, 10), FrameSpan(40, 73))).in_shots([FrameSpan(0, 90), FrameSpan(90, 120)])
    np.testing.assert_array_equal(timeline.piece_of([5, 56, 57, 100]), [0, 1, 1, 1])
    np.testing.assert_array_equal(np.flatnonzero(timeline.shown), [*range(10, 40), *range(73, 90)])
    assert [(each.what, each.value) for each in Findings().along(timeline).of_frames] == [
        ("shots", "frames 0 to 89 and frames 90 to 119"),
        ("dark_frames", "frames 0 to 9"),
        ("dark_frames", "frames 40 to 72"),
    ]
