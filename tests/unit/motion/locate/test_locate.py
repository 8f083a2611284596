from __future__ import annotations

import gc
import weakref
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from photonpano import FrameSpan, Group, Located, LocationError
from photonpano.geometry import corners, from_parameters, inverse, jacobian, normalised, translation
from photonpano.motion.registration import BRIDGE
from photonpano.specs.settings import GraphSettings

pytestmark = pytest.mark.usefixtures("one_thread")

SHAPE = (40, 60)


@pytest.mark.parametrize("scale", [1.0, 0.5, 2.0])
def test_homographies_are_in_pixels_of_frames_at_any_scale(
    run: Callable, make_level: Callable, known_motion: type, scale: float
) -> None:
    motion = known_motion(lambda frame: from_parameters(np.array([1e-4, 2e-4, -2e-4, 0, 0.3, 0.1, 1e-6, 0]) * frame))
    found = run(make_level(motion, scale=scale), graph=GraphSettings())
    assert found.n_located == len(found.groups) == 12
    np.testing.assert_array_equal(found.instants, np.arange(12) * 10 + 4.5)
    true = motion.at(found.instants)
    np.testing.assert_allclose(found.homographies, normalised(inverse(true[6]) @ true), atol=1e-9)


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_locator_starts_from_the_motion_known_so_far_in_pixels_of_exposures(
    run: Callable, make_level: Callable, pan: Callable, scale: float
) -> None:
    level = make_level(pan(0.3), scale=scale)
    run(level)
    assert level.locators[0].component.initials == [None] * 11
    level = make_level(pan(0.3), scale=scale)
    run(level, pan(0.25))
    np.testing.assert_allclose(level.locators[0].component.initials, [translation(2.5 * scale, 0)] * 11, atol=1e-12)


def test_pairs_are_in_order_with_any_number_of_threads(run: Callable, make_level: Callable, pan: Callable) -> None:
    results = [run(make_level(pan(0.3)), graph=GraphSettings(), threads=threads) for threads in (1, 2, 3)]
    pairs = [[(edge.moving, edge.fixed) for edge in found.edges] for found in results]
    assert pairs[0] == sorted(pairs[0])
    assert pairs[0] == pairs[1] == pairs[2]
    for found in results[1:]:
        np.testing.assert_array_equal(found.homographies, results[0].homographies)


def test_exposures_are_described_once_and_released_after_their_last_pair(
    run: Callable, make_level: Callable, pan: Callable
) -> None:
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


def test_lost_exposure_is_bridged(run: Callable, make_level: Callable, pan: Callable, failing: Callable) -> None:
    found = run(make_level(pan(0.3), failing(4)))
    tried = [(edge.moving, edge.fixed) for edge in found.edges if edge.moving in (4, 5)]
    assert tried == [(4, 3), (4, 2), (4, 1), (5, 4), (5, 3)]
    np.testing.assert_array_equal(np.flatnonzero(~found.solution.located), [4])
    np.testing.assert_allclose(found.homographies[:, 0, 2], 0.3 * (found.instants - found.instants[5]), atol=1e-9)
    assert len(found.failures) == 4


def test_two_lost_exposures_are_bridged_and_three_are_not(
    run: Callable, make_level: Callable, pan: Callable, failing: Callable
) -> None:
    assert run(make_level(pan(0.3), failing(4, 5))).n_located == 10
    with pytest.raises(LocationError, match="so that frames 0 to 69 cannot be tied to the rest"):
        run(make_level(pan(0.3), failing(4, 5, 6)))
    found = run(make_level(pan(0.3), failing(4, 5, 6)), graph=GraphSettings(skips=(), disconnected="largest"))
    np.testing.assert_array_equal(np.flatnonzero(found.solution.located), [7, 8, 9, 10, 11])


