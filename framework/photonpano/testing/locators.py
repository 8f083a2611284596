"""What locators promise."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, ClassVar

import numpy as np
import pytest

from photonpano.contributions import LocatorContribution
from photonpano.geometry import apply, corner_displacements, corners, from_parameters, inverse, jacobian, translation
from photonpano.testing.captures import photographed, read_only
from photonpano.testing.conformance import raising_nothing
from photonpano.testing.sameness import fingerprint, global_chance, in_threads
from photonpano.testing.scenes import Scene
from photonpano.testing.stages import StageConformance, unharmed
from photonpano.values import FloatArray, Homography, Located, NotLocated, StreamInfo, VirtualExposure

SHAPE = (144, 192)
STILL = np.eye(3)
_PLACE = translation(-400.0, 250.0)
_PAIRS = 6
"""Errors of so many pairs are compared with what the information says: eight numbers each."""


def _rolled(degrees: float) -> Homography:
    angle = np.deg2rad(degrees)
    cos, sin = np.cos(angle), np.sin(angle)
    centre = translation((SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2)
    turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    return np.asarray(centre @ turn @ np.linalg.inv(centre))


MOTIONS: Mapping[str, Homography] = {
    "sub-pixel shift": translation(0.3, -0.2),
    "shift": translation(13.25, -6.5),
    "rotation": translation(4.0, -2.0) @ _rolled(3.0),
    "homography": from_parameters([0.02, 0.006, -0.01, 0.03, -6.0, 3.5, 4e-5, -6e-5]),
}
"""Pixels of the moving image to pixels of the fixed one; the roll is about the centre of 144x192 px."""


class LocatorConformance(StageConformance):
    """Checks of a locator on pairs of exposures, each with the photons of 1,000 frames.

    Attributes:
        contribution: what is tested.
        config: keys under `with`.
        tolerance_px: how far off a motion may be, on average over the corners of the image.
        motions: those of "sub-pixel shift", "shift", "rotation" and "homography" that it can find; none for a network whose
            weights are made up for the tests.
        free: which of p1..p8 it estimates, counted from 0; its information is compared with the errors of these.
        shape: (height, width) of the exposures; the motions suit 144x192 px, and less is for what is slow and finds none.
        needs_start: whether it only refines, and finds nothing that is further off than a few px.
        information_factor: by how much the errors that its information predicts may differ from those that it makes.
    """

    kind: ClassVar[str] = "locator"
    methods: ClassVar[tuple[str, ...]] = ("describe", "register")

    contribution: LocatorContribution
    tolerance_px: float = 0.5
    motions: tuple[str, ...] = tuple(MOTIONS)
    free: tuple[int, ...] = tuple(range(8))
    shape: tuple[int, int] = SHAPE
    needs_start: bool = False
    information_factor: float = 3.0

    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        """Check what the locator is made for."""
        if "motion" in metafunc.fixturenames:
            metafunc.parametrize("motion", self.motions)

    def built_for_exposures(self) -> Any:
        """Build the locator for a capture with frames as large as the exposures."""
        return self.built(StreamInfo(2000, *self.shape, frame_rate_hz=96_800.0))

    def registering(self) -> Callable[[VirtualExposure, VirtualExposure, Homography | None], Any]:
        """Return what registers exposures with a locator that has just been built, and describes each once."""
        locator = self.built_for_exposures()
        describe = cache(locator.describe)
        return lambda moving, fixed, initial: locator.register(describe(moving), describe(fixed), initial)

    def registered(self, moving: VirtualExposure, fixed: VirtualExposure, initial: Homography | None = None) -> Any:
        """Describe and register with a locator that has just been built."""
        return self.registering()(moving, fixed, initial)

    def located(self, motion: str, initial: Homography | None) -> Located:
        """Register a pair, and require that it is found."""
        found = self.registered(*pair(motion, self.shape), initial)
        assert isinstance(found, Located | NotLocated), f"register() returns Located or NotLocated, got {found!r:.80}"
        assert isinstance(found, Located), (
            f"a {motion} {_started(initial)} must be found, at {self._error(STILL, MOTIONS[motion]):.1f} px on average; "
            f"the locator says NotLocated: {found.reason}"
        )
        return found

    def test_the_map_takes_pixels_of_moving_to_pixels_of_fixed(self) -> None:
        """And not the other way around."""
        self._require_motions()
        motion = max(self.motions, key=lambda name: self._error(STILL, MOTIONS[name]))
        true = MOTIONS[motion]
        found = self.located(motion, self._start(motion)).homography
        forwards, backwards = self._error(found, true), self._error(found, inverse(true))
        assert forwards < backwards, (
            "the map takes pixels of `moving` to pixels of `fixed`, and this is the inverse: off by "
            f"{forwards:.1f} px, and by {backwards:.1f} px if it were the other way around. Return its inverse"
        )

    def test_the_map_is_a_homography_with_h33_of_1(self) -> None:
        """Finite, in float64."""
        self._require_motions()
        for motion in self.motions:
            matrix = self.located(motion, self._start(motion)).homography
            assert isinstance(matrix, np.ndarray), f"a homography is an array, got a {type(matrix).__name__}"
            assert matrix.shape == (3, 3), f"a homography is (3, 3), got {matrix.shape}"
            assert matrix.dtype == np.float64, f"geometry is float64, got a homography of {matrix.dtype}"
            assert abs(matrix[2, 2] - 1) < 1e-9, f"a homography has h33 = 1, got {matrix[2, 2]:.6g}: divide by it"

    def test_a_known_motion_is_found(self, motion: str) -> None:
        """Where nothing is known yet, as at the first level."""
        if self.needs_start:
            pytest.skip("needs_start = True")
        self._require_accuracy(motion, None)

    def test_a_known_motion_is_found_from_a_start_nearby(self, motion: str) -> None:
        """As at all later levels."""
        self._require_accuracy(motion, nearby(motion))

    def test_pixels_that_were_not_seen_are_not_looked_at(self) -> None:
        """They are NaN, at the same places in both images as on a sensor, and must not hold the images fast."""
        self._require_motions()
        motion = "shift"
        true = MOTIONS[motion]
        height, width = self.shape
        unseen = np.random.default_rng(11).random(self.shape) < 0.01
        unseen[:, : width // 10] = unseen[2 * height // 3 : 5 * height // 6, 2 * width // 5 : 3 * width // 5] = True
        images = views(motion, self.shape)
        moving, fixed = (photographed(flux, seed=seed, unseen=unseen) for seed, flux in enumerate(images))
        found = raising_nothing(
            "register() of exposures with pixels that are NaN", self.registered, moving, fixed, self._start(motion)
        )
        assert isinstance(found, Located), f"four fifths of the pixels tell enough; not located: {found.reason}"
        error = self._error(found.homography, true)
        assert error <= self.tolerance_px, (
            f"masked pixels must not pull: with a fifth of them masked in both images, the {motion} is {error:.2f} px off "
            f"(tolerance_px = {self.tolerance_px:g}), {self._error(found.homography, STILL):.2f} px from no motion at all"
        )

    @pytest.mark.parametrize("what", ["flat", "dark", "saturated", "unseen"])
    def test_an_image_without_texture_is_not_located(self, what: str) -> None:
        """Failure is a value: a reason, never an exception, and never an identity matrix."""
        blank, other, scene = _blank(what, self.shape, 1), _blank(what, self.shape, 2), pair("shift", self.shape)[1]
        register = self.registering()
        for name, moving, fixed in (("both are", blank, other), ("`moving` is", blank, scene), ("`fixed` is", scene, blank)):
            for initial in (None, STILL):
                found = raising_nothing(f"register() of exposures of which {name} {what}", register, moving, fixed, initial)
                assert isinstance(found, NotLocated), (
                    f"where {name} {what}, register() must return NotLocated; {_started(initial)} it returned {found!r:.300}"
                )
                assert found.reason.strip(), "NotLocated needs a reason: a clause with the numbers that decided"

    def test_two_places_that_differ_are_not_located(self) -> None:
        """The images share nothing."""
        moving, fixed = (photographed(Scene(seed).view(STILL, self.shape), seed=seed) for seed in (21, 22))
        register = self.registering()
        for initial in (None, STILL):
            found = raising_nothing("register() of two different places", register, moving, fixed, initial)
            assert isinstance(found, NotLocated), (
                f"images that share nothing must not be located; {_started(initial)} the locator says {found!r:.300}. Compare "
                "the images after registration, or count what agrees"
            )

    def test_a_very_small_image_does_not_raise(self) -> None:
        """A coarse level of a small camera has few pixels."""
        moving, fixed = (photographed(Scene().view(translation(x, 0), (12, 18)), seed=x) for x in (1, 0))
        found = raising_nothing("register() of exposures of 12x18 px", self.registered, moving, fixed)
        assert isinstance(found, Located | NotLocated), f"register() returns Located or NotLocated, got {found!r:.80}"

    def test_information_is_the_inverse_covariance_of_what_was_found(self) -> None:
        """A pair counts for what it is worth: too much, and it bends the others; too little, and it is not heard."""
        self._require_motions()
        motion, free = self.motions[0], list(self.free)
        true, errors, predicted = MOTIONS[motion], [], []
        register, frame = self.registering(), corners(self.shape)
        for seed in range(_PAIRS):
            found = register(*pair(motion, self.shape, seed), true)
            assert isinstance(found, Located), f"the {motion} from the true start must be found; not located: {found.reason}"
            if found.information is None:
                pytest.skip("it has no information: all pairs count alike")
            matrix = np.asarray(found.information)
            assert matrix.shape == (8, 8), f"information is (8, 8), one row for each of p1..p8; its shape is {matrix.shape}"
            symmetric = np.allclose(matrix, matrix.T, rtol=1e-6)
            assert symmetric, "information is symmetric, as every inverse covariance is"
            # In px of corners, where p1..p8 have one scale.
            to_corners = jacobian(found.homography, frame).reshape(8, 8)
            slopes = np.linalg.inv(to_corners)
            values = np.linalg.eigvalsh(slopes.T @ matrix @ slopes)
            assert values.min() > 0, f"information is positive definite; its least eigenvalue is {values.min():.3g}"
            # What the photons leave open, the parameters that are not estimated being right, as they are here.
            covariance = np.linalg.inv(matrix[np.ix_(free, free)])
            predicted.append(np.trace(to_corners[:, free] @ covariance @ to_corners[:, free].T))
            errors.append(np.sum((apply(found.homography, frame) - apply(true, frame)) ** 2))
        made_px, foreseen_px = (float(np.sqrt(np.mean(squares) / 4)) for squares in (errors, predicted))
        ratio = made_px / foreseen_px
        assert 1 / self.information_factor < ratio < self.information_factor, (
            f"information is the inverse covariance of p1..p8, in the order of photonpano.geometry.parameters; over "
            f"{_PAIRS} pairs corners err by {made_px:.3g} px, and it predicts {foreseen_px:.3g} px "
            f"(they may differ {self.information_factor:g} times)"
        )

    def test_residual_and_evidence_can_be_recorded(self) -> None:
        """They end up in `run.json` and in messages."""
        sure = [self.located(motion, self._start(motion)) for motion in self.motions[:1]]
        for found in (*sure, self.registered(_blank("flat", self.shape, 1), _blank("flat", self.shape, 2))):
            wrong = {key: value for key, value in found.evidence.items() if not np.isfinite(value)}
            assert not wrong, f"evidence is finite numbers by name; got {wrong}"
            residual = getattr(found, "residual_px", None)
            assert residual is None or 0 <= residual < np.inf, f"residual_px is a finite number or None, got {residual}"

    def test_a_description_does_not_hold_the_exposure(self) -> None:
        """Those of many exposures are kept at once."""
        locator = self.built_for_exposures()
        exposure = pair("shift", self.shape)[0]
        image = weakref.ref(exposure.flux)
        described = locator.describe(exposure)
        del exposure
        gc.collect()
        assert image() is None, f"describe() must let go of the exposure; what it returned, {described!r:.60}, holds its flux"

    def test_exposures_and_starts_are_left_as_they_are(self) -> None:
        """The framework uses them again."""
        exposures, initial = pair("shift", self.shape), nearby("shift")
        before = fingerprint((exposures, initial))
        self.registered(*exposures, initial)
        same = fingerprint((exposures, initial)) == before
        assert same, "the locator changes an exposure, or `initial`; copy it first"
        with unharmed("the locator"):
            self.registered(_unwritable(exposures[0]), _unwritable(exposures[1]), read_only(initial))

    def test_the_same_pair_gives_the_same_bytes(self) -> None:
        """Whatever was registered before, in whatever thread, and whatever numpy's own generator does."""
        locator = self.built_for_exposures()
        moving, fixed = (locator.describe(each) for each in pair("shift", self.shape))
        initial = nearby("shift")
        with global_chance(1):
            expected = fingerprint(locator.register(moving, fixed, initial))
        locator.register(fixed, moving, None)
        others = {
            "registered once more with the same descriptions": fingerprint(locator.register(moving, fixed, initial)),
            "described and registered anew": fingerprint(self.registered(*pair("shift", self.shape), initial)),
        }
        for number, found in enumerate(in_threads(lambda _: fingerprint(locator.register(moving, fixed, initial)))):
            others[f"in thread {number} of several at once"] = found
        wrong = [how for how, found in others.items() if found != expected]
        assert not wrong, f"the same pair must give the same bytes; {' and '.join(wrong)}, it gives others"

    def _require_motions(self) -> None:
        if not self.motions:
            pytest.skip("motions = ()")

    def _start(self, motion: str) -> Homography | None:
        return nearby(motion) if self.needs_start else None

    def _require_accuracy(self, motion: str, initial: Homography | None) -> None:
        error = self._error(self.located(motion, initial).homography, MOTIONS[motion])
        assert error <= self.tolerance_px, (
            f"a {motion} {_started(initial)} must be found within tolerance_px = {self.tolerance_px:g}; corners are "
            f"{error:.3g} px off on average (no motion would be {self._error(STILL, MOTIONS[motion]):.3g} px off)"
        )

    def _error(self, found: Homography, true: Homography) -> float:
        return float(corner_displacements(found, true, self.shape).mean())


