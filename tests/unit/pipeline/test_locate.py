from __future__ import annotations

import gc
import time
import weakref
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from photonpano import FrameSpan, Group, Located, LocationError, NotLocated, PluginError
from photonpano.geometry import corners, from_parameters, inverse, jacobian, normalised, rescaled, translation
from photonpano.pipeline.locate import locate
from photonpano.pipeline.merge import VirtualExposures
from photonpano.pipeline.progress import Quiet
from photonpano.pipeline.registration import BRIDGE, broken_promise
from photonpano.pipeline.stopwatch import Stopwatch
from photonpano.spec.settings import GraphSettings

if TYPE_CHECKING:
    from collections.abc import Callable

    from photonpano import Trajectory
    from photonpano.pipeline.components import Level
    from photonpano.pipeline.locate import LocatedLevel

pytestmark = pytest.mark.usefixtures("one_thread")

SHAPE = (40, 60)
N_FRAMES = 120
CHAIN = GraphSettings(skips=())


@pytest.fixture(scope="module")
def source(memory_source: type) -> Any:
    return memory_source(np.zeros((N_FRAMES, *SHAPE)))


@pytest.fixture
def run(source: Any) -> Callable[..., LocatedLevel]:
    def run(level: Level, known: Trajectory | None = None, graph: GraphSettings = CHAIN, threads: int = 2) -> LocatedLevel:
        groups = level.resampler.groups(N_FRAMES, level.number)
        clock = Stopwatch(threads)
        return locate(level, VirtualExposures(level, source, groups, known, clock), known, graph, threads, clock, Quiet())

    return run


@pytest.mark.parametrize("scale", [1.0, 0.5, 2.0])
def test_homographies_are_in_pixels_of_frames_whatever_the_scale(
    run: Callable, make_level: Callable, known_motion: type, scale: float
) -> None:
    motion = known_motion(lambda frame: from_parameters(np.array([1e-4, 2e-4, -2e-4, 0, 0.3, 0.1, 1e-6, 0]) * frame))
    found = run(make_level(motion, scale=scale), graph=GraphSettings())
    assert found.n_located == len(found.groups) == 12
    np.testing.assert_array_equal(found.instants, np.arange(12) * 10 + 4.5)
    true = motion.at(found.instants)
    np.testing.assert_allclose(found.homographies, normalised(inverse(true[6]) @ true), atol=1e-9)


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_the_locator_starts_from_the_motion_known_in_pixels_of_exposures(
    run: Callable, make_level: Callable, pan: Callable, scale: float
) -> None:
    level = make_level(pan(0.3), scale=scale)
    run(level)
    assert level.locators[0].component.initials == [None] * 11
    level = make_level(pan(0.3), scale=scale)
    run(level, pan(0.25))
    np.testing.assert_allclose(level.locators[0].component.initials, [translation(2.5 * scale, 0)] * 11, atol=1e-12)


def test_pairs_come_in_order_with_any_number_of_threads(run: Callable, make_level: Callable, pan: Callable) -> None:
    results = [run(make_level(pan(0.3)), graph=GraphSettings(), threads=threads) for threads in (1, 2, 3)]
    pairs = [[(edge.moving, edge.fixed) for edge in found.edges] for found in results]
    assert pairs[0] == sorted(pairs[0])
    assert pairs[0] == pairs[1] == pairs[2]
    for found in results[1:]:
        np.testing.assert_array_equal(found.homographies, results[0].homographies)


def test_every_exposure_is_described_once_and_soon_forgotten(run: Callable, make_level: Callable, pan: Callable) -> None:
    class Features:
        def __init__(self, group: Group) -> None:
            self.group = group

    described: list[Group] = []
    alive: weakref.WeakSet[Features] = weakref.WeakSet()
    most = 0

    class Watched:
        def describe(self, exposure: Any) -> Features:
            nonlocal most
            described.append(exposure.group)
            features = Features(exposure.group)
            alive.add(features)
            gc.collect()
            most = max(most, len(alive))
            return features

        def register(self, moving: Features, fixed: Features, initial: np.ndarray | None) -> Located:
            return Located(translation(0.3 * (moving.group.reference - fixed.group.reference), 0))

    found = run(make_level(pan(0.3), locator=Watched()), threads=1)
    assert sorted(described, key=lambda group: group.span) == list(found.groups)
    # Those that may still be bridged to, the current one, and those described ahead.
    assert most <= BRIDGE + 1 + 3
    assert most < len(found.groups)


