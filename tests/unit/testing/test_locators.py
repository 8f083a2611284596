from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from photonpano import Located, NotLocated, discover
from photonpano.geometry import inverse, translation
from photonpano.testing import LocatorConformance
from photonpano.testing.stages import StageConformance

DIRECT = discover().find("locator", "direct").contribution


class Honest:
    """A locator of photonpano, for others to break."""

    def __init__(self, context):
        self.locator = DIRECT.build(DIRECT.config(), context)

    def describe(self, exposure):
        return self.locator.describe(exposure)

    def register(self, moving, fixed, initial):
        found = self.locator.register(moving, fixed, initial)
        return self.changed(found) if isinstance(found, Located) else found

    def changed(self, found):
        return found


class Inverse(Honest):
    def changed(self, found):
        return replace(found, homography=inverse(found.homography))


class Unscaled(Honest):
    def changed(self, found):
        return replace(found, homography=found.homography * 2)


class Single(Honest):
    def changed(self, found):
        return replace(found, homography=found.homography.astype(np.float32))


class ShiftsAlone(Honest):
    def changed(self, found):
        x, y = found.homography[:2, 2]
        return replace(found, homography=translation(x, y))


class TrustsItsStart(Honest):
    def register(self, moving, fixed, initial):
        found = super().register(moving, fixed, initial)
        return found if initial is None or isinstance(found, NotLocated) else Located(initial)


class NeedsAStart(Honest):
    def register(self, moving, fixed, initial):
        return NotLocated("there is no start") if initial is None else super().register(moving, fixed, initial)


class SeesHolesAsBlack(Honest):
    def describe(self, exposure):
        weight = np.full_like(exposure.weight, 1000)
        return super().describe(replace(exposure, flux=np.nan_to_num(exposure.flux), weight=weight))


class StandsStill(Honest):
    """Takes a failure for a camera that does not move."""

    def register(self, moving, fixed, initial):
        found = super().register(moving, fixed, initial)
        return Located(np.eye(3)) if isinstance(found, NotLocated) else found


class RaisesOnBlank(Honest):
    def describe(self, exposure):
        if not exposure.weight.any():
            raise ZeroDivisionError("the mean of nothing")
        return super().describe(exposure)


class SaysNothing(Honest):
    def register(self, moving, fixed, initial):
        found = super().register(moving, fixed, initial)
        return NotLocated("") if isinstance(found, NotLocated) else found


class NeedsALargeImage(Honest):
    def describe(self, exposure):
        if exposure.flux.shape[0] < 64:
            raise RuntimeError("the pyramid has no level")
        return super().describe(exposure)


class Boasts(Honest):
    def changed(self, found):
        return replace(found, information=found.information * 1e4)


class LeavesSixAlone(Honest):
    """Finds shifts, and says that the other six may be anything that cameras do."""

    def changed(self, found):
        information = np.zeros((8, 8))
        information[4:6, 4:6] = np.linalg.inv(np.linalg.inv(found.information)[4:6, 4:6])
        return replace(found, homography=translation(*found.homography[:2, 2]), information=information + 1e3 * np.eye(8))


class Covariance(Honest):
    """Gives the covariance in place of its inverse."""

    def changed(self, found):
        return replace(found, information=np.linalg.inv(found.information))


class InDoubt(Honest):
    def changed(self, found):
        return replace(found, information=found.information - 2 * np.diag(np.diag(found.information)))


class OfTheRows(Honest):
    """Orders p1..p8 by rows."""

    def changed(self, found):
        order = [0, 2, 4, 1, 3, 5, 6, 7]
        return replace(found, information=found.information[np.ix_(order, order)])


class CountsNothing(Honest):
    def changed(self, found):
        return replace(found, evidence={"share": float("nan")})


class KeepsTheExposure(Honest):
    def describe(self, exposure):
        return exposure

    def register(self, moving, fixed, initial):
        return super().register(super().describe(moving), super().describe(fixed), initial)


class FillsInPlace(Honest):
    def describe(self, exposure):
        exposure.flux[0, 0] = 0
        return super().describe(exposure)


class WritesAndUndoes(Honest):
    def register(self, moving, fixed, initial):
        if initial is not None:
            initial[2, 2] = 1
        return super().register(moving, fixed, initial)


class LeftToChance(Honest):
    def changed(self, found):
        jitter = 1e-9 * np.random.get_bit_generator().random_raw() / 2**32  # the fault
        return replace(found, homography=found.homography @ translation(jitter, 0))


