"""Loop closures of a level: which pairs are registered, accepted, refused or dropped."""

import gc
import weakref
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from photonpano import Group, Located, NotLocated, Trajectory, VirtualExposure
from photonpano.execution.context import Context
from photonpano.execution.threads import Stopwatch
from photonpano.geometry import inverse, rescaling, translation
from photonpano.motion.level import Level, Timeline, VirtualExposures
from photonpano.motion.locate import LocatedLevel, LoopSetting, locate
from photonpano.motion.registration import MIN_SIMILARITY
from photonpano.specs.settings import GraphSettings
from photonpano.testing import KnownMotion, MemorySource, photographed
from photonpano.testing.captures import seen_along
from photonpano.values import Edge

pytestmark = pytest.mark.usefixtures("one_thread")

SHAPE = (40, 60)
N = 24  # exposures of ten frames: twelve on the way there, 9 px apart, and twelve on the way back
PAIRS = [(12 + i, 11 - i) for i in range(2, 12)]  # that see one place twice, apart from those around the turn
PERIOD_PX = 20
DRIFT_PX = 0.05


class Scenery:
    """Merges the view of a camera on a known path over a plane of period 20 px; records what it merged."""

    def __init__(self, motion: Trajectory) -> None:
        self._motion = motion
        self.merged: list[int] = []
        self._images: list[weakref.ref[Any]] = []
        tile = cv2.GaussianBlur(np.random.default_rng(0).normal(size=(3 * PERIOD_PX,) * 2), (0, 0), 2)
        self._plane = np.exp(3 * np.tile(tile[:PERIOD_PX, :PERIOD_PX], (4, 12)))

    def merge(self, source: Any, group: Group, trajectory: Trajectory | None, scale: float) -> VirtualExposure:
        shape = tuple(round(side * scale) for side in SHAPE)
        mean = seen_along(self._plane, self._motion.at([group.reference])[0] @ inverse(rescaling(scale)), shape)[0]
        exposure = replace(photographed(mean, 1000, seed=group.span.start), group=group, scale=scale)
        self.merged.append(group.span.start // 10)
        self._images.append(weakref.ref(exposure.flux))
        return exposure

    @property
    def alive(self) -> int:
        """How many exposures are held by anyone."""
        gc.collect()
        return sum(image() is not None for image in self._images)


# 0.9 px a frame, back after half of the frames
THERE_AND_BACK = KnownMotion(lambda frame: translation(20 + 0.9 * min(frame, 10 * N - 1 - frame), 20))


@pytest.fixture
def level(make_level: Callable) -> Callable[..., Level]:
    def level(answer: Callable[..., Any] = drifting, motion: Trajectory = THERE_AND_BACK, **changes: Any) -> Level:
        return make_level(motion, answer, **{"merger": Scenery(motion)} | changes)

    return level


@pytest.fixture
def run() -> Callable[..., LocatedLevel]:
    source = MemorySource(np.zeros((10 * N, *SHAPE)))

    def run(level: Level, closure_overlap: float | None = 0.5, threads: int = 2) -> LocatedLevel:
        groups = level.resampler.groups(10 * N, level.number)
        graph = GraphSettings(skips=(1.0, 2.0), closure_overlap=closure_overlap)
        exposures = VirtualExposures(level=level, source=source, groups=groups, previous=None, clock=Stopwatch())
        setting = LoopSetting(
            source=source, graph=graph, context=Context(threads=threads), reference=0, timeline=Timeline.regular(10 * N)
        )
        return locate(exposures, setting)

    return run


def is_closure(moving: Group, fixed: Group) -> bool:
    return moving.reference - fixed.reference > 20


def drifting(moving: Group, fixed: Group, found: Located) -> Located:
    """Motions of neighbours are off by 0.05 px of an exposure for each group length, in one direction; closures are exact."""
    off_px = 0.0 if is_closure(moving, fixed) else DRIFT_PX * (moving.reference - fixed.reference) / 10
    return replace(found, homography=translation(0, off_px) @ found.homography, evidence={"inliers": 30})


def at_closures(change: Callable[[Located], Located | NotLocated]) -> Callable[..., Any]:
    def answer(moving: Group, fixed: Group, found: Located) -> Located | NotLocated:
        return change(found) if is_closure(moving, fixed) else drifting(moving, fixed, found)

    return answer


def drift_px(found: LocatedLevel) -> float:
    """Distance between the first and the last exposure, which show the same place."""
    return abs(float(found.homographies[-1, 1, 2] - found.homographies[0, 1, 2]))


def pairs_of(edges: Iterable[Edge]) -> list[tuple[int, int]]:
    return [(edge.moving, edge.fixed) for edge in edges]


def test_loop_closures_stop_the_drift(run: Callable, level: Callable) -> None:
    with_them, without = run(level()), run(level(), closure_overlap=None)
    assert pairs_of(with_them.closures) == PAIRS
    assert pairs_of(without.closures) == []
    assert len(with_them.edges) == len(without.edges) + len(PAIRS)
    assert drift_px(without) == pytest.approx(DRIFT_PX * (N - 1), rel=0.02)
    assert drift_px(with_them) < 0.1 * drift_px(without)
    for edge in with_them.closures:
        assert (edge.locator, edge.motion.evidence["inliers"]) == ("toy", 30)
        assert 0.9 < edge.motion.evidence["closure_similarity"] < 1.05


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_closure_starts_from_the_solution_of_the_other_pairs(run: Callable, level: Callable, scale: float) -> None:
    toy = level(scale=scale)
    run(toy, threads=1)
    initials = toy.locators[0].component.initials
    assert all(initial is None for initial in initials[: -len(PAIRS)])
    # Both exposures of a pair show one place; the drift of neighbours between them is 0.05 px of an exposure each.
    expected = [translation(0, DRIFT_PX * (moving - fixed)) for moving, fixed in PAIRS]
    np.testing.assert_allclose(initials[-len(PAIRS) :], expected, atol=1e-3)


def test_closure_that_returns_exactly_is_accepted_however_far_the_others_drifted(run: Callable, level: Callable) -> None:
    """The drift is 5.75 px; as the motion of a pair of neighbours, the identity is refused from 4 px on."""

    def far(moving: Group, fixed: Group, found: Located) -> Located:
        off_px = 0.0 if is_closure(moving, fixed) else 5 * DRIFT_PX * (moving.reference - fixed.reference) / 10
        return replace(found, homography=translation(0, off_px) @ found.homography)

    found = run(level(far))
    assert (found.edges[-1].motion.homography == np.eye(3)).all()
    assert drift_px(run(level(far), closure_overlap=None)) == pytest.approx(5.75, rel=0.02)
    assert drift_px(found) < 0.6


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_closure_of_different_places_is_refused(run: Callable, level: Callable, scale: float) -> None:
    wrong = at_closures(lambda found: replace(found, homography=translation(7, 9) @ found.homography, evidence={"inliers": 12}))
    found = run(level(wrong, scale=scale))
    assert pairs_of(found.failures) == PAIRS == pairs_of(found.closures)
    for edge in found.failures:
        assert edge.locator == ""
        assert edge.motion.evidence["inliers"] == 12
        similarity = edge.motion.evidence["closure_similarity"]
        assert similarity < MIN_SIMILARITY
        assert edge.motion.reason == f"the similarity of the exposures of this loop closure is {similarity:.2f}, less than 0.7"
    np.testing.assert_array_equal(found.homographies, run(level(wrong, scale=scale), closure_overlap=None).homographies)


def test_similar_but_wrong_closure_is_dropped_as_outlier(run: Callable, level: Callable) -> None:
    """A shift by the period of the plane leaves the similarity as it is."""

    def answer(moving: Group, fixed: Group, found: Located) -> Located:
        motion = drifting(moving, fixed, found)
        wrong = (moving.span.start // 10, fixed.span.start // 10) == PAIRS[5]
        return replace(motion, homography=translation(PERIOD_PX, 0) @ motion.homography) if wrong else motion

    found = run(level(answer))
    (position,) = found.solution.outliers
    edge = found.edges[position]
    assert (edge.moving, edge.fixed) == PAIRS[5]
    assert edge.motion.evidence["closure_similarity"] > 0.9
    assert found.failures == ()
    assert drift_px(found) < 0.15


def test_closures_that_agree_on_the_next_period_do_not_outvote_neighbours(run: Callable, level: Callable) -> None:
    """All closures are off by the period of the plane; two of the other pairs alone stand against them at the turn."""

    def answer(moving: Group, fixed: Group, found: Located) -> Located:
        motion = drifting(moving, fixed, found)
        sure = replace(motion, residual_px=0.05)
        off = translation(PERIOD_PX, 0) @ motion.homography
        return replace(sure, homography=off) if is_closure(moving, fixed) else sure

    found = run(level(answer))
    assert all("contradicts pairs in between that are surer" in edge.motion.reason for edge in found.failures)
    assert len(found.failures) >= len(PAIRS) - 2
    assert all(index >= len(found.edges) - len(found.closures) for index in found.solution.outliers)
    assert abs(float(found.homographies[-1, 0, 2] - found.homographies[0, 0, 2])) < 0.5
