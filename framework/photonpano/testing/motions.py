"""Checks of resamplers, interpolators and refiners, on a capture whose tremor is known."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, ClassVar

import numpy as np
import pytest
from numpy.typing import NDArray

from photonpano.contracts.protocols import Source, Trajectory
from photonpano.contracts.requirements import require_groups, require_homographies, require_near_knots, require_refined
from photonpano.errors import InputError
from photonpano.geometry import corner_displacements, from_parameters, translation
from photonpano.plugins.contributions import InterpolatorContribution, RefinerContribution, ResamplerContribution
from photonpano.testing.captures import KnownMotion, ReadOnlySource, Scene, read_only, recorded
from photonpano.testing.conformance import STREAM, Answer, AnswerConformance, fingerprint, in_threads, passing
from photonpano.values import FloatArray, FrameSpan, Refined, SpanResiduals

LEVELS = (1, 2, 3, 4)
LONG = (STREAM.n_frames, STREAM.n_frames + 37)  # lengths of captures that suit the config, one of them with few divisors
SHORT = (1, 2, 3, 5, 8, 13, 21, 34, 55, 89, 144, 233)

INSTANTS = np.array([24.5, 130.0, 220.5, 340.0, 451.5, 560.0, 649.5, 780.0, 871.0])
# Standard deviations of p1..p8 of the knots around a pan of 0.15 px per frame.
_SIZES = np.array([1e-3, 1e-3, 1e-3, 1e-3, 1.0, 1.0, 1e-6, 1e-6])
_PLACES = np.array([0.05, 0.2, 0.5, 0.85, 0.999])  # between two knots, as shares of their distance

SHAPE = (32, 48)
N_FRAMES = 512
LOCATED = FrameSpan(16, 488)  # the frames that were located: the expected error of the others is infinite
SPAN_FRAMES = 8
REFERENCE = 256
TREMOR_PX = 1.5
PERIOD_FRAMES = 64
SHARE_OF_NOISE = 0.4  # expected error of the motion that refiners are given, over the error of the shift of a span
TOLERANCE = 4.0  # largest correction of a motion without error, in expected errors


class ResamplerConformance(AnswerConformance):
    """Checks of a resampler, for captures of about 2,000 frames, which the config must suit, and for short ones."""

    kind: ClassVar[str] = "resampler"

    contribution: ResamplerContribution

    def groups(self, n_frames: int, level: int) -> Any:
        """Return the groups of a new resampler."""
        return self.built(replace(STREAM, n_frames=n_frames)).groups(n_frames, level)

    def answers(self) -> Iterator[Answer]:
        """Yield the groups of several levels and captures."""
        for n_frames in LONG:
            for level in LEVELS:
                require = partial(require_groups, n_frames=n_frames)
                yield f"the groups of level {level} of {n_frames} frames", self.groups(n_frames, level), require

    def test_groups_depend_on_arguments_only(self) -> None:
        """They do not depend on the order of calls; a generator could be read only once."""
        for n_frames in LONG:
            together = self.built(replace(STREAM, n_frames=n_frames))
            backwards = {level: together.groups(n_frames, level) for level in reversed(LEVELS)}
            for level in LEVELS:
                expected = self.groups(n_frames, level)
                assert isinstance(expected, tuple)
                assert backwards[level] == expected, f"groups({n_frames}, {level}) must depend on its arguments only"
                assert together.groups(n_frames, level) == expected, "a second call returns other groups"

    def test_short_capture_gives_groups_or_input_error(self) -> None:
        """`check` reports captures that are too short, too, so that `photonpano check` finds them before a run."""
        for n_frames in SHORT:
            problems = [*self.contribution.check(self.settings(), replace(STREAM, n_frames=n_frames))]
            groups: Any = ()
            with suppress(InputError):
                groups = self.groups(n_frames, 1)
                assert groups, f"groups() returned no group for {n_frames} frames; raise an InputError"
                assert groups[-1].span.stop <= n_frames
            assert bool(problems) == (not groups), f"check() and groups() must agree about {n_frames} frames"


def shaken_knots() -> FloatArray:
    """Return the homographies of a pan with tremor: (N, 3, 3) at `INSTANTS`."""
    tremor = np.random.default_rng(0).normal(size=(len(INSTANTS), 8)) * _SIZES
    return from_parameters(tremor + np.outer(0.15 * INSTANTS, np.eye(8)[4]))


class InterpolatorConformance(AnswerConformance):
    """Checks of an interpolator."""

    kind: ClassVar[str] = "interpolator"

    contribution: InterpolatorContribution
    # largest distance of the trajectory from its knots, at the corners of a frame of 254x496 px; more for one that smooths. The
    # knots have a tremor of 1 px
    tolerance_px: float = 1e-3
    keeps_velocity: bool = True  # whether a constant velocity is kept between knots

    def fitted(self, n_knots: int = len(INSTANTS), information: FloatArray | None = None) -> Trajectory:
        """Fit the first knots, which are read-only: the framework uses them again."""
        given = read_only(INSTANTS[:n_knots]), read_only(shaken_knots()[:n_knots])
        trajectory: Trajectory = self.built().fit(*given, None if information is None else read_only(information))
        return trajectory

    def answers(self) -> Iterator[Answer]:
        """Yield what trajectories of few and many knots return, also before the first knot and after the last."""
        frames = np.linspace(-STREAM.n_frames, 2 * STREAM.n_frames, 301)
        for n_knots in (1, 2, 3, len(INSTANTS)):
            require = partial(require_homographies, frame_indices=frames)
            yield f"the homographies of {n_knots} knots", self.fitted(n_knots).at(read_only(frames)), require

    @pytest.mark.parametrize("n_knots", [1, 2, 3, 4, len(INSTANTS)])
    def test_trajectory_passes_its_knots(self, n_knots: int) -> None:
        """Even a single one, and with information, which is here that of all knots. Homographies are invertible."""
        knots, information = shaken_knots()[:n_knots], np.tile(np.diag(1 / _SIZES**2) * 1e4, (n_knots, 1, 1))
        for known in (None, information):
            trajectory = self.fitted(n_knots, known)
            with passing(f"the trajectory of {n_knots} knots"):
                require_near_knots(trajectory, INSTANTS[:n_knots], knots, np.full(n_knots, 0.2), STREAM.frame_shape)
            found = trajectory.at(INSTANTS[:n_knots])
            assert (np.linalg.det(found) > 0).all(), "homographies must be invertible maps"
            assert _corner_errors(found, knots).max() <= self.tolerance_px, f"the trajectory must pass its {n_knots} knots"

    def test_instants_are_independent_of_each_other(self) -> None:
        """In any order, as a list or an array, whole numbers or not."""
        trajectory = self.fitted()
        frames = [130, 24.5, 900.25, 130.0, -50, 455]
        alone = np.concatenate([trajectory.at(np.array([frame])) for frame in frames])
        np.testing.assert_allclose(
            trajectory.at(frames), alone, atol=1e-9, err_msg="at() of several instants, and of each alone"
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
        errors_px = _corner_errors(moved, np.array([translation(0.15 * frame, -0.05 * frame) for frame in frames]))
        assert errors_px.max() <= self.tolerance_px, (
            f"a camera that moves evenly must be followed; it is off most at instant {frames[errors_px.argmax()]:g}"
        )

    def test_fit_is_deterministic(self) -> None:
        """A run can be repeated, and at() is called from several threads."""
        frames = np.linspace(-100, 1000, 97)
        trajectory = self.fitted()
        expected = fingerprint(trajectory.at(frames))
        assert fingerprint(self.fitted().at(frames)) == expected, "two fits to the same knots differ"
        assert {*in_threads(lambda _: fingerprint(trajectory.at(frames)))} == {expected}, "at() differs in several threads"


def _corner_errors(first: FloatArray, second: FloatArray) -> FloatArray:
    return np.asarray(corner_displacements(first, second, STREAM.frame_shape).max(axis=-1))


class SeenScene:
    """The view of a panorama without noise: a `photonpano.PanoramaView`."""

    def __init__(self, scene: Scene, trajectory: Trajectory) -> None:
        self._scene = scene
        self._trajectory = trajectory

    def predicted(self, instant: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return mean count and variance of a binary frame: two (H, W) float32."""
        mean = -np.expm1(-self._scene.view(self._trajectory.at([instant])[0], SHAPE))
        return read_only(mean.astype(np.float32)), read_only((mean * (1 - mean)).astype(np.float32))