def failing(*lost: int) -> Callable[..., Any]:
    """Lose every pair of these exposures."""

    def answer(moving: Group, fixed: Group, found: Located) -> Located | NotLocated:
        return NotLocated("lost") if {moving.span.start // 10, fixed.span.start // 10} & set(lost) else found

    return answer


def test_a_lost_exposure_is_bridged(run: Callable, make_level: Callable, pan: Callable) -> None:
    found = run(make_level(pan(0.3), failing(4)))
    tried = [(edge.moving, edge.fixed) for edge in found.edges if edge.moving in (4, 5)]
    assert tried == [(4, 3), (4, 2), (4, 1), (5, 4), (5, 3)]
    np.testing.assert_array_equal(np.flatnonzero(~found.solution.located), [4])
    np.testing.assert_allclose(found.homographies[:, 0, 2], 0.3 * (found.instants - found.instants[5]), atol=1e-9)
    assert len(found.failures) == 4


def test_two_lost_exposures_are_bridged_and_three_are_not(run: Callable, make_level: Callable, pan: Callable) -> None:
    assert run(make_level(pan(0.3), failing(4, 5))).n_located == 10
    with pytest.raises(LocationError, match="so that frames 0 to 69 cannot be tied to the rest"):
        run(make_level(pan(0.3), failing(4, 5, 6)))
    found = run(make_level(pan(0.3), failing(4, 5, 6)), graph=GraphSettings(skips=(), disconnected="largest"))
    np.testing.assert_array_equal(np.flatnonzero(found.solution.located), [7, 8, 9, 10, 11])


def test_what_is_covered_reaches_from_the_first_to_the_last_frame_of_located_exposures(
    run: Callable, make_level: Callable, pan: Callable
) -> None:
    assert run(make_level(pan(0.3), failing(5))).covered == FrameSpan(0, 120)
    assert run(make_level(pan(0.3), failing(0, 1, 11))).covered == FrameSpan(20, 110)


def test_nothing_is_known_of_a_single_exposure(run: Callable, make_level: Callable, pan: Callable) -> None:
    class Whole:
        def groups(self, n_frames: int, level: int) -> tuple[Group, ...]:
            return (Group(FrameSpan(0, n_frames), 60.0),)

    found = run(make_level(pan(0.3), resampler=Whole()), graph=GraphSettings())
    assert (found.n_located, found.edges, found.information) == (1, (), None)
    np.testing.assert_array_equal(found.homographies, [np.eye(3)])


def test_what_is_known_of_each_exposure_is_passed_on(run: Callable, make_level: Callable, pan: Callable) -> None:
    """Each is held by the one before and the one after; the camera hardly moves, so that both say the same of it."""

    def told(moving: Group, fixed: Group, found: Located) -> Located:
        return replace(found, information=np.diag([1e3, 1e3, 1e3, 1e3, 4, 4, 1e7, 1e7]))

    found = run(make_level(pan(1e-9), told))
    np.testing.assert_allclose(found.information[[0, 5, 11], 4, 4], [4, 8, 4], rtol=1e-6)


def test_a_pair_that_no_camera_makes_is_refused(run: Callable, make_level: Callable, pan: Callable) -> None:
    def mirror(moving: Group, fixed: Group, found: Located) -> Located:
        mirrored = translation(59, 0) @ np.diag([-1.0, 1.0, 1.0])
        return Located(mirrored, evidence={"inliers": 30}) if 40 in (moving.span.start, fixed.span.start) else found

    found = run(make_level(pan(0.3), mirror))
    assert {(edge.motion.reason, edge.motion.evidence["inliers"]) for edge in found.failures} == {
        ("the homography mirrors or folds the image", 30)
    }


def test_a_blank_exposure_is_not_shown_to_the_locator(run: Callable, make_level: Callable, pan: Callable) -> None:
    level = make_level(pan(0.3))
    merge = level.merger.merge
    shown: list[int] = []

    class Shuttered:
        def merge(self, source: Any, group: Group, trajectory: Any, scale: float) -> Any:
            exposure = merge(source, group, trajectory, scale)
            return replace(exposure, flux=np.zeros_like(exposure.flux)) if group.span.start == 40 else exposure

    locator = level.locators[0].component
    describe = locator.describe
    locator.describe = lambda exposure: shown.append(exposure.group.span.start) or describe(exposure)
    found = run(replace(level, merger=Shuttered()))
    assert 40 not in shown
    assert {edge.motion.reason for edge in found.failures} == {
        "frames 40 to 49: no pixel saw a photon; is the shutter closed, or the file the right one?"
    }


@pytest.mark.parametrize("scale", [1.0, 0.5, 2.0])
def test_information_and_residual_are_converted_to_pixels_of_frames(
    run: Callable, make_level: Callable, pan: Callable, scale: float
) -> None:
    """A locator whose corners err by 0.2 px of an exposure has corners that err by 0.2 / scale px of a frame."""

    def told(moving: Group, fixed: Group, found: Located) -> Located:
        shape = tuple(round(side * scale) for side in SHAPE)
        to_corners = jacobian(found.homography, corners(shape)).reshape(8, 8)
        return replace(found, information=to_corners.T @ to_corners / 0.2**2, residual_px=0.2)

    (first, *_) = run(make_level(pan(0.3), told, scale=scale)).edges
    to_corners = jacobian(first.motion.homography, corners(SHAPE)).reshape(8, 8)
    covariance = to_corners @ np.linalg.inv(first.motion.information) @ to_corners.T
    # The corner pixels of a rescaled image are not quite those of the image.
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), 0.2 / scale, rtol=0.15)
    assert first.motion.residual_px == pytest.approx(0.2 / scale)


