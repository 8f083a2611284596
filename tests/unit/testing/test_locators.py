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

    def __init__(self, context, locator=None):
        self.locator = locator or DIRECT.build(DIRECT.config(), context)

    def describe(self, exposure):
        return self.locator.describe(exposure)

    def register(self, moving, fixed, initial):
        found = self.locator.register(moving, fixed, initial)
        return self.changed(found) if isinstance(found, Located) else found

    def changed(self, found):
        return found


class HoldsAFunction(Honest):
    def __init__(self, context, locator=None):
        super().__init__(context, locator)
        self.gain = lambda flux: flux


class DescribesByAFunction(Honest):
    def describe(self, exposure):
        described = super().describe(exposure)
        return lambda: described

    def register(self, moving, fixed, initial):
        return super().register(moving(), fixed(), initial)


class ForgetsOnItsWay(Honest):
    way = 0

    def __setstate__(self, state):
        self.__dict__ |= state
        self.way = 1e-6

    def changed(self, found):
        return replace(found, homography=translation(self.way, 0) @ found.homography)


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


class TurnsTheOtherWay(Honest):
    def turning(self, camera_matrix):
        return Inverse(None, self.locator)


class TurnsAnything(Honest):
    def turning(self, camera_matrix):
        return StandsStill(None, self.locator)


class SeesHolesAsBlack(Honest):
    """The holes stand still in both images, and pull the motion towards none."""

    def describe(self, exposure):
        return super().describe(exposure), np.mean(exposure.weight == 0)

    def register(self, moving, fixed, initial):
        found = super().register(moving[0], fixed[0], initial)
        if isinstance(found, NotLocated):
            return found
        pulled = found.homography.copy()
        pulled[:2, 2] *= 1 - moving[1]
        return replace(found, homography=pulled)


class StandsStill(Honest):
    """Returns an identity for a failure."""

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
    """Estimates shifts, with little information on the other six parameters."""

    def changed(self, found):
        information = np.zeros((8, 8))
        information[4:6, 4:6] = np.linalg.inv(np.linalg.inv(found.information)[4:6, 4:6])
        return replace(found, homography=translation(*found.homography[:2, 2]), information=information + 1e3 * np.eye(8))