def test_covered_frames_reach_from_the_first_to_the_last_located_exposure(
    run: Callable, make_level: Callable, pan: Callable, failing: Callable
) -> None:
    assert run(make_level(pan(0.3), failing(5))).covered == FrameSpan(0, 120)
    assert run(make_level(pan(0.3), failing(0, 1, 11))).covered == FrameSpan(20, 110)


def test_single_exposure_has_no_information(run: Callable, make_level: Callable, pan: Callable) -> None:
    class Whole:
        def groups(self, n_frames: int, level: int) -> tuple[Group, ...]:
            return (Group(FrameSpan(0, n_frames), 60.0),)

    found = run(make_level(pan(0.3), resampler=Whole()), graph=GraphSettings())
    assert (found.n_located, found.edges, found.information) == (1, (), None)
    np.testing.assert_array_equal(found.homographies, [np.eye(3)])


def test_information_of_each_exposure_sums_that_of_its_pairs(run: Callable, make_level: Callable, pan: Callable) -> None:
    """Each has pairs with the one before and the one after; the camera hardly moves, so that their information adds up."""

    def informed(moving: Group, fixed: Group, found: Located) -> Located:
        return replace(found, information=np.diag([1e3, 1e3, 1e3, 1e3, 4, 4, 1e7, 1e7]))

    found = run(make_level(pan(1e-9), informed))
    np.testing.assert_allclose(found.information[[0, 5, 11], 4, 4], [4, 8, 4], rtol=1e-6)


def test_implausible_motion_is_refused(run: Callable, make_level: Callable, pan: Callable) -> None:
    def mirror(moving: Group, fixed: Group, found: Located) -> Located:
        mirrored = translation(59, 0) @ np.diag([-1.0, 1.0, 1.0])
        return Located(mirrored, evidence={"inliers": 30}) if 40 in (moving.span.start, fixed.span.start) else found

    found = run(make_level(pan(0.3), mirror))
    assert {(edge.motion.reason, edge.motion.evidence["inliers"]) for edge in found.failures} == {
        ("the homography mirrors or folds the image", 30)
    }


def test_locator_does_not_describe_blank_exposures(run: Callable, make_level: Callable, pan: Callable) -> None:
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
        "frames 40 to 49: no pixel detected a photon; is the shutter closed, or is it the wrong file?"
    }


@pytest.mark.parametrize("scale", [1.0, 0.5, 2.0])
def test_information_and_residual_are_converted_to_pixels_of_frames(
    run: Callable, make_level: Callable, pan: Callable, scale: float
) -> None:
    """An error of 0.2 px of an exposure is an error of 0.2 / scale px of a frame."""

    def informed(moving: Group, fixed: Group, found: Located) -> Located:
        shape = tuple(round(side * scale) for side in SHAPE)
        to_corners = jacobian(found.homography, corners(shape)).reshape(8, 8)
        return replace(found, information=to_corners.T @ to_corners / 0.2**2, residual_px=0.2)

    (first, *_) = run(make_level(pan(0.3), informed, scale=scale)).edges
    to_corners = jacobian(first.motion.homography, corners(SHAPE)).reshape(8, 8)
    covariance = to_corners @ np.linalg.inv(first.motion.information) @ to_corners.T
    # The corner pixels of a rescaled image are not quite those of the image.
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), 0.2 / scale, rtol=0.15)
    assert first.motion.residual_px == pytest.approx(0.2 / scale)


def test_information_discounts_shared_photons(run: Callable, make_level: Callable, pan: Callable) -> None:
    def informed(moving: Group, fixed: Group, found: Located) -> Located:
        return replace(found, information=1e8 * np.eye(8))

    found = run(make_level(pan(0.3), informed, number=2), pan(0.3), GraphSettings(skips=(0.5, 1.0)))
    share = {edge.moving - edge.fixed: edge.motion.information[0, 0] / 1e8 for edge in found.edges}
    # Half of the photons of each group are in the one before, too, so that pairs repeat half of their information.
    assert share == {1: pytest.approx(0.25), 2: pytest.approx(0.5)}