BROKEN = [
    (
        "test_the_map_takes_pixels_of_moving_to_pixels_of_fixed",
        Inverse,
        "this is the inverse: off by 29.5 px, and by 0.0 px if",
    ),
    ("test_the_map_is_a_homography_with_h33_of_1", Unscaled, "has h33 = 1, got 2: divide by it"),
    ("test_the_map_is_a_homography_with_h33_of_1", Single, "geometry is float64, got a homography of float32"),
    (
        "test_a_known_motion_is_found",
        ShiftsAlone,
        r"a rotation without a start must be found within tolerance_px = 0.5; corners",
    ),
    (
        "test_a_known_motion_is_found",
        NeedsAStart,
        "a sub-pixel shift without a start must be found, .* NotLocated: there is no start",
    ),
    ("test_a_known_motion_is_found_from_a_start_nearby", TrustsItsStart, r"corners are 1.08 px off on average"),
    (
        "test_pixels_that_were_not_seen_are_not_looked_at",
        SeesHolesAsBlack,
        "four fifths of the pixels|masked pixels must not pull",
    ),
    (
        "test_an_image_without_texture_is_not_located",
        StandsStill,
        "where both are flat, register.. must return NotLocated; with",
    ),
    (
        "test_an_image_without_texture_is_not_located",
        RaisesOnBlank,
        "of which both are unseen must not raise; it raised ZeroDi",
    ),
    ("test_an_image_without_texture_is_not_located", SaysNothing, "NotLocated needs a reason"),
    ("test_two_places_that_differ_are_not_located", StandsStill, "images that share nothing must not be located; without a"),
    (
        "test_a_very_small_image_does_not_raise",
        NeedsALargeImage,
        "12x18 px must not raise; it raised RuntimeError: the pyramid",
    ),
    (
        "test_information_is_the_inverse_covariance_of_what_was_found",
        Boasts,
        r"corners err by 0.0\d+ px, and it predicts 0.000\d",
    ),
    ("test_information_is_the_inverse_covariance_of_what_was_found", Covariance, "and it predicts"),
    ("test_information_is_the_inverse_covariance_of_what_was_found", OfTheRows, "in the order of photonpano.geometry.param"),
    (
        "test_information_is_the_inverse_covariance_of_what_was_found",
        InDoubt,
        "is positive definite; its least eigenvalue is -",
    ),
    ("test_residual_and_evidence_can_be_recorded", CountsNothing, "evidence is finite numbers by name; got {'share': nan}"),
    ("test_a_description_does_not_hold_the_exposure", KeepsTheExposure, "what it returned, VirtualExposure.* holds its flux"),
    ("test_exposures_and_starts_are_left_as_they_are", FillsInPlace, "the locator changes an exposure"),
    (
        "test_exposures_and_starts_are_left_as_they_are",
        WritesAndUndoes,
        "fails when the arrays that it is given cannot be writ",
    ),
    ("test_the_same_pair_gives_the_same_bytes", LeftToChance, "registered once more with the same descriptions and described"),
]


@pytest.mark.parametrize(("check", "broken", "words"), BROKEN)
def test_it_is_caught(check, broken, words, catches):
    catches(LocatorConformance, check, broken, words)


def test_every_check_catches_something(checks_of):
    assert checks_of(LocatorConformance, StageConformance) == {check for check, *_ in BROKEN}


def test_what_needs_a_start_passes_if_it_says_so(complaint):
    check = "test_the_map_takes_pixels_of_moving_to_pixels_of_fixed"
    assert complaint(LocatorConformance, check, NeedsAStart, needs_start=True) is None


def test_what_finds_shifts_alone_passes_if_it_says_so(complaint):
    check = "test_a_known_motion_is_found"
    assert complaint(LocatorConformance, check, ShiftsAlone, motions=("shift",), tolerance_px=1.0) is None


def test_what_estimates_a_few_parameters_answers_for_these_if_it_says_so(complaint):
    check = "test_information_is_the_inverse_covariance_of_what_was_found"
    assert "and it predicts" in str(complaint(LocatorConformance, check, LeavesSixAlone, motions=("shift",)))
    assert complaint(LocatorConformance, check, LeavesSixAlone, motions=("shift",), free=(4, 5)) is None
    assert "and it predicts" in str(complaint(LocatorConformance, check, Boasts, motions=("shift",), free=(4, 5)))


def test_what_finds_no_motion_is_held_to_the_rest_if_it_says_so(complaint):
    check = "test_the_map_is_a_homography_with_h33_of_1"
    with pytest.raises(pytest.skip.Exception, match="motions"):
        complaint(LocatorConformance, check, Unscaled, motions=())
    check = "test_two_places_that_differ_are_not_located"
    assert complaint(LocatorConformance, check, Honest, motions=(), shape=(48, 64)) is None
    assert "must not be located" in complaint(LocatorConformance, check, StandsStill, motions=(), shape=(48, 64))