@dataclass(frozen=True, eq=False, kw_only=True)
class Case:
    """A capture, the motion that a refiner is given, and what the photons show beyond it."""

    source: Source
    true_motion: Trajectory
    trajectory: Trajectory
    std_px: FloatArray
    residuals: SpanResiduals
    view: SeenScene

    def errors_px(self, homographies: FloatArray) -> FloatArray:
        """Return the largest corner error of each located frame."""
        frames = np.arange(LOCATED.start, LOCATED.stop)
        return np.asarray(corner_displacements(homographies[frames], self.true_motion.at(frames), SHAPE).max(axis=-1))


@cache
def case(tremor_px: float) -> Case:
    """Simulate a pan with a tremor along x and y, of which refiners are given the pan alone."""
    scene = Scene(seed=3, flux=(0.1, 1.2))

    def shaken(frame: float, amplitude_px: float) -> FloatArray:
        tremor_px = amplitude_px * np.sin(2 * np.pi * (frame - REFERENCE) / PERIOD_FRAMES)
        pan_px = 0.05 * (frame - REFERENCE)
        return translation(pan_px + tremor_px, 0.2 * pan_px - 0.6 * tremor_px)

    pan, motion = KnownMotion(lambda frame: shaken(frame, 0)), KnownMotion(lambda frame: shaken(frame, tremor_px))
    source = ReadOnlySource(recorded(scene, motion, N_FRAMES, SHAPE))
    view = SeenScene(scene, pan)
    residuals = measured(source, view, tuple(LOCATED.blocks(SPAN_FRAMES)))
    std_px = np.full(N_FRAMES, np.inf)
    variances = np.diagonal(np.linalg.inv(residuals.information), axis1=1, axis2=2)
    noise_px = float(np.sqrt(variances[:, :2].sum(axis=1)).mean())  # that photons cause in the shift of a span
    std_px[LOCATED.start : LOCATED.stop] = SHARE_OF_NOISE * noise_px
    return Case(source=source, true_motion=motion, trajectory=pan, std_px=read_only(std_px), residuals=residuals, view=view)


