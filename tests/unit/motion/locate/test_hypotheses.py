"""Locators that keep hypotheses: where the registrations of the first level start, and what stays ambiguous."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import repeat
from typing import Any

import numpy as np
import pytest

from photonpano import Homography, Located, NotLocated, PluginError
from photonpano.geometry import translation
from photonpano.motion.level import Level, NamedLocator
from photonpano.specs.settings import GraphSettings

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def level(make_level: Callable, pan: Callable) -> Callable[..., Level]:
    """A level whose locator suggests these shifts along x per pair, in px; the true one is 3 px per group."""

    def make(*shifts: float, first: tuple[float, ...] | None = None, lost: tuple[int, ...] = (), **options: Any) -> Level:
        made = make_level(pan(0.3), **options)
        named = made.locators[0]

        class Hypothesising:
            def __init__(self) -> None:
                self.initials: dict[tuple[float, float], np.ndarray | None] = {}

            def describe(self, exposure: Any) -> Any:
                return exposure

            def hypotheses(self, moving: Any, fixed: Any) -> list[Homography]:
                suggested = first if first is not None and fixed.group.span.start == 0 else shifts
                return [translation(shift * moving.scale, 0) for shift in suggested]

            def register(self, moving: Any, fixed: Any, initial: np.ndarray | None) -> Located | NotLocated:
                self.initials[moving.group.span.start // 10, fixed.group.span.start // 10] = initial
                if moving.group.span.start // 10 in lost:
                    return NotLocated("lost")
                return named.component.register(moving, fixed, initial)

        return replace(made, locators=(NamedLocator("toy", Hypothesising(), named.origin), *made.locators[1:]))

    return make


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_distant_pairs_of_the_first_level_start_from_the_nearest_ones(
    run: Callable, level: Callable, scale: float, threads: int
) -> None:
    made = level(2.0, scale=scale)
    run(made, graph=GraphSettings(), threads=threads)
    initials = made.locators[0].component.initials
    np.testing.assert_allclose(initials[1, 0], translation(2 * scale, 0), atol=1e-12)
    np.testing.assert_allclose(initials[6, 4], translation(6 * scale, 0), atol=1e-9)
    np.testing.assert_allclose(initials[6, 2], translation(12 * scale, 0), atol=1e-9)


def test_hypothesis_that_continues_the_motion_is_taken(run: Callable, level: Callable) -> None:
    made = level(-13.0, 4.0, 20.0, first=(2.0,))
    found = run(made)
    initials = made.locators[0].component.initials
    np.testing.assert_allclose([initials[later, later - 1][0, 2] for later in range(1, 12)], [2.0] + 10 * [4.0], atol=1e-9)
    assert found.ambiguity is None


def test_first_of_several_hypotheses_is_taken_and_named_as_ambiguous(run: Callable, level: Callable) -> None:
    found = run(level(4.0, -13.0))
    assert found.ambiguity.level == 1
    assert found.ambiguity.pairs == ((1, 0),)
    assert found.ambiguity.alternative_px == pytest.approx(17)


def test_exposure_that_is_not_located_is_passed_over_at_the_speed_before(run: Callable, level: Callable) -> None:
    made = level(3.0, lost=(5,))
    run(made, graph=GraphSettings())
    np.testing.assert_allclose(made.locators[0].component.initials[6, 4], translation(6, 0), atol=1e-9)


def test_fallback_without_hypotheses_gets_no_start_at_the_first_level(
    run: Callable, level: Callable, make_level: Callable, pan: Callable
) -> None:
    fallback = make_level(pan(0.3)).locators[0].component
    run(level(3.0, lost=(5,), fallbacks={"other": fallback}))
    assert fallback.initials == [None]


def test_pair_that_does_not_overlap_by_the_motion_known_so_far_is_not_registered(
    run: Callable, make_level: Callable, pan: Callable
) -> None:
    """Frames of 60 px move by 30 px per group, so that the second neighbour is out of sight."""
    made = make_level(pan(3.0))
    found = run(made, pan(3.0), GraphSettings(skips=(1.0, 2.0)))
    assert len(made.locators[0].component.initials) == 11
    reasons = {edge.motion.reason for edge in found.failures}
    assert reasons == {"by the motion known so far, the images overlap by 0% (at least 10% is needed)"}


@pytest.mark.parametrize("hypothesis", ["left", np.eye(2), translation(np.nan, 0)], ids=["text", "shape", "NaN"])
def test_hypotheses_that_are_no_homographies_are_refused(run: Callable, level: Callable, hypothesis: Any) -> None:
    """Also if they have no end."""
    made = level(2.0)
    made.locators[0].component.hypotheses = lambda *_: repeat(hypothesis)
    with pytest.raises(PluginError, match=r"^locator 'toy' of toys 1\.0 broke its contract at level 1: a homography is a "):
        run(made, graph=GraphSettings())