def test_photons_that_two_exposures_share_do_not_count_twice(run: Callable, make_level: Callable, pan: Callable) -> None:
    def told(moving: Group, fixed: Group, found: Located) -> Located:
        return replace(found, information=np.eye(8))

    found = run(make_level(pan(0.3), told, number=2), pan(0.3), GraphSettings(skips=(0.5, 1.0)))
    share = {edge.moving - edge.fixed: edge.motion.information[0, 0] for edge in found.edges}
    # Half of the photons of each group are in the one before, too: half of all that pairs say is said twice.
    assert share == {1: 0.25, 2: 0.5}


def truth(moving: Group, fixed: Group, found: Located) -> Located:
    return found


class Second:
    """A fallback that knows the motion, remembers what it was shown, and answers as it is told."""

    def __init__(self, motion: Trajectory, answer: Callable[..., Any] = truth) -> None:
        self._motion, self._answer = motion, answer
        self.shown: list[int] = []

    def describe(self, exposure: Any) -> Any:
        time.sleep(0.002)  # long enough that two threads that ask for the same one would meet
        self.shown.append(exposure.group.span.start // 10)
        return exposure

    def register(self, moving: Any, fixed: Any, initial: np.ndarray | None) -> Any:
        to_plane = self._motion.at([moving.group.reference, fixed.group.reference])
        return self._answer(moving.group, fixed.group, Located(inverse(to_plane[1]) @ to_plane[0]))


@pytest.mark.parametrize("threads", [1, 2, 4])
def test_a_pair_that_is_lost_is_offered_to_the_fallback_and_no_other(
    run: Callable, make_level: Callable, pan: Callable, threads: int
) -> None:
    motion = pan(0.3)
    second, third = Second(motion), Second(motion)
    level = make_level(motion, failing(4, 5), fallbacks={"second": second, "third": third})
    found = run(level, graph=GraphSettings(skips=(1.0, 2.0)), threads=threads)
    assert found.n_located == 12
    np.testing.assert_allclose(found.homographies[:, 0, 2], 0.3 * (found.instants - found.instants[6]), atol=1e-9)
    by_second = {(edge.moving, edge.fixed) for edge in found.edges if edge.locator == "second"}
    assert by_second == {(4, 3), (4, 2), (5, 4), (5, 3), (6, 5), (6, 4), (7, 5)}
    assert {edge.locator for edge in found.edges} == {"toy", "second"}
    assert sorted(second.shown) == [2, 3, 4, 5, 6, 7]
    assert third.shown == []


def test_a_motion_that_no_camera_makes_is_lost_as_well(run: Callable, make_level: Callable, pan: Callable) -> None:
    def mirror(moving: Group, fixed: Group, found: Located) -> Located:
        mirrored = translation(59, 0) @ np.diag([-1.0, 1.0, 1.0])
        return Located(mirrored) if 40 in (moving.span.start, fixed.span.start) else found

    found = run(make_level(pan(0.3), mirror, fallbacks={"second": Second(pan(0.3))}))
    assert [(edge.moving, edge.fixed) for edge in found.edges if edge.locator == "second"] == [(4, 3), (5, 4)]
    assert found.failures == ()


def test_a_pair_that_all_lose_says_what_each_of_them_said(run: Callable, make_level: Callable, pan: Callable) -> None:
    def lost(reason: str, **evidence: float) -> Callable[..., Any]:
        def answer(moving: Group, fixed: Group, found: Located) -> Located | NotLocated:
            return NotLocated(reason, evidence) if 40 in (moving.span.start, fixed.span.start) else found

        return answer

    second = Second(pan(0.3), lost("2 matches", matches=2))
    found = run(make_level(pan(0.3), lost("the overlap is 3 %", overlap=0.03), fallbacks={"second": second}))
    (failure, *_) = found.failures
    assert failure.locator == ""
    assert failure.motion.reason == "toy: the overlap is 3 %; second: 2 matches"
    assert failure.motion.evidence == {"toy.overlap": 0.03, "second.matches": 2}
    assert [(edge.moving, edge.fixed) for edge in found.failures] == [(4, 3), (4, 2), (4, 1), (5, 4)]


def test_a_blank_exposure_is_not_shown_to_a_fallback_either(run: Callable, make_level: Callable, pan: Callable) -> None:
    second = Second(pan(0.3))
    level = make_level(pan(0.3), failing(4), fallbacks={"second": second})
    merge = level.merger.merge

    class Shuttered:
        def merge(self, source: Any, group: Group, trajectory: Any, scale: float) -> Any:
            exposure = merge(source, group, trajectory, scale)
            return replace(exposure, flux=np.zeros_like(exposure.flux)) if group.span.start == 40 else exposure

    found = run(replace(level, merger=Shuttered()))
    assert second.shown == []
    assert {edge.locator for edge in found.failures} == {""}


def test_a_fallback_keeps_features_no_longer_than_the_locator(run: Callable, make_level: Callable, pan: Callable) -> None:
    alive: weakref.WeakSet[Any] = weakref.WeakSet()
    most = 0

    class Features:
        def __init__(self, group: Group) -> None:
            self.group = group

    class Watched(Second):
        def describe(self, exposure: Any) -> Features:
            nonlocal most
            features = Features(exposure.group)
            alive.add(features)
            gc.collect()
            most = max(most, len(alive))
            return features

    found = run(make_level(pan(0.3), failing(*range(12)), fallbacks={"second": Watched(pan(0.3))}), threads=1)
    assert [edge.locator for edge in found.edges] == ["second"] * 11
    assert most <= BRIDGE + 2


@pytest.mark.parametrize("method", ["describe", "register"])
def test_a_fallback_that_fails_is_named(run: Callable, make_level: Callable, pan: Callable, method: str) -> None:
    def fail(*_: Any) -> Any:
        raise ZeroDivisionError("oops")

    second = Second(pan(0.3))
    setattr(second, method, fail)
    with pytest.raises(PluginError) as caught:
        run(make_level(pan(0.3), failing(4), fallbacks={"second": second}))
    assert str(caught.value) == "locator 'second' of toys 1.0 failed at level 1: ZeroDivisionError: oops"


def test_a_fallback_that_breaks_its_contract_is_named(run: Callable, make_level: Callable, pan: Callable) -> None:
    second = Second(pan(0.3), lambda *_: None)
    with pytest.raises(PluginError) as caught:
        run(make_level(pan(0.3), failing(4), fallbacks={"second": second}))
    problem = "expected Located or NotLocated, got NoneType"
    assert str(caught.value) == f"locator 'second' of toys 1.0 broke its contract at level 1: {problem}"


BROKEN = [
    (None, "expected Located or NotLocated, got NoneType"),
    (np.eye(3), "expected Located or NotLocated, got ndarray"),
    (
        Located(np.full((3, 3), np.nan)),
        "a homography is a finite (3, 3) matrix with h33 = 1, got [[nan, nan, nan], [nan, nan, nan], [nan, nan, nan]]; "
        "a failure is NotLocated",
    ),
    (
        Located(np.eye(2)),
        "a homography is a finite (3, 3) matrix with h33 = 1, got [[1.0, 0.0], [0.0, 1.0]]; a failure is NotLocated",
    ),
    (
        Located(np.diag([1.0, 1.0, 0.0])),
        "a homography is a finite (3, 3) matrix with h33 = 1, got [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]]; "
        "a failure is NotLocated",
    ),
    *(
        (
            Located(np.eye(3), information),
            "information is an inverse covariance: an (8, 8) matrix, finite and positive definite; None if there is none",
        )
        for information in (np.eye(9), -np.eye(8), np.zeros((8, 8)), np.full((8, 8), np.nan))
    ),
    (Located(translation(3, 1), evidence={"inliers": "many"}), "evidence consists of numbers, got inliers = 'many'"),
    (NotLocated("lost", {"matches": [3, 4]}), "evidence consists of numbers, got matches = [3, 4]"),
]


@pytest.mark.parametrize(("answer", "problem"), BROKEN)
def test_what_is_no_motion_is_refused_with_the_name_of_the_locator(
    run: Callable, make_level: Callable, pan: Callable, answer: Any, problem: str
) -> None:
    assert broken_promise(answer) == problem
    with pytest.raises(PluginError) as caught:
        run(make_level(pan(0.3), lambda *_: answer))
    assert str(caught.value) == f"locator 'toy' of toys 1.0 broke its contract at level 1: {problem}"


def test_a_motion_that_keeps_its_promise() -> None:
    assert broken_promise(Located(np.eye(3), np.eye(8))) is None
    assert broken_promise(Located(rescaled(translation(3, 1), 2))) is None
    assert broken_promise(Located(translation(3, 1), evidence={"inliers": np.int64(3), "ncc": np.float32(0.5)})) is None
    assert broken_promise(NotLocated("lost", {"matches": 3})) is None


def in_whole_pixels(moving: Group, fixed: Group, found: Located) -> Located:
    return replace(found, homography=np.round(found.homography))


STILL = (
    "broke its contract at level 1: every pair that was located is exactly the identity, which a camera that stands still does "
    "not give; a failure is NotLocated"
)


@pytest.mark.parametrize("scale", [1.0, 0.3])
def test_a_level_in_which_nothing_moves_to_the_last_digit_is_refused(
    run: Callable, make_level: Callable, pan: Callable, scale: float
) -> None:
    with pytest.raises(PluginError) as caught:
        run(make_level(pan(0.0), scale=scale))
    assert str(caught.value) == f"locator 'toy' of toys 1.0 {STILL}"


def test_both_locators_that_see_nothing_move_are_named(run: Callable, make_level: Callable, pan: Callable) -> None:
    with pytest.raises(PluginError) as caught:
        run(make_level(pan(0.0), failing(4), fallbacks={"second": Second(pan(0.0))}))
    both = "locator 'toy' of toys 1.0 and locator 'second' of toys 1.0"
    assert str(caught.value) == f"{both} {STILL.replace('its', 'their')}"


def test_a_camera_that_stands_still_is_believed(run: Callable, make_level: Callable, pan: Callable) -> None:
    def nearly(moving: Group, fixed: Group, found: Located) -> Located:
        return replace(found, homography=found.homography @ translation(1e-4, 0))

    assert run(make_level(pan(0.0), nearly)).n_located == 12


def test_pairs_that_move_less_than_a_locator_tells_are_believed(
    run: Callable, make_level: Callable, known_motion: type
) -> None:
    """Slow at first: pairs are the identity in whole pixels, and the motion known so far errs by 2 px."""
    motion = known_motion(lambda frame: translation(0.001 * frame**2, 0))
    found = run(make_level(motion, in_whole_pixels), known_motion(lambda frame: translation(0.2 * frame, 0)))
    identities = [bool((edge.motion.homography == np.eye(3)).all()) for edge in found.edges]
    assert identities == [True] * 2 + [False] * 9


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_the_identity_is_refused_where_the_motion_is_known_to_be_far_from_it(
    run: Callable, make_level: Callable, pan: Callable, scale: float
) -> None:
    with pytest.raises(PluginError) as caught:
        run(make_level(pan(0.0), scale=scale), pan(0.6))
    assert str(caught.value) == (
        "locator 'toy' of toys 1.0 broke its contract at level 1: got the identity where the motion known so far moves the "
        "corners by 6 px; a failure is NotLocated"
    )