def measured(source: Source, view: SeenScene, spans: tuple[FrameSpan, ...]) -> SpanResiduals:
    """Take one weighted least-squares step of the motion of each span, from the difference between its frames and the view."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]] - (np.array(SHAPE).reshape(2, 1, 1) - 1) / 2
    steps, information = [], []
    for span in spans:
        mean, variance = view.predicted(span.centre)
        slope_y, slope_x = np.gradient(mean.astype(np.float64))
        gradient = np.stack([slope_x, slope_y, x * slope_y - y * slope_x, x * slope_x + y * slope_y]).reshape(4, -1)
        weight = len(span) / variance.ravel()
        difference = source.counts(span).ravel() / len(span) - mean.ravel()
        matrix = (gradient * weight) @ gradient.T
        information.append(matrix)
        steps.append(np.linalg.solve(matrix, (gradient * weight) @ difference))
    return SpanResiduals(spans, read_only(np.array(steps)), read_only(np.array(information)))


class RefinerConformance(AnswerConformance):
    """Checks of a refiner. Its arguments are read-only: the framework uses them again.

    The capture has 512 binary frames of 32x48 px, of which 472 are located, and residuals of spans of 8 frames. Its frame rate
    is not known. The tremor has an amplitude of 1.5 px along x and of 0.9 px along y, and a period of 64 frames.
    """

    kind: ClassVar[str] = "refiner"

    contribution: RefinerContribution

    def refined(self, given: Case) -> Refined | None:
        """Refine the motion of a case."""
        refiner = self.built(given.source.info)
        found: Refined | None = refiner.refine(given.source, given.trajectory, given.std_px, given.residuals, given.view)
        return found

    def answers(self) -> Iterator[Answer]:
        """Yield the refined motion of a still camera, and of one with a tremor."""
        for tremor_px in (0.0, TREMOR_PX):
            given = case(tremor_px)
            require = partial(require_refined, _source=given.source, _trajectory=given.trajectory, std_px=given.std_px)
            yield f"the refined motion with a tremor of {tremor_px:g} px", self.refined(given), require

    @pytest.mark.parametrize("tremor_px", [0.0, TREMOR_PX])
    def test_reference_frame_stays_the_identity(self, tremor_px: float) -> None:
        """The panorama lies in its plane: multiply all homographies by the inverse of that of this frame, from the left."""
        if (found := self.refined(case(tremor_px))) is not None:
            np.testing.assert_allclose(found.homographies[REFERENCE], np.eye(3), atol=1e-9)

    def test_photon_noise_is_not_corrected(self) -> None:
        """Where the motion is right, the residuals are photon noise: `None`, or a correction within the expected error."""
        given = case(0.0)
        if (found := self.refined(given)) is not None:
            ratios = given.errors_px(found.homographies) / given.std_px[LOCATED.start : LOCATED.stop]
            assert ratios.max() <= TOLERANCE, "frames were moved by more expected errors than this"

    def test_tremor_is_reduced_or_left(self) -> None:
        """A refiner may look for something else; the refined motion is `trajectory.at(frame) @ step`."""
        given = case(TREMOR_PX)
        if (found := self.refined(given)) is not None:
            before_px = np.mean(given.errors_px(given.trajectory.at(np.arange(N_FRAMES))))
            assert np.mean(given.errors_px(found.homographies)) < before_px, "a tremor must be reduced, or left with None"

    @pytest.mark.parametrize("n_spans", [1, 2, 3])
    def test_few_spans_are_enough(self, n_spans: int) -> None:
        """A short capture has few of them."""
        whole = case(TREMOR_PX)
        given = whole.residuals
        residuals = SpanResiduals(given.spans[:n_spans], given.steps[:n_spans], given.information[:n_spans])
        std_px = np.where(np.arange(N_FRAMES) < residuals.spans[-1].stop, whole.std_px, np.inf)
        self.refined(replace(whole, std_px=std_px, residuals=residuals))

    def test_refine_accepts_spans_without_information(self) -> None:
        """A span over a dark part of the scene determines no step: its information is 0."""
        whole = case(TREMOR_PX)
        steps, information = whole.residuals.steps.copy(), whole.residuals.information.copy()
        steps[10:14], information[10:14] = 0, 0
        found = self.refined(replace(whole, residuals=SpanResiduals(whole.residuals.spans, steps, information)))
        assert found is None or np.isfinite(found.homographies).all()

    @pytest.mark.parametrize("tremor_px", [0.0, TREMOR_PX])
    def test_refine_is_deterministic(self, tremor_px: float) -> None:
        """A run can be repeated; seed random numbers with context.seed."""
        assert fingerprint(self.refined(case(tremor_px))) == fingerprint(self.refined(case(tremor_px)))
