"""Checks of locators."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import cache
from typing import Any, ClassVar

import numpy as np
import pytest

from photonpano.contracts.loop import LOCATED, NOT_LOCATED, contract_for
from photonpano.contracts.protocols import LocatesTurns
from photonpano.geometry import (
    Camera,
    corner_displacements,
    corners,
    from_parameters,
    inverse,
    jacobian,
    transform_points,
    translation,
)
from photonpano.plugins.contributions import LocatorContribution
from photonpano.testing.captures import photographed, read_only, rolled
from photonpano.testing.conformance import must_not_raise, passing
from photonpano.testing.sameness import copied, fingerprint, global_seed, in_threads
from photonpano.testing.scenes import Scene
from photonpano.testing.stages import Answer, AnswerConformance, accepts_read_only
from photonpano.values import FloatArray, Homography, Located, NotLocated, StreamInfo, VirtualExposure

SHAPE = (144, 192)
STILL = np.eye(3)
_PLACE = translation(-400.0, 250.0)
_PAIRS = 6  # pairs whose errors are compared with the information, eight numbers each
_BLANK = {"flat": 0.4, "dark": 0.0, "saturated": 50.0, "unseen": 0.4}  # flux of images without texture


# Maps from pixels of the moving image to pixels of the fixed one; the rotation is about the centre of 144x192 px.
MOTIONS: Mapping[str, Homography] = {
    "sub-pixel shift": translation(0.3, -0.2),
    "shift": translation(13.25, -6.5),
    "rotation": translation(4.0, -2.0) @ rolled(3.0, SHAPE),
    "homography": from_parameters([0.02, 0.006, -0.01, 0.03, -6.0, 3.5, 4e-5, -6e-5]),
}


class LocatorConformance(AnswerConformance):
    """Checks of a locator on pairs of exposures of 1,000 frames each.

    Attributes:
        tolerance_px: largest error of a motion, as the mean over the corners of the image.
        motions: those of "sub-pixel shift", "shift", "rotation" and "homography" that it estimates; none for an untrained
            network.
        free: indices, from 0, of the parameters p1..p8 that it estimates; the information is compared with their errors.
        shape: (height, width) of the exposures. The motions suit 144x192 px; use less for a slow locator without motions.
        needs_start: whether it only refines a start that is at most a few px off.
        information_factor: largest ratio of the errors predicted by the information to the actual ones, or the inverse.
    """

    kind: ClassVar[str] = "locator"
    contracts = (LOCATED, NOT_LOCATED)

    contribution: LocatorContribution
    tolerance_px: float = 0.5
    motions: tuple[str, ...] = tuple(MOTIONS)
    free: tuple[int, ...] = tuple(range(8))
    shape: tuple[int, int] = SHAPE
    needs_start: bool = False
    information_factor: float = 3.0

    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        """Parametrise checks with the motions of the locator, and with the rules of the contract."""
        super().pytest_generate_tests(metafunc)
        if "motion" in metafunc.fixturenames:
            metafunc.parametrize("motion", self.motions)

    def built_for_exposures(self) -> Any:
        """Build the locator for a capture whose frames have the size of the exposures."""
        return self.built(StreamInfo(2000, *self.shape, frame_rate_hz=96_800.0))

    def registering(self) -> Callable[[VirtualExposure, VirtualExposure, Homography | None], Any]:
        """Return a function that registers exposures with a new locator and describes each exposure once."""
        locator = self.built_for_exposures()
        describe = cache(locator.describe)
        return lambda moving, fixed, initial: locator.register(describe(moving), describe(fixed), initial)

    def registered(self, moving: VirtualExposure, fixed: VirtualExposure, initial: Homography | None = None) -> Any:
        """Describe and register a pair with a new locator."""
        return self.registering()(moving, fixed, initial)

    def located(self, motion: str, initial: Homography | None) -> Located:
        """Register a pair, and require that it is located."""
        found = self.registered(*pair(motion, self.shape), initial)
        assert isinstance(found, Located | NotLocated), f"register() must return Located or NotLocated, got {found!r:.80}"
        assert isinstance(found, Located), (
            f"the {motion} {_started(initial)}, by {self._error(STILL, MOTIONS[motion]):.1f} px on average, must be located; "
            f"the locator returned NotLocated: {found.reason}"
        )
        return found

    def answers(self) -> Iterator[Answer]:
        """Yield the answer for each motion, and for images without texture."""
        for motion in self.motions:
            found = self.registered(*pair(motion, self.shape), self._start(motion))
            yield f"the answer for the {motion}", contract_for(found), found, None
        for what in _BLANK:
            found = self.registered(_blank(what, self.shape, 1), _blank(what, self.shape, 2))
            yield f"the answer for {what} images", contract_for(found), found, None

    def test_homography_maps_moving_to_fixed(self) -> None:
        """Not the other way around."""
        self._require_motions()
        motion = max(self.motions, key=lambda name: self._error(STILL, MOTIONS[name]))
        true = MOTIONS[motion]
        found = self.located(motion, self._start(motion)).homography
        forwards, backwards = self._error(found, true), self._error(found, inverse(true))
        assert forwards < backwards, (
            "the homography must map pixels of `moving` to pixels of `fixed`, and this one is the inverse: its error is "
            f"{forwards:.1f} px, and {backwards:.1f} px the other way around. Return its inverse"
        )

    def test_register_finds_motion_without_start(self, motion: str) -> None:
        """As at the first level."""
        if self.needs_start:
            pytest.skip("needs_start = True")
        self._require_accuracy(motion, None)

    def test_register_finds_motion_from_nearby_start(self, motion: str) -> None:
        """As at all later levels."""
        self._require_accuracy(motion, nearby(motion))

    def test_unseen_pixels_have_no_influence(self) -> None:
        """They are NaN at the same places of both images, as on a sensor, and must not pull the motion towards 0."""
        self._require_motions()
        motion = "shift"
        true = MOTIONS[motion]
        height, width = self.shape
        unseen = np.random.default_rng(11).random(self.shape) < 0.01
        unseen[:, : width // 10] = unseen[2 * height // 3 : 5 * height // 6, 2 * width // 5 : 3 * width // 5] = True
        images = views(motion, self.shape)
        moving, fixed = (photographed(flux, seed=seed, unseen=unseen) for seed, flux in enumerate(images))
        found = must_not_raise("register() of exposures with NaN pixels", self.registered, moving, fixed, self._start(motion))
        assert isinstance(found, Located), (
            f"exposures of which a fifth of the pixels is masked must be located; not located: {found.reason}"
        )
        error = self._error(found.homography, true)
        assert error <= self.tolerance_px, (
            f"masked pixels must have no influence; with a fifth of the pixels masked in both images, the {motion} is "
            f"{error:.2f} px off (tolerance_px = {self.tolerance_px:g}), and {self._error(found.homography, STILL):.2f} px "
            "from no motion"
        )

    @pytest.mark.parametrize("what", _BLANK)
    def test_image_without_texture_is_not_located(self, what: str) -> None:
        """Failure is a value with a reason, never an exception and never an identity matrix."""
        blank, other, scene = _blank(what, self.shape, 1), _blank(what, self.shape, 2), pair("shift", self.shape)[1]
        register = self.registering()
        for name, moving, fixed in (("both are", blank, other), ("`moving` is", blank, scene), ("`fixed` is", scene, blank)):
            for initial in (None, STILL):
                found = must_not_raise(f"register() of exposures of which {name} {what}", register, moving, fixed, initial)
                assert isinstance(found, NotLocated), (
                    f"where {name} {what}, register() must return NotLocated; {_started(initial)} it returned {found!r:.300}"
                )
                assert found.reason.strip(), "NotLocated needs a reason: a clause with the numbers behind it"

    def test_different_places_are_not_located(self) -> None:
        """The images have nothing in common."""
        moving, fixed = (photographed(Scene(seed).view(STILL, self.shape), seed=seed) for seed in (21, 22))
        register = self.registering()
        for initial in (None, STILL):
            found = must_not_raise("register() of two different places", register, moving, fixed, initial)
            assert isinstance(found, NotLocated), (
                f"images of different places must not be located; {_started(initial)} the locator returned {found!r:.300}. "
                "Compare the images after registration, or count inliers"
            )

    def test_very_small_image_does_not_raise(self) -> None:
        """A coarse level of a small camera has few pixels."""
        moving, fixed = (photographed(Scene().view(translation(x, 0), (12, 18)), seed=x) for x in (1, 0))
        found = must_not_raise("register() of exposures of 12x18 px", self.registered, moving, fixed)
        assert isinstance(found, Located | NotLocated), f"register() must return Located or NotLocated, got {found!r:.80}"

    def test_information_is_inverse_covariance_of_errors(self) -> None:
        """It is the weight of a pair in the motion graph."""
        self._require_motions()
        motion, free = self.motions[0], list(self.free)
        true, errors, predicted = MOTIONS[motion], [], []
        register, frame = self.registering(), corners(self.shape)
        for seed in range(_PAIRS):
            found = register(*pair(motion, self.shape, seed), true)
            assert isinstance(found, Located), f"the {motion} must be located from the true start; not located: {found.reason}"
            if found.information is None:
                pytest.skip("the locator has no information")
            with passing("the answer for a pair"):
                LOCATED.require(found)
            matrix, to_corners = found.information, jacobian(found.homography, frame).reshape(8, 8)
            # Expected corner error, given the parameters that are not estimated, which are exact here.
            covariance = np.linalg.inv(matrix[np.ix_(free, free)])
            predicted.append(np.trace(to_corners[:, free] @ covariance @ to_corners[:, free].T))
            errors.append(np.sum((transform_points(found.homography, frame) - transform_points(true, frame)) ** 2))
        actual_px, expected_px = (float(np.sqrt(np.mean(squares) / 4)) for squares in (errors, predicted))
        ratio = actual_px / expected_px
        assert 1 / self.information_factor < ratio < self.information_factor, (
            f"information must be the inverse covariance of p1..p8, in the order of photonpano.geometry.parameters; over "
            f"{_PAIRS} pairs the corner error is {actual_px:.3g} px, and it predicts {expected_px:.3g} px "
            f"(they may differ by a factor of {self.information_factor:g})"
        )

    def test_turning_locates_turns_and_nothing_else(self) -> None:
        """A shift is a turn before a camera of long focal length."""
        locator = self.built_for_exposures()
        if not isinstance(locator, LocatesTurns):
            pytest.skip("the locator does not use the camera")
        turning = locator.turning(Camera.of(100 * max(self.shape), self.shape).matrix)
        different = [photographed(Scene(seed).view(STILL, self.shape), seed=seed) for seed in (21, 22)]
        for exposures, fits in ((pair("shift", self.shape), True), (different, False)):
            initial = self._start("shift") if fits else None
            found = must_not_raise("register() of a turn", turning.register, *map(turning.describe, exposures), initial)
            if not fits:
                assert isinstance(found, NotLocated), (
                    f"images of different places must not be located as a turn: {found!r:.300}"
                )
                continue
            assert isinstance(found, Located), f"a turn must be located; not located: {found.reason}"
            with passing("the answer for a turn"):
                LOCATED.require(found)
            error = self._error(found.homography, MOTIONS["shift"])
            assert error <= self.tolerance_px, f"a turn is {error:.2f} px off (tolerance_px = {self.tolerance_px:g})"

    def test_description_does_not_hold_exposure(self) -> None:
        """Descriptions of many exposures are kept at once."""
        locator = self.built_for_exposures()
        exposure = pair("shift", self.shape)[0]
        image = weakref.ref(exposure.flux)
        described = locator.describe(exposure)
        del exposure
        gc.collect()
        assert image() is None, (
            f"describe() must not keep the exposure; {described!r:.60}, which it returned, refers to its flux"
        )

    def test_register_leaves_inputs_unchanged(self) -> None:
        """The framework uses exposures and starts again."""
        exposures, initial = pair("shift", self.shape), nearby("shift")
        before = fingerprint((exposures, initial))
        self.registered(*exposures, initial)
        same = fingerprint((exposures, initial)) == before
        assert same, "the locator modifies an exposure, or `initial`; copy an array before you change it"
        with accepts_read_only("the locator"):
            self.registered(_read_only(exposures[0]), _read_only(exposures[1]), read_only(initial))

    def test_register_is_deterministic(self) -> None:
        """It depends neither on earlier calls, nor on the thread, nor on numpy's global generator."""
        locator = self.built_for_exposures()
        moving, fixed = (locator.describe(each) for each in pair("shift", self.shape))
        initial = nearby("shift")
        with global_seed(1):
            expected = fingerprint(locator.register(moving, fixed, initial))
        locator.register(fixed, moving, None)
        others = {
            "registered again with the same descriptions": fingerprint(locator.register(moving, fixed, initial)),
            "described and registered anew": fingerprint(self.registered(*pair("shift", self.shape), initial)),
        }
        for number, found in enumerate(in_threads(lambda _: fingerprint(locator.register(moving, fixed, initial)))):
            others[f"in thread {number} of several at once"] = found
        wrong = [how for how, found in others.items() if found != expected]
        assert not wrong, f"the same pair must give the same bytes; {' and '.join(wrong)}, it gives others"

    def test_locator_works_in_other_processes(self) -> None:
        """An executor may send it, and what it makes of an exposure, to other processes and machines."""
        locator = self.built_for_exposures()
        described = [locator.describe(each) for each in pair("shift", self.shape)]
        initial = nearby("shift")
        copy = copied(locator, "a locator")
        expected = fingerprint(locator.register(*described, initial))
        found = fingerprint(copy.register(*copied(described, "the result of describe()"), initial))
        assert found == expected, "the same pair must give the same bytes; a pickled copy of the locator gives others"

    def _require_motions(self) -> None:
        if not self.motions:
            pytest.skip("motions = ()")

    def _start(self, motion: str) -> Homography | None:
        return nearby(motion) if self.needs_start else None

    def _require_accuracy(self, motion: str, initial: Homography | None) -> None:
        error = self._error(self.located(motion, initial).homography, MOTIONS[motion])
        assert error <= self.tolerance_px, (
            f"the {motion} {_started(initial)} must be estimated within tolerance_px = {self.tolerance_px:g}; its mean corner "
            f"error is {error:.3g} px (that of no motion is {self._error(STILL, MOTIONS[motion]):.3g} px)"
        )

    def _error(self, found: Homography, true: Homography) -> float:
        return float(corner_displacements(found, true, self.shape).mean())


def nearby(motion: str) -> Homography:
    """Return a start about 1 px away from a motion."""
    return translation(0.9, -0.6) @ MOTIONS[motion]


@cache
def views(motion: str, shape: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """Return the flux of the moving and of the fixed image."""
    scene = Scene(seed=1)
    return scene.view(_PLACE @ MOTIONS[motion], shape), scene.view(_PLACE, shape)


def pair(motion: str, shape: tuple[int, int] = SHAPE, seed: int = 0) -> tuple[VirtualExposure, VirtualExposure]:
    """Return a moving and a fixed exposure; `seed` is that of the photon noise."""
    moving, fixed = views(motion, shape)
    return photographed(moving, seed=2 * seed), photographed(fixed, seed=2 * seed + 1)


def _blank(what: str, shape: tuple[int, int], seed: int) -> VirtualExposure:
    return photographed(np.full(shape, _BLANK[what]), seed=seed, unseen=np.full(shape, what == "unseen"))


def _read_only(exposure: VirtualExposure) -> VirtualExposure:
    return replace(exposure, flux=read_only(exposure.flux), weight=read_only(exposure.weight))


def _started(initial: Homography | None) -> str:
    return "without a start" if initial is None else "from a start"
