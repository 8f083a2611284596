"""Checks of interpolators and their trajectories."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

import numpy as np
import pytest

from photonpano.contracts.loop import HOMOGRAPHIES, KNOTS, knot_errors
from photonpano.contracts.protocols import Trajectory
from photonpano.geometry import corner_displacements, from_parameters, translation
from photonpano.plugins.contributions import InterpolatorContribution
from photonpano.testing.captures import read_only
from photonpano.testing.conformance import must_not_raise, passing
from photonpano.testing.sameness import fingerprint, in_threads
from photonpano.testing.stages import STREAM, Answer, AnswerConformance, accepts_read_only
from photonpano.values import FloatArray

INSTANTS = np.array([24.5, 130.0, 220.5, 340.0, 451.5, 560.0, 649.5, 780.0, 871.0])
FAR = STREAM.n_frames
# Standard deviations of p1..p8 of the knots around a pan of 0.15 px per frame.
_SIZES = np.array([1e-3, 1e-3, 1e-3, 1e-3, 1.0, 1.0, 1e-6, 1e-6])
_PLACES = np.array([0.05, 0.2, 0.5, 0.85, 0.999])  # between two knots, as shares of their distance


def shaken_knots() -> FloatArray:
    """Return the homographies of a pan with tremor: (N, 3, 3) at `INSTANTS`."""
    tremor = np.random.default_rng(0).normal(size=(len(INSTANTS), 8)) * _SIZES
    return from_parameters(tremor + np.outer(0.15 * INSTANTS, np.eye(8)[4]))


class InterpolatorConformance(AnswerConformance):
    """Checks of an interpolator.

    Attributes:
        tolerance_px: largest distance of the trajectory from its knots, at the corners of a frame of 254x496 px; more for one
            that smooths. The knots have a tremor of 1 px.
        keeps_velocity: whether a constant velocity is kept between knots.
    """

    kind: ClassVar[str] = "interpolator"
    contracts = (HOMOGRAPHIES, KNOTS)

    contribution: InterpolatorContribution
    tolerance_px: float = 1e-3
    keeps_velocity: bool = True

    def fitted(self, n_knots: int = len(INSTANTS), information: FloatArray | None = None) -> Trajectory:
        """Fit the first knots."""
        knots = INSTANTS[:n_knots].copy(), shaken_knots()[:n_knots], information
        trajectory: Trajectory = must_not_raise(f"fit() with {n_knots} knots", self.built().fit, *knots)
        return trajectory

    def answers(self) -> Iterator[Answer]:
        """Yield what trajectories of few and many knots return, also before the first knot and after the last."""
        frames = np.linspace(-FAR, 2 * FAR, 301)
        for n_knots in (1, 2, 3, len(INSTANTS)):
            trajectory = self.fitted(n_knots)
            found = np.asarray(trajectory.at(frames))
            yield f"the homographies of {n_knots} knots", HOMOGRAPHIES, found, frames
            if HOMOGRAPHIES.first_broken(found, frames) is None:
                knots = INSTANTS[:n_knots], shaken_knots()[:n_knots], np.full(n_knots, 0.2)
                yield f"the trajectory of {n_knots} knots", KNOTS, knot_errors(trajectory, *knots, STREAM.frame_shape), None

    @pytest.mark.parametrize("n_knots", [1, 2, 3, 4, len(INSTANTS)])
    def test_trajectory_passes_its_knots(self, n_knots: int) -> None:
        """Even a single one."""
        errors_px = _corner_errors(self.fitted(n_knots).at(INSTANTS[:n_knots]), shaken_knots()[:n_knots])
        worst = float(errors_px.max())
        assert worst <= self.tolerance_px, (
            f"the trajectory must pass its knots (here {n_knots}) within tolerance_px = {self.tolerance_px:g}; at instant "
            f"{INSTANTS[errors_px.argmax()]:g} it is {worst:.3g} px off"
        )

    def test_trajectory_passes_knots_with_information(self) -> None:
        """Here all knots have the same information."""
        information = np.broadcast_to(np.diag(1 / _SIZES**2), (len(INSTANTS), 8, 8)) * 1e4
        errors_px = _corner_errors(self.fitted(information=information.copy()).at(INSTANTS), shaken_knots())
        worst = float(errors_px.max())
        assert worst <= self.tolerance_px, (
            f"with information, the trajectory must pass its knots within tolerance_px = {self.tolerance_px:g}; "
            f"it is {worst:.3g} px off"
        )

    def test_instants_are_independent_of_each_other(self) -> None:
        """In any order, as a list or an array, whole numbers or not."""
        trajectory = self.fitted()
        frames = [130, 24.5, 900.25, 130.0, -50, 455]
        together = trajectory.at(frames)
        assert isinstance(together, np.ndarray), f"at() must return an array, got a {type(together).__name__}"
        with passing(f"what at() returned for {len(frames)} instants"):
            HOMOGRAPHIES.require(together, np.array(frames))
        for frame, homography in zip(frames, together, strict=True):
            apart = float(np.abs(trajectory.at(np.array([frame]))[0] - homography).max())
            assert apart < 1e-9, (
                f"the homography of an instant must not depend on the other instants of the call; at({frame:g}) alone, and "
                f"among {len(frames)} instants, differ by {apart:.3g}"
            )

    @pytest.mark.parametrize("n_knots", [2, 3, len(INSTANTS)])
    def test_constant_velocity_is_kept_between_knots(self, n_knots: int) -> None:
        """The simplest motion is interpolated exactly."""
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

    def test_fit_leaves_inputs_unchanged(self) -> None:
        """The framework uses the knots again, for the report."""
        information = np.broadcast_to(np.eye(8), (len(INSTANTS), 8, 8)).copy()
        given = {"instants": INSTANTS.copy(), "homographies": shaken_knots(), "information": information}
        before = fingerprint(given)
        self.built().fit(**given).at(INSTANTS)
        same = fingerprint(given) == before
        assert same, "fit() modifies its arguments; copy an array before you change it"
        with accepts_read_only("fit()"):
            self.built().fit(**{name: read_only(array) for name, array in given.items()}).at(read_only(INSTANTS))

    def test_fit_is_deterministic(self) -> None:
        """A run can be repeated, and at() is called from several threads."""
        frames = np.linspace(-100, 1000, 97)
        trajectory = self.fitted()
        expected = fingerprint(trajectory.at(frames))
        same = fingerprint(self.fitted().at(frames)) == expected
        assert same, "two fits to the same knots differ; seed random numbers with context.seed"
        same = {*in_threads(lambda _: fingerprint(trajectory.at(frames)))} == {expected}
        assert same, (
            "at() returns other results when several threads call it at once; do not store intermediate results on `self`"
        )


def _corner_errors(first: FloatArray, second: FloatArray) -> FloatArray:
    return np.asarray(corner_displacements(first, second, STREAM.frame_shape).max(axis=-1))
