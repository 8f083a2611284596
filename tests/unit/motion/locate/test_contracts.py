"""Locators that fail or break their contract, and fallbacks."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from photonpano import Group, Located, LocationError, NotLocated, PluginError, Trajectory
from photonpano.contracts.requirements import BrokenContract, require_near_knots, why_undetermined
from photonpano.geometry import translation
from photonpano.specs.settings import GraphSettings

pytestmark = pytest.mark.usefixtures("one_thread")
FIRST, SECOND = "locator 'toy' of toys 1.0", "locator 'second' of toys 1.0"
BROKEN = "broke its contract at level 1: expected Located or NotLocated, got a NoneType"
STILL = (
    "broke its contract at level 1: every pair that was located is exactly the identity, which a camera that stands still does "
    "not give; a failure is NotLocated"
)


def failing_with(error: Exception) -> Callable[..., Any]:
    def fail(*_: Any) -> Any:
        raise error

    return fail


@pytest.mark.parametrize(
    ("fallback", "message"),
    [
        ({}, f"{SECOND} {BROKEN}"),
        ({"describe": failing_with(ZeroDivisionError("oops"))}, f"{SECOND} failed at level 1: ZeroDivisionError: oops"),
        ({"register": failing_with(ZeroDivisionError("oops"))}, f"{SECOND} failed at level 1: ZeroDivisionError: oops"),
    ],
    ids=["wrong answer", "raises on an exposure", "raises on a pair"],
)
def test_fallback_that_raises_or_breaks_its_contract_is_named(
    run: Callable, make_level: Callable, failing: Callable, make_second: type, fallback: dict[str, Any], message: str
) -> None:
    second = make_second(lambda *_: None)
    vars(second).update(fallback)
    with pytest.raises(PluginError) as caught:
        run(make_level(answer=failing(4), fallbacks={"second": second}))
    assert str(caught.value) == message


@pytest.mark.parametrize("scale", [1.0, 0.3, 0.5])
@pytest.mark.parametrize("case", ["all pairs", "all locators", "against the motion known so far"])
def test_identity_of_every_pair_is_refused(
    run: Callable, make_level: Callable, pan: Callable, failing: Callable, make_second: type, scale: float, case: str
) -> None:
    previous, message = None, f"{FIRST} {STILL}"
    level = make_level(pan(0.0), scale=scale)
    if case == "all locators":
        level = make_level(pan(0.0), failing(4), scale=scale, fallbacks={"second": make_second(px_per_frame=0)})
        message = f"{FIRST} and {SECOND} {STILL.replace('its', 'their')}"
    elif case == "against the motion known so far":
        previous = pan(0.6)
        message = (
            f"{FIRST} broke its contract at level 1: got the identity where the motion known so far moves the corners by 6 px; "
            "a failure is NotLocated"
        )
    with pytest.raises(PluginError) as caught:
        run(level, previous)
    assert str(caught.value) == message


def informed(along_px: float, across_px: float) -> Located:
    """A shift whose expected errors along x and y differ."""
    std = np.array([1e-3, 1e-3, 1e-3, 1e-3, along_px, across_px, 1e-6, 1e-6])
    return Located(translation(3, 1), np.diag(std**-2.0))


@pytest.mark.parametrize(
    ("motion", "error"),
    [
        (informed(0.1, 100.0), None),
        (informed(0.1, 590.0), None),
        (informed(0.1, 1e4), "10,000"),
        (Located(translation(3, 1), residual_px=5e6), "5,000,000"),
        (Located(translation(3, 1)), None),
    ],
    ids=["100 px", "590 px", "10,000 px", "residual", "nothing known"],
)
def test_motion_that_the_images_do_not_determine_is_told(motion: Located, error: str | None) -> None:
    """The limit is ten times the longer side of a frame."""
    sentence = f"the images do not determine the motion: its expected error is {error} px at a corner"
    assert why_undetermined(motion, (40, 60)) == (sentence if error else None)


def test_pair_that_stripes_leave_undetermined_is_not_located(run: Callable, make_level: Callable) -> None:
    """Along the stripes, every shift fits."""

    def along_stripes(moving: Group, fixed: Group, found: Located) -> Located:
        return replace(found, information=informed(0.1, 1e7).information)

    with pytest.raises(LocationError) as caught:
        run(make_level(answer=along_stripes))
    assert str(caught.value).startswith(
        "level 1: none of the 30 pairs of exposures could be located\n"
        "  frames 10 to 19 onto frames 0 to 9: the images do not determine the motion: its expected error is 10,000,000 px "
        "at a corner\n"
    )


PLACES = np.array([translation(5.0 * index, 0) for index in range(9)])


def knots_kept(trajectory: Trajectory, std_px: float = 0.05) -> None:
    require_near_knots(trajectory, np.arange(0, 90, 10.0), PLACES, np.full(9, std_px), (40, 60))


@pytest.mark.parametrize(
    ("motion", "problem"),
    [
        (
            lambda frame: translation(0.5 * frame + 15, 0),
            "the trajectory misses half of its knots by 15 px or more, where their expected error is 0.05 px",
        ),
        (
            lambda frame: translation(0.5 * frame, 40 * (frame % 10 > 0)),
            "the trajectory passes its knots, but half-way between them it is typically 35 px further away than the next knot",
        ),
    ],
    ids=["beside", "between"],
)
def test_trajectory_that_has_nothing_to_do_with_its_knots_is_refused(
    known_motion: type, motion: Callable[[float], np.ndarray], problem: str
) -> None:
    with pytest.raises(BrokenContract) as caught:
        knots_kept(known_motion(motion))
    assert str(caught.value) == problem


@pytest.mark.parametrize("threads", [1, 2, 4])
def test_fallback_gets_pairs_that_the_locator_does_not_locate_and_no_others(
    run: Callable, make_level: Callable, threads: int, failing: Callable, make_second: type
) -> None:
    second, third = make_second(), make_second()
    level = make_level(answer=failing(4, 5), fallbacks={"second": second, "third": third})
    found = run(level, graph=GraphSettings(skips=(1.0, 2.0)), threads=threads)
    assert found.n_located == 12
    np.testing.assert_allclose(found.homographies[:, 0, 2], 0.3 * (found.instants - found.instants[6]), atol=1e-9)
    by_second = {(edge.moving, edge.fixed) for edge in found.edges if edge.locator == "second"}
    assert by_second == {(4, 3), (4, 2), (5, 4), (5, 3), (6, 5), (6, 4), (7, 5)}
    assert {edge.locator for edge in found.edges} == {"toy", "second"}
    assert set(second.shown) == {2, 3, 4, 5, 6, 7}
    assert threads > 1 or len(second.shown) == 6  # threads may describe an exposure at the same time
    assert third.shown == []


def test_pair_with_an_implausible_motion_is_refused_or_given_to_a_fallback(
    run: Callable, make_level: Callable, make_second: type
) -> None:
    def mirror(moving: Group, fixed: Group, found: Located) -> Located:
        mirrored = translation(59, 0) @ np.diag([-1.0, 1.0, 1.0])
        return Located(mirrored, evidence={"inliers": 30}) if 40 in (moving.span.start, fixed.span.start) else found

    alone = run(make_level(answer=mirror))
    assert {(edge.motion.reason, edge.motion.evidence["inliers"]) for edge in alone.failures} == {
        ("the homography mirrors or folds the image", 30)
    }
    found = run(make_level(answer=mirror, fallbacks={"second": make_second()}))
    assert [(edge.moving, edge.fixed) for edge in found.edges if edge.locator == "second"] == [(4, 3), (5, 4)]
    assert found.failures == ()


def test_fallback_is_not_believed_where_it_contradicts_pairs_of_the_locator_in_between(
    run: Callable, make_level: Callable, make_second: type
) -> None:
    """Distant exposures share an object rather than the scene: the first locator fails, and the second follows the object."""

    def near(moving: Group, fixed: Group, found: Located) -> Located | NotLocated:
        return found if moving.span.start - fixed.span.start == 10 else NotLocated("lost")

    second = make_second(px_per_frame=-0.5)
    found = run(make_level(answer=near, fallbacks={"second": second}), graph=GraphSettings(skips=(1.0, 4.0)))
    np.testing.assert_allclose(found.homographies[:, 0, 2], 0.3 * (found.instants - found.instants[6]), atol=1e-9)
    reasons = {edge.moving - edge.fixed: edge.motion.reason for edge in found.failures}
    assert reasons[4] == "second: the motion is 32 px from that along the pairs of toy in between"
    assert 1 not in reasons


def test_no_locator_describes_blank_exposures(
    run: Callable, make_level: Callable, failing: Callable, make_second: type
) -> None:
    locator, second = make_second(failing(4)), make_second()
    level = make_level(locator=locator, fallbacks={"second": second})
    merge = level.merger.merge

    class Shuttered:
        def merge(self, source: Any, group: Group, trajectory: Any, scale: float) -> Any:
            exposure = merge(source, group, trajectory, scale)
            return replace(exposure, flux=np.zeros_like(exposure.flux)) if group.span.start == 40 else exposure

    found = run(replace(level, merger=Shuttered()))
    assert sorted(locator.shown) == [0, 1, 2, 3, 5, 6, 7, 8, 9, 10, 11]
    assert second.shown == []
    assert {(edge.locator, edge.motion.reason) for edge in found.failures} == {
        ("", "frames 40 to 49: no pixel detected a photon; is the shutter closed, or is it the wrong file?")
    }
