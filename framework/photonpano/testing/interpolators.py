"""What interpolators and their trajectories promise."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import pytest

from photonpano.contributions import InterpolatorContribution
from photonpano.geometry import corner_displacements, from_parameters, translation
from photonpano.protocols import Trajectory
from photonpano.testing.captures import read_only
from photonpano.testing.conformance import raising_nothing
from photonpano.testing.sameness import fingerprint, in_threads
from photonpano.testing.stages import STREAM, StageConformance, unharmed
from photonpano.values import FloatArray

INSTANTS = np.array([24.5, 130.0, 220.5, 340.0, 451.5, 560.0, 649.5, 780.0, 871.0])
FAR = STREAM.n_frames
_SIZES = np.array([1e-3, 1e-3, 1e-3, 1e-3, 1.0, 1.0, 1e-6, 1e-6])
"""How far p1..p8 of the knots stray from a pan by 0.15 px a frame."""
_PLACES = np.array([0.05, 0.2, 0.5, 0.85, 0.999])
"""Instants between two knots."""


def shaken_knots(seed: int = 0) -> FloatArray:
    """Return the homographies of a pan by a hand that trembles: (N, 3, 3) at `INSTANTS`."""
    stray = np.random.default_rng(seed).normal(size=(len(INSTANTS), 8)) * _SIZES
    return from_parameters(stray + np.outer(0.15 * INSTANTS, np.eye(8)[4]))


class InterpolatorConformance(StageConformance):
    """Checks of an interpolator.

    Attributes:
        contribution: what is tested.
        config: keys under `with`.
        tolerance_px: how far from its knots the trajectory may pass, at the corners of a frame of 254x496 px; more for one that
            smooths. The knots are those of a hand that trembles by a px.
        keeps_velocity: whether a camera that moves evenly is followed between its knots.
    """

    kind: ClassVar[str] = "interpolator"
    methods: ClassVar[tuple[str, ...]] = ("fit",)

    contribution: InterpolatorContribution
    tolerance_px: float = 1e-3
    keeps_velocity: bool = True

    def fitted(self, n_knots: int = len(INSTANTS), information: FloatArray | None = None) -> Trajectory:
        """Fit the first knots."""
        knots = INSTANTS[:n_knots].copy(), shaken_knots()[:n_knots], information
        trajectory: Trajectory = raising_nothing(f"fit() of knots whose number is {n_knots}", self.built().fit, *knots)
        return trajectory

    @pytest.mark.parametrize("n_knots", [1, 2, 3, 4, len(INSTANTS)])
    def test_it_passes_its_knots(self, n_knots: int) -> None:
        """However few there are."""
        missed = _corner_errors(self.fitted(n_knots).at(INSTANTS[:n_knots]), shaken_knots()[:n_knots])
        worst = float(missed.max())
        assert worst <= self.tolerance_px, (
            f"the trajectory must pass its {n_knots} knots within tolerance_px = {self.tolerance_px:g}; at instant "
            f"{INSTANTS[missed.argmax()]:g} it misses by {worst:.3g} px"
        )

    def test_it_passes_knots_whose_information_is_known(self) -> None:
        """Knots that are known equally well count alike."""
        information = np.broadcast_to(np.diag(1 / _SIZES**2), (len(INSTANTS), 8, 8)) * 1e4
        missed = _corner_errors(self.fitted(information=information.copy()).at(INSTANTS), shaken_knots())
        worst = float(missed.max())
        assert worst <= self.tolerance_px, (
            f"with information, too, the trajectory must pass its knots within tolerance_px = {self.tolerance_px:g}; "
            f"it misses by {worst:.3g} px"
        )

    @pytest.mark.parametrize("n_knots", [1, 2, 3, len(INSTANTS)])
    def test_it_is_defined_for_every_instant(self, n_knots: int) -> None:
        """Frames before the first knot and after the last are rendered as well."""
        frames = np.linspace(-FAR, 2 * FAR, 301)
        homographies = self.fitted(n_knots).at(frames)
        undefined = frames[~np.isfinite(homographies).all(axis=(1, 2))]
        assert not undefined.size, (
            f"at() must be finite for every instant, also beyond the {n_knots} knots; it is not at {undefined[0]:g}"
        )
        singular = frames[np.linalg.det(homographies) <= 0]
        assert not singular.size, f"at() must return maps that can be inverted; that of {singular[0]:g} cannot"

    def test_every_homography_has_h33_of_1(self) -> None:
        """What comes after compares and inverts them as they are."""
        h33 = self.fitted().at(np.linspace(-FAR, 2 * FAR, 301))[:, 2, 2]
        worst = h33[np.abs(h33 - 1).argmax()]
        assert abs(worst - 1) < 1e-9, f"homographies have h33 = 1; at() returned one with {worst:.6g}: divide by it"

    def test_many_instants_give_what_each_gives_alone(self) -> None:
        """In any order, as a list or an array, whole or not."""
        trajectory = self.fitted()
        frames = [130, 24.5, 900.25, 130.0, -50, 455]
        together = trajectory.at(frames)
        assert isinstance(together, np.ndarray), f"at() returns an array, got a {type(together).__name__}"
        shape, wanted = together.shape, (len(frames), 3, 3)
        assert shape == wanted, f"at() of N instants returns (N, 3, 3); for {len(frames)} instants its shape is {shape}"
        assert together.dtype == np.float64, f"geometry is float64; at() returns {together.dtype}"
        for frame, homography in zip(frames, together, strict=True):
            apart = float(np.abs(trajectory.at(np.array([frame]))[0] - homography).max())
            assert apart < 1e-9, (
                f"an instant must not depend on those that it is asked with: at({frame:g}) alone, and among {len(frames)}, "
                f"differ by {apart:.3g}"
            )

    @pytest.mark.parametrize("n_knots", [2, 3, len(INSTANTS)])
    def test_a_constant_velocity_is_kept_between_knots(self, n_knots: int) -> None:
        """The least that can be known of what a camera does meanwhile."""
        if not self.keeps_velocity:
            pytest.skip("keeps_velocity = False")
        instants = INSTANTS[:n_knots]
        knots = np.array([translation(0.15 * frame, -0.05 * frame) for frame in instants])
        frames = (instants[:-1, None] + np.diff(instants)[:, None] * _PLACES).ravel()
        moved = self.built().fit(instants.copy(), knots, None).at(frames)
        errors = _corner_errors(moved, np.array([translation(0.15 * frame, -0.05 * frame) for frame in frames]))
        worst = float(errors.max())
        assert worst <= self.tolerance_px, (
            f"a camera that moves evenly must be followed within tolerance_px = {self.tolerance_px:g}; with {n_knots} knots, "
            f"at instant {frames[errors.argmax()]:g} the trajectory is {worst:.3g} px off"
        )

    def test_knots_are_left_as_they_are(self) -> None:
        """The framework uses them for the report."""
        information = np.broadcast_to(np.eye(8), (len(INSTANTS), 8, 8)).copy()
        given = {"instants": INSTANTS.copy(), "homographies": shaken_knots(), "information": information}
        before = fingerprint(given)
        self.built().fit(**given).at(INSTANTS)
        same = fingerprint(given) == before
        assert same, "fit() changes the arrays that it was given; copy them first"
        with unharmed("fit()"):
            self.built().fit(**{name: read_only(array) for name, array in given.items()}).at(read_only(INSTANTS))

    def test_the_same_knots_give_the_same_bytes(self) -> None:
        """A run can be repeated; at() is called from several threads."""
        frames = np.linspace(-100, 1000, 97)
        trajectory = self.fitted()
        expected = fingerprint(trajectory.at(frames))
        same = fingerprint(self.fitted().at(frames)) == expected
        assert same, "two fits of the same knots differ; seed with context.seed"
        same = {*in_threads(lambda _: fingerprint(trajectory.at(frames)))} == {expected}
        assert same, "at() gives other results when several threads call it at once; keep what it computes out of `self`"


def _corner_errors(first: FloatArray, second: FloatArray) -> FloatArray:
    return np.asarray(corner_displacements(first, second, STREAM.frame_shape).max(axis=-1))
