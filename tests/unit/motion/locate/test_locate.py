"""Exposures are located: pairs, hypotheses, bridges, and their information."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from photonpano import Group, Homography, Located, LocationError, NotLocated, PluginError
from photonpano.contracts.attribution import attributed
from photonpano.geometry import corners, from_parameters, inverse, jacobian, normalised, translation
from photonpano.motion.level import Level, NamedLocator
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
    np.testing.assert_allclose(found.homographies, normalised(inverse(true[6]) @ true), atol=2e-4)  # by the prior


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_locator_starts_from_the_motion_known_so_far_in_pixels_of_exposures(
    run: Callable, make_level: Callable, pan: Callable, scale: float
) -> None:
    level = make_level(scale=scale)
    run(level)
    run(level, pan(0.25))
    initials = level.locators[0].component.initials
    assert initials[:11] == [None] * 11
    np.testing.assert_allclose(initials[11:], [translation(2.5 * scale, 0)] * 11, atol=1e-12)


def test_two_lost_exposures_are_bridged_and_three_are_not(run: Callable, make_level: Callable, failing: Callable) -> None:
    assert run(make_level(answer=failing(4, 5))).n_located == 10
    with pytest.raises(LocationError, match="so that frames 0 to 69 cannot be tied to the rest"):
        run(make_level(answer=failing(4, 5, 6)))
    found = run(make_level(answer=failing(4, 5, 6)), graph=GraphSettings(skips=(), disconnected="largest"))
    np.testing.assert_array_equal(np.flatnonzero(found.solution.located), [7, 8, 9, 10, 11])


@pytest.mark.parametrize("scale", [1.0, 0.5, 2.0])
def test_information_and_residual_are_converted_to_pixels_of_frames(run: Callable, make_level: Callable, scale: float) -> None:
    """An error of 0.2 px of an exposure is an error of 0.2 / scale px of a frame."""

    def with_error(moving: Group, fixed: Group, found: Located) -> Located:
        shape = tuple(round(side * scale) for side in SHAPE)
        to_corners = jacobian(found.homography, corners(shape)).reshape(8, 8)
        return replace(found, information=to_corners.T @ to_corners / 0.2**2, residual_px=0.2)

    (first, *_) = run(make_level(answer=with_error, scale=scale)).edges
    to_corners = jacobian(first.motion.homography, corners(SHAPE)).reshape(8, 8)
    covariance = to_corners @ np.linalg.inv(first.motion.information) @ to_corners.T
    # The corner pixels of a rescaled image are not quite those of the image.
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), 0.2 / scale, rtol=0.15)
    assert first.motion.residual_px == pytest.approx(0.2 / scale)


@pytest.fixture
def hypothesising(make_level: Callable) -> Callable[..., Level]:
    """A level whose locator suggests these shifts along x per pair, in px; the true one is 3 px per group."""

    def make(*shifts: float, first: tuple[float, ...] | None = None, lost: tuple[int, ...] = (), **options: Any) -> Level:
        made = make_level(**options)
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

        return replace(
            made,
            locators=(
                NamedLocator("toy", attributed(Hypothesising(), "locator 'toy' of toys 1.0", "level 1")),
                *made.locators[1:],
            ),
        )

    return make


def test_hypothesis_that_continues_the_motion_is_taken(run: Callable, hypothesising: Callable) -> None:
    made = hypothesising(-13.0, 4.0, 20.0, first=(2.0,))
    found = run(made)
    initials = made.locators[0].component.initials
    np.testing.assert_allclose([initials[later, later - 1][0, 2] for later in range(1, 12)], [2.0] + 10 * [4.0], atol=1e-9)
    assert found.ambiguity is None


def test_first_of_several_hypotheses_is_taken_and_named_as_ambiguous(run: Callable, hypothesising: Callable) -> None:
    found = run(hypothesising(4.0, -13.0))
    assert (found.ambiguity.level, found.ambiguity.pairs) == (1, ((1, 0),))
    assert found.ambiguity.alternative_px == pytest.approx(17)


def test_pair_that_does_not_overlap_by_the_motion_known_so_far_is_no_pair(
    run: Callable, make_level: Callable, pan: Callable
) -> None:
    """Frames of 60 px move by 30 px per group, so that the second neighbour is out of sight."""
    made = make_level(pan(3.0))
    found = run(made, pan(3.0), GraphSettings(skips=(1.0, 2.0)))
    assert len(made.locators[0].component.initials) == 11
    assert len(found.edges) == 11


@pytest.mark.parametrize("hypothesis", ["left", np.eye(2), translation(np.nan, 0)], ids=["text", "shape", "NaN"])
def test_hypotheses_that_are_no_homographies_are_refused(run: Callable, hypothesising: Callable, hypothesis: Any) -> None:
    made = hypothesising(2.0)
    made.locators[0].component.component.hypotheses = lambda *_: [hypothesis]
    with pytest.raises(
        PluginError, match=r"^locator 'toy' of toys 1\.0 broke its contract at level 1: a homography (is|must be) "
    ):
        run(made, graph=GraphSettings())
