from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from photonpano import FrameSpan, Group, InputError, PluginError
from photonpano.context import Context, Quiet
from photonpano.geometry import from_parameters, inverse, normalised, translation
from photonpano.motion.level import Level
from photonpano.motion.loop import ReferencedTrajectory, estimate_motion
from photonpano.specs.settings import GraphSettings

N_FRAMES = 120


@pytest.fixture(scope="module")
def source(memory_source: type) -> Any:
    return memory_source(np.zeros((N_FRAMES, 40, 60)))


@pytest.fixture
def run(source: Any) -> Callable[..., list]:
    def run(*levels: Level, reference: int = 60) -> list:
        return estimate_motion(source, levels, GraphSettings(), reference, Context(2))

    return run


@pytest.mark.parametrize("reference", [0, 60, 119])
def test_reference_frame_is_the_identity_at_every_level(
    run: Callable, make_level: Callable, pan: Callable, reference: int
) -> None:
    results = run(make_level(pan(0.3)), make_level(pan(0.3), number=2), reference=reference)
    for result in results:
        np.testing.assert_allclose(result.trajectory.at([reference]), [np.eye(3)], atol=1e-12)
        inside = np.arange(5, 115)
        if 5 <= reference < 115:
            np.testing.assert_allclose(result.trajectory.at(inside)[:, 0, 2], 0.3 * (inside - reference), atol=1e-9)


def test_level_is_merged_along_the_motion_of_the_previous_one(run: Callable, make_level: Callable, pan: Callable) -> None:
    merged_along: list[Any] = []
    level = make_level(pan(0.3))
    merge = level.merger.merge

    class Watched:
        def merge(self, source: Any, group: Group, trajectory: Any, scale: float) -> Any:
            merged_along.append(trajectory)
            return merge(source, group, trajectory, scale)

    levels = [make_level(pan(0.3), number=number, merger=Watched()) for number in (1, 2)]
    results = run(*levels)
    assert [len(result.groups) for result in results] == [12, 23]
    assert merged_along == [None] * 12 + [results[0].trajectory] * 23


def test_change_is_the_mean_displacement_of_corners_between_levels(
    run: Callable, make_level: Callable, known_motion: type
) -> None:
    """The second level adds a sway of 2 px with four periods, which no change of the reference plane explains."""

    def swaying(by_px: float) -> Any:
        return known_motion(lambda frame: translation(0.3 * frame, by_px * np.sin(2 * np.pi * frame / 30)))

    first, second = run(make_level(swaying(0.0)), make_level(swaying(2.0), number=2))
    assert first.change_px is None
    assert second.change_px == pytest.approx(2 * 2 / np.pi, rel=0.15)
    assert set(second.seconds) == {"resample", "merge", "locate", "interpolate"}


def test_change_is_0_if_a_level_finds_the_same_motion(run: Callable, make_level: Callable, pan: Callable) -> None:
    _, second = run(make_level(pan(0.3)), make_level(pan(0.3), number=2), reference=100)
    assert second.change_px == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(("wanted", "levels"), [(True, 2), (False, 4)])
def test_estimate_motion_stops_on_convergence_only_if_asked(
    source: Any, make_level: Callable, pan: Callable, wanted: bool, levels: int
) -> None:
    """Without information, the expected error is about a pixel; the second level changes nothing."""
    chosen = [make_level(pan(0.3), number=number) for number in (1, 2, 3, 4)]
    results = estimate_motion(source, chosen, GraphSettings(), 60, Context(2), until_converged=wanted)
    assert len(results) == levels
    assert [result.converged for result in results] == [False, *[True] * (levels - 1)]


def test_estimate_motion_notes_a_line_for_each_level(source: Any, make_level: Callable, pan: Callable) -> None:
    class Notes(Quiet):
        def __init__(self) -> None:
            self.lines: list[str] = []

        def note(self, message: str) -> None:
            self.lines.append(message)

    notes = Notes()
    levels = [make_level(pan(0.3)), make_level(pan(0.3), number=2)]
    estimate_motion(source, levels, GraphSettings(), 60, Context(2, notes))
    assert notes.lines == [
        "level 1: 12 of 12 exposures located",
        "level 2: 23 of 23 exposures located, the motion changed by 0.00 px",
    ]


def component(level: Level, kind: str) -> Any:
    return level.locators[0].component if kind == "locator" else getattr(level, kind)


def raising(error: BaseException) -> Callable[..., Any]:
    def fail(*_: Any) -> Any:
        raise error

    return fail