class Covariance(Honest):
    """Returns the covariance instead of its inverse."""

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
    ("test_locator_works_in_other_processes", HoldsAFunction, "a locator must survive pickling, so that other processes"),
    ("test_locator_works_in_other_processes", DescribesByAFunction, r"the result of describe\(\) must survive pickling"),
    ("test_locator_works_in_other_processes", ForgetsOnItsWay, "a pickled copy of the locator gives others"),
    (
        "test_homography_maps_moving_to_fixed",
        Inverse,
        "this one is the inverse: its error is 29.5 px, and 0.0 px the",
    ),
    ("test_homography_is_float64_with_h33_of_1", Unscaled, "must have h33 = 1, got 2: divide by it"),
    ("test_homography_is_float64_with_h33_of_1", Single, "geometry must be float64, got a homography of float32"),
    (
        "test_register_finds_motion_without_start",
        ShiftsAlone,
        "the rotation without a start must be estimated within tolerance_px = 0.5; its mean corner",
    ),
    (
        "test_register_finds_motion_without_start",
        NeedsAStart,
        "the sub-pixel shift without a start, .* must be located; .* NotLocated: there is no start",
    ),
    ("test_register_finds_motion_from_nearby_start", TrustsItsStart, "its mean corner error is 1.08 px"),
    (
        "test_unseen_pixels_have_no_influence",
        SeesHolesAsBlack,
        "a fifth of the pixels is masked|masked pixels must have no influence",
    ),
    (
        "test_image_without_texture_is_not_located",
        StandsStill,
        "where both are flat, register.. must return NotLocated; with",
    ),
    (
        "test_image_without_texture_is_not_located",
        RaisesOnBlank,
        "of which both are unseen must not raise; it raised ZeroDi",
    ),
    ("test_image_without_texture_is_not_located", SaysNothing, "NotLocated needs a reason"),
    ("test_different_places_are_not_located", StandsStill, "images of different places must not be located; without a"),
    ("test_turning_locates_turns_and_nothing_else", TurnsTheOtherWay, r"a turn is \d+\.\d+ px off"),
    ("test_turning_locates_turns_and_nothing_else", TurnsAnything, "must not be located as a turn"),
    (
        "test_very_small_image_does_not_raise",
        NeedsALargeImage,
        "12x18 px must not raise; it raised RuntimeError: the pyramid",
    ),
    (
        "test_information_is_inverse_covariance_of_errors",
        Boasts,
        r"the corner error is 0.0\d+ px, and it predicts 0.000\d",
    ),
    ("test_information_is_inverse_covariance_of_errors", Covariance, "and it predicts"),
    ("test_information_is_inverse_covariance_of_errors", OfTheRows, "in the order of photonpano.geometry.param"),
    (
        "test_information_is_inverse_covariance_of_errors",
        InDoubt,
        "must be positive definite; its smallest eigenvalue is -",
    ),
    *(
        (
            "test_answers_pass_the_checks_of_a_run",
            type("Broken", (Honest,), {"changed": lambda _, found, wrong=wrong: replace(found, **wrong(found))}),
            f"a run refuses the answer for the sub-pixel shift: {words}",
        )
        for wrong, words in (
            (lambda _: {"residual_px": -5.0}, "residual_px is a finite number of at least 0"),
            (lambda _: {"residual_px": "small"}, "residual_px is a finite number of at least 0"),
            (
                lambda found: {"homography": found.homography.tolist()},
                r"a homography is a \(3, 3\) array of float64, got a list",
            ),
            (lambda found: {"homography": found.homography + 0j}, r"a homography is a .* got \(3, 3\) of complex128"),
        )
    ),
    ("test_residual_and_evidence_are_finite", CountsNothing, "evidence must be finite numbers by name; got {'share': nan}"),
    ("test_description_does_not_hold_exposure", KeepsTheExposure, "VirtualExposure.*, which it returned, refers to its flux"),
    ("test_register_leaves_inputs_unchanged", FillsInPlace, "the locator modifies an exposure"),
    (
        "test_register_leaves_inputs_unchanged",
        WritesAndUndoes,
        "fails with read-only arrays",
    ),
    ("test_register_is_deterministic", LeftToChance, "registered again with the same descriptions and described"),
]


@pytest.mark.parametrize(("check", "broken", "words"), BROKEN)
def test_check_fails_on_broken_component(check, broken, words, catches):
    catches(LocatorConformance, check, broken, words)


def test_every_check_has_a_broken_component(checks_of):
    assert checks_of(LocatorConformance, StageConformance) == {check for check, *_ in BROKEN}


def test_locator_that_needs_start_passes_with_needs_start(failure):
    check = "test_homography_maps_moving_to_fixed"
    assert failure(LocatorConformance, check, NeedsAStart, needs_start=True) is None


def test_locator_of_shifts_passes_with_motions(failure):
    check = "test_register_finds_motion_without_start"
    assert failure(LocatorConformance, check, ShiftsAlone, motions=("shift",), tolerance_px=1.0) is None


def test_information_is_compared_for_free_parameters_only(failure):
    check = "test_information_is_inverse_covariance_of_errors"
    assert "and it predicts" in str(failure(LocatorConformance, check, LeavesSixAlone, motions=("shift",)))
    assert failure(LocatorConformance, check, LeavesSixAlone, motions=("shift",), free=(4, 5)) is None
    assert "and it predicts" in str(failure(LocatorConformance, check, Boasts, motions=("shift",), free=(4, 5)))


def test_locator_without_motions_skips_checks_of_motion_only(failure):
    check = "test_homography_is_float64_with_h33_of_1"
    with pytest.raises(pytest.skip.Exception, match="motions"):
        failure(LocatorConformance, check, Unscaled, motions=())
    check = "test_different_places_are_not_located"
    assert failure(LocatorConformance, check, Honest, motions=(), shape=(48, 64)) is None
    assert "must not be located" in failure(LocatorConformance, check, StandsStill, motions=(), shape=(48, 64))
