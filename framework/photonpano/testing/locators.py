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

from photonpano.contracts.requirements import require_motion
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
from photonpano.testing.captures import Scene, photographed, read_only, rolled
from photonpano.testing.conformance import Answer, AnswerConformance, copied, fingerprint, global_seed, in_threads, passing
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
    """Checks of a locator on pairs of exposures of 1,000 frames each."""

    kind: ClassVar[str] = "locator"

    contribution: LocatorContribution
    tolerance_px: float = 0.5  # largest error of a motion, as the mean over the corners of the image
    # those of "sub-pixel shift", "shift", "rotation" and "homography" that it estimates; none for an untrained network
    motions: tuple[str, ...] = tuple(MOTIONS)
    # indices, from 0, of the parameters p1..p8 that it estimates; the information is compared with their errors
    free: tuple[int, ...] = tuple(range(8))
    # (height, width) of the exposures. The motions suit 144x192 px; use less for a slow locator without motions
    shape: tuple[int, int] = SHAPE
    needs_start: bool = False  # whether it only refines a start that is at most a few px off
    # largest ratio of the errors predicted by the information to the actual ones, or the inverse
    information_factor: float = 3.0

    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        """Parametrise checks with the motions of the locator."""
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

    def answers(self) -> Iterator[Answer]:
        """Yield the answer for each motion, and for images without texture."""
        for motion in self.motions:
            found = self.registered(*pair(motion, self.shape), self._start(motion))
            yield f"the answer for the {motion}", found, require_motion
        for what in _BLANK:
            found = self.registered(_blank(what, self.shape, 1), _blank(what, self.shape, 2))
            yield f"the answer for {what} images", found, require_motion

    @pytest.mark.parametrize("near", [False, True], ids=["without a start", "from a nearby start"])
    def test_register_finds_motion(self, motion: str, near: bool) -> None:
        """As at the first level, and at all later ones."""
        if self.needs_start and not near:
            pytest.skip("needs_start = True")
        self._require_accuracy(self.registered(*pair(motion, self.shape), nearby(motion) if near else None), motion)

    def test_unseen_pixels_have_no_influence(self) -> None:
        """They are NaN at the same places of both images, as on a sensor, and must not pull the motion towards 0."""
        self._require_motions()
        height, width = self.shape
        unseen = np.random.default_rng(11).random(self.shape) < 0.01
        unseen[:, : width // 10] = unseen[2 * height // 3 : 5 * height // 6, 2 * width // 5 : 3 * width // 5] = True
        images = views("shift", self.shape)
        moving, fixed = (photographed(flux, seed=seed, unseen=unseen) for seed, flux in enumerate(images))
        self._require_accuracy(self.registered(moving, fixed, self._start("shift")), "shift")

    @pytest.mark.parametrize("what", _BLANK)
    def test_image_without_texture_is_not_located(self, what: str) -> None:
        """Failure is a value with a reason, never an exception and never an identity matrix."""
        blank, other, scene = _blank(what, self.shape, 1), _blank(what, self.shape, 2), pair("shift", self.shape)[1]
        register = self.registering()
        for moving, fixed in ((blank, other), (blank, scene), (scene, blank)):
            for initial in (None, STILL):
                found = register(moving, fixed, initial)
                assert isinstance(found, NotLocated), f"{what} images must not be located"
                assert found.reason.strip(), "NotLocated needs a reason: a clause with the numbers behind it"

    def test_different_places_are_not_located(self) -> None:
        """The images have nothing in common: compare them after registration, or count inliers."""
        register = self.registering()
        for initial in (None, STILL):
            found = register(*self._different(), initial)
            assert isinstance(found, NotLocated), "images of different places must not be located"

    def test_very_small_image_does_not_raise(self) -> None:
        """A coarse level of a small camera has few pixels."""
        moving, fixed = (photographed(Scene().view(translation(x, 0), (12, 18)), seed=x) for x in (1, 0))
        with passing("the answer for 12x18 px"):
            require_motion(self.registered(moving, fixed))

    def test_information_is_inverse_covariance_of_errors(self) -> None:
        """It is the weight of a pair in the motion graph, of p1..p8 in the order of `photonpano.geometry.parameters`."""
        self._require_motions()
        motion, free = self.motions[0], list(self.free)
        true, errors, predicted = MOTIONS[motion], [], []
        register, frame = self.registering(), corners(self.shape)
        for seed in range(_PAIRS):
            found = register(*pair(motion, self.shape, seed), true)
            assert isinstance(found, Located), f"the {motion} must be located from the true start"
            if found.information is None:
                pytest.skip("the locator has no information")
            with passing("the answer for a pair"):
                require_motion(found)
            matrix, to_corners = found.information, jacobian(found.homography, frame).reshape(8, 8)
            # Expected corner error, given the parameters that are not estimated, which are exact here.
            covariance = np.linalg.inv(matrix[np.ix_(free, free)])
            predicted.append(np.trace(to_corners[:, free] @ covariance @ to_corners[:, free].T))
            errors.append(np.sum((transform_points(found.homography, frame) - transform_points(true, frame)) ** 2))
        ratio = float(np.sqrt(np.mean(errors) / np.mean(predicted)))
        assert 1 / self.information_factor < ratio < self.information_factor, "actual corner error over the one it predicts"

    def test_turning_locates_turns_and_nothing_else(self) -> None:
        """A shift is a turn before a camera of long focal length."""
        locator = self.built_for_exposures()
        if not hasattr(locator, "turning"):
            pytest.skip("the locator does not use the camera")
        turning = locator.turning(Camera.of(100 * max(self.shape), self.shape).matrix)
        found, other = (
            turning.register(*map(turning.describe, exposures), initial)
            for exposures, initial in ((pair("shift", self.shape), self._start("shift")), (self._different(), None))
        )
        with passing("the answer for a turn"):
            require_motion(found)
        self._require_accuracy(found, "shift")
        assert isinstance(other, NotLocated), "images of different places must not be located as a turn"

    def test_description_does_not_hold_exposure(self) -> None:
        """Descriptions of many exposures are kept at once."""
        locator = self.built_for_exposures()
        exposure = pair("shift", self.shape)[0]
        image = weakref.ref(exposure.flux)
        described = locator.describe(exposure)
        del exposure
        gc.collect()
        assert image() is None, f"describe() must not keep the exposure; {described!r:.60} refers to its flux"

    def test_register_is_deterministic(self) -> None:
        """It depends neither on earlier calls, nor on the thread, nor on numpy's global generator, nor on the process."""
        locator, initial = self.built_for_exposures(), nearby("shift")
        moving, fixed = (locator.describe(each) for each in pair("shift", self.shape))
        with global_seed(1):
            expected = fingerprint(locator.register(moving, fixed, initial))
        locator.register(fixed, moving, None)
        again = fingerprint(locator.register(moving, fixed, initial))
        assert again == expected, "registered again with the same descriptions, the motion differs"
        anew = fingerprint(self.registered(*pair("shift", self.shape), initial))
        assert anew == expected, "described and registered anew, the motion differs"
        threads = in_threads(lambda _: fingerprint(locator.register(moving, fixed, initial)))
        assert {*threads} == {expected}, "in several threads at once, the motion differs"
        copy, described = copied(locator, "a locator"), copied((moving, fixed), "the result of describe()")
        elsewhere = fingerprint(copy.register(*described, initial))
        assert elsewhere == expected, "a pickled copy, as another process gets it, finds another motion"

    def _different(self) -> tuple[VirtualExposure, VirtualExposure]:
        first, second = (photographed(Scene(seed).view(STILL, self.shape), seed=seed) for seed in (21, 22))
        return first, second

    def _require_motions(self) -> None:
        if not self.motions:
            pytest.skip("motions = ()")

    def _start(self, motion: str) -> Homography | None:
        return nearby(motion) if self.needs_start else None

    def _require_accuracy(self, found: object, motion: str) -> None:
        """Require a motion to be found, from moving to fixed."""
        assert isinstance(found, Located), f"the {motion} must be located, got {found!r:.300}"
        error_px = self._error(found.homography, MOTIONS[motion])
        if error_px > self.tolerance_px:
            backwards_px = self._error(found.homography, inverse(MOTIONS[motion]))
            assert error_px < backwards_px, "the homography must map pixels of `moving` to `fixed`; return its inverse"
        assert error_px <= self.tolerance_px, f"mean corner error of the {motion}, more than tolerance_px"

    def _error(self, found: Homography, true: Homography) -> float:
        return float(corner_displacements(found, true, self.shape).mean())


def nearby(motion: str) -> Homography:
    """Return a start about 1 px away from a motion."""
    return read_only(translation(0.9, -0.6) @ MOTIONS[motion])


@cache
def views(motion: str, shape: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """Return the flux of the moving and of the fixed image."""
    scene = Scene(seed=1)
    return scene.view(_PLACE @ MOTIONS[motion], shape), scene.view(_PLACE, shape)


def pair(motion: str, shape: tuple[int, int] = SHAPE, seed: int = 0) -> tuple[VirtualExposure, VirtualExposure]:
    """Return a moving and a fixed exposure, which are read-only; `seed` is that of the photon noise."""
    moving, fixed = (photographed(flux, seed=2 * seed + number) for number, flux in enumerate(views(motion, shape)))
    return _read_only(moving), _read_only(fixed)


def _read_only(exposure: VirtualExposure) -> VirtualExposure:
    return replace(exposure, flux=read_only(exposure.flux), weight=read_only(exposure.weight))


def _blank(what: str, shape: tuple[int, int], seed: int) -> VirtualExposure:
    return photographed(np.full(shape, _BLANK[what]), seed=seed, unseen=np.full(shape, what == "unseen"))