CALLS = [
    ("resampler", "groups"),
    ("merger", "merge"),
    ("locator", "describe"),
    ("locator", "register"),
    ("interpolator", "fit"),
]


@pytest.mark.parametrize(("kind", "method"), CALLS)
def test_component_that_raises_is_named(run: Callable, make_level: Callable, pan: Callable, kind: str, method: str) -> None:
    second = make_level(pan(0.3), number=2)
    setattr(component(second, kind), method, raising(ZeroDivisionError("by nothing")))
    with pytest.raises(PluginError) as caught:
        run(make_level(pan(0.3)), second)
    assert str(caught.value) == f"{kind} 'toy' of toys 1.0 failed at level 2: ZeroDivisionError: by nothing"
    assert isinstance(caught.value.__cause__, ZeroDivisionError)


@pytest.mark.parametrize(("kind", "method"), CALLS)
def test_errors_written_for_users_pass_unchanged(
    run: Callable, make_level: Callable, pan: Callable, kind: str, method: str
) -> None:
    error = InputError("said for users")
    level = make_level(pan(0.3))
    setattr(component(level, kind), method, raising(error))
    with pytest.raises(type(error)) as caught:
        run(level)
    assert caught.value is error


def spans(*starts: int) -> Iterator[Group]:
    for start in starts:
        yield Group(FrameSpan(start, start + 10), start)


@pytest.mark.parametrize(
    ("groups", "instants"), [((), "[]"), (tuple(spans(0, 50, 20)), "[0, 50, 20]"), (tuple(spans(0, 0)), "[0, 0]")]
)
def test_resample_refuses_groups_out_of_order(
    run: Callable, make_level: Callable, pan: Callable, groups: tuple[Group, ...], instants: str
) -> None:
    class Chaos:
        def groups(self, n_frames: int, level: int) -> tuple[Group, ...]:
            return groups

    with pytest.raises(PluginError) as caught:
        run(make_level(pan(0.3), resampler=Chaos()))
    assert str(caught.value) == (
        "resampler 'toy' of toys 1.0 broke its contract at level 1: "
        f"expected at least one group, in order, each instant once; got the instants {instants}"
    )


def test_resample_refuses_groups_beyond_the_capture(run: Callable, make_level: Callable, pan: Callable) -> None:
    class Greedy:
        def groups(self, n_frames: int, level: int) -> tuple[Group, ...]:
            return tuple(spans(0, n_frames - 5))

    with pytest.raises(PluginError) as caught:
        run(make_level(pan(0.3), resampler=Greedy()))
    assert str(caught.value) == (
        "resampler 'toy' of toys 1.0 broke its contract at level 1: "
        "the capture has 120 frames (0 to 119), got a group of frames 115 to 124"
    )


def test_single_group_is_one_located_instant(run: Callable, make_level: Callable, pan: Callable) -> None:
    class Whole:
        def groups(self, n_frames: int, level: int) -> tuple[Group, ...]:
            return (Group(FrameSpan(0, n_frames), 59.5),)

    (result,) = run(make_level(pan(0.3), resampler=Whole()))
    assert (result.located.n_located, result.located.edges) == (1, ())
    np.testing.assert_array_equal(result.trajectory.at([0, 119]), [np.eye(3)] * 2)


def test_referenced_trajectory_is_the_identity_at_the_reference(pan: Callable) -> None:
    trajectory = ReferencedTrajectory(pan(0.5), 40)
    np.testing.assert_allclose(trajectory.at([40, 50, 20.5]), [np.eye(3), translation(5, 0), translation(-9.75, 0)])


def test_referenced_trajectory_keeps_pairwise_motions(known_motion: type) -> None:
    """A camera that zooms while it pans: these maps do not commute."""
    zoom, speed = np.array([1e-3, -2e-4, 3e-4, 1e-3, 0, 0, 1e-6, 2e-6]), np.array([0.3, -0.1])
    free = known_motion(lambda frame: translation(*speed * frame) @ from_parameters(zoom * frame))
    pairs = []
    for reference in (0, 25, 100):
        first, second = ReferencedTrajectory(free, reference).at([20, 70])
        pairs.append(normalised(inverse(first) @ second))
        np.testing.assert_allclose(ReferencedTrajectory(free, reference).at([reference]), [np.eye(3)], atol=1e-12)
    np.testing.assert_allclose(pairs[1:], [pairs[0]] * 2, atol=1e-9)