def nearby(motion: str) -> Homography:
    """Return a start that is about a pixel away from a motion."""
    return translation(0.9, -0.6) @ MOTIONS[motion]


@cache
def views(motion: str, shape: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """Return the flux that the moving and the fixed camera see."""
    scene = Scene(seed=1)
    return scene.view(_PLACE @ MOTIONS[motion], shape), scene.view(_PLACE, shape)


def pair(motion: str, shape: tuple[int, int] = SHAPE, seed: int = 0) -> tuple[VirtualExposure, VirtualExposure]:
    """Return a moving and a fixed exposure; another seed has other photons."""
    moving, fixed = views(motion, shape)
    return photographed(moving, seed=2 * seed), photographed(fixed, seed=2 * seed + 1)


def _blank(what: str, shape: tuple[int, int], seed: int) -> VirtualExposure:
    flux = {"flat": 0.4, "dark": 0.0, "saturated": 50.0, "unseen": 0.4}[what]
    return photographed(np.full(shape, flux), seed=seed, unseen=np.full(shape, what == "unseen"))


def _unwritable(exposure: VirtualExposure) -> VirtualExposure:
    flux, weight = read_only(exposure.flux), read_only(exposure.weight)
    return VirtualExposure(flux, weight, exposure.group, exposure.scale, exposure.response)


def _started(initial: Homography | None) -> str:
    return "without a start" if initial is None else "from a start"
