from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from photonpano import Group, Located, LocationError, NotLocated, PluginError, Trajectory
from photonpano.contracts.information import why_undetermined
from photonpano.contracts.loop import KNOTS, knot_errors, require_valid
from photonpano.contracts.rules import BrokenContract
from photonpano.geometry import jacobian, rescaled, translation

pytestmark = pytest.mark.usefixtures("one_thread")


def test_invalid_motion_is_refused_with_the_name_of_the_locator(run: Callable, make_level: Callable, pan: Callable) -> None:
    with pytest.raises(PluginError) as caught:
        run(make_level(pan(0.3), lambda *_: None))
    problem = "expected Located or NotLocated, got NoneType"
    assert str(caught.value) == f"locator 'toy' of toys 1.0 broke its contract at level 1: {problem}"


def test_valid_motion_is_accepted() -> None:
    for motion in (
        Located(np.eye(3), np.eye(8)),
        Located(rescaled(translation(3, 1), 2)),
        Located(translation(3, 1), evidence={"inliers": np.int64(3), "ncc": np.float32(0.5)}),
        NotLocated("lost", {"matches": 3}),
    ):
        assert require_valid(motion) is motion


def in_whole_pixels(moving: Group, fixed: Group, found: Located) -> Located:
    return replace(found, homography=np.round(found.homography))


STILL = (
    "broke its contract at level 1: every pair that was located is exactly the identity, which a camera that stands still does "
    "not give; a failure is NotLocated"
)


@pytest.mark.parametrize("scale", [1.0, 0.3])
def test_level_is_refused_if_every_pair_is_exactly_the_identity(
    run: Callable, make_level: Callable, pan: Callable, scale: float
) -> None:
    with pytest.raises(PluginError) as caught:
        run(make_level(pan(0.0), scale=scale))
    assert str(caught.value) == f"locator 'toy' of toys 1.0 {STILL}"


def test_all_locators_that_return_the_identity_are_named(
    run: Callable, make_level: Callable, pan: Callable, failing: Callable, make_second: type
) -> None:
    with pytest.raises(PluginError) as caught:
        run(make_level(pan(0.0), failing(4), fallbacks={"second": make_second(pan(0.0))}))
    both = "locator 'toy' of toys 1.0 and locator 'second' of toys 1.0"
    assert str(caught.value) == f"{both} {STILL.replace('its', 'their')}"


def test_nearly_the_identity_is_accepted_for_a_still_camera(run: Callable, make_level: Callable, pan: Callable) -> None:
    def nearly(moving: Group, fixed: Group, found: Located) -> Located:
        return replace(found, homography=found.homography @ translation(1e-4, 0))

    assert run(make_level(pan(0.0), nearly)).n_located == 12


def test_identity_is_accepted_for_small_motion_in_whole_pixels(run: Callable, make_level: Callable, known_motion: type) -> None:
    """Slow at first: pairs are the identity in whole pixels, and the motion known so far is off by 2 px."""
    motion = known_motion(lambda frame: translation(0.001 * frame**2, 0))
    found = run(make_level(motion, in_whole_pixels), known_motion(lambda frame: translation(0.2 * frame, 0)))
    identities = [bool((edge.motion.homography == np.eye(3)).all()) for edge in found.edges]
    assert identities == [True] * 2 + [False] * 9


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_identity_is_refused_if_the_motion_known_so_far_is_large(
    run: Callable, make_level: Callable, pan: Callable, scale: float
) -> None:
    with pytest.raises(PluginError) as caught:
        run(make_level(pan(0.0), scale=scale), pan(0.6))
    assert str(caught.value) == (
        "locator 'toy' of toys 1.0 broke its contract at level 1: got the identity where the motion known so far moves the "
        "corners by 6 px; a failure is NotLocated"
    )


def informed(along_px: float, across_px: float) -> Located:
    """A shift whose expected errors along x and y differ."""
    std = np.array([1e-3, 1e-3, 1e-3, 1e-3, along_px, across_px, 1e-6, 1e-6])
    return Located(translation(3, 1), np.diag(std**-2.0))


def test_motion_that_the_images_do_not_determine_is_told() -> None:
    """The limit is ten times the longer side of a frame."""
    assert why_undetermined(informed(0.1, 100.0), (40, 60)) is None
    assert why_undetermined(informed(0.1, 590.0), (40, 60)) is None
    assert why_undetermined(informed(0.1, 1e4), (40, 60)) == (
        "the images do not determine the motion: its expected error is 1e+04 px at a corner"
    )
    assert why_undetermined(Located(translation(3, 1), residual_px=5e6), (40, 60)) == (
        "the images do not determine the motion: its expected error is 5e+06 px at a corner"
    )
    assert why_undetermined(Located(translation(3, 1)), (40, 60)) is None


def test_correlated_errors_of_small_size_are_determined() -> None:
    """In pixels from the corner, the parameters of a motion of the middle are strongly correlated."""
    points = np.array([[0, 0], [1e4, 0], [1e4, 1e4], [0, 1e4]], dtype=float)
    to_points = jacobian(np.eye(3), points).reshape(8, 8)
    assert why_undetermined(Located(np.eye(3), to_points.T @ to_points / 0.1**2), (40, 60)) is None


def test_pair_that_stripes_leave_undetermined_is_not_located(run: Callable, make_level: Callable, pan: Callable) -> None:
    """Along the stripes, every shift fits."""

    def along_stripes(moving: Group, fixed: Group, found: Located) -> Located:
        return replace(found, information=informed(0.1, 1e7).information)

    with pytest.raises(LocationError) as caught:
        run(make_level(pan(0.3), along_stripes))
    assert str(caught.value).startswith(
        "level 1: none of the 30 pairs of exposures could be located\n"
        "  frames 10 to 19 onto frames 0 to 9: the images do not determine the motion: its expected error is 1e+07 px at a "
        "corner\n"
    )


PLACES = np.array([translation(5.0 * index, 0) for index in range(9)])


def knots_kept(trajectory: Trajectory, std_px: float = 0.05) -> None:
    KNOTS.require(knot_errors(trajectory, np.arange(0, 90, 10.0), PLACES, np.full(9, std_px), (40, 60)))


def test_trajectory_may_smooth_its_knots_and_miss_outliers(known_motion: type) -> None:
    def smoothed(frame: float) -> np.ndarray:
        return translation(0.5 * frame + 0.9 * np.sin(frame) + 300 * (frame > 55), 0)

    knots_kept(known_motion(smoothed))
    knots_kept(known_motion(lambda frame: translation(0.5 * frame + 15, 0)), std_px=2.0)


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
