"""Checks of refiners, on a small capture whose tremor is known."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import ClassVar

import numpy as np
import pytest
from numpy.typing import NDArray

from photonpano.contracts.protocols import Source, Trajectory
from photonpano.contracts.results import REFINED
from photonpano.geometry import corner_displacements, translation
from photonpano.plugins.contributions import RefinerContribution
from photonpano.testing.captures import KnownMotion, ReadOnlySource, read_only, recorded
from photonpano.testing.conformance import must_not_raise
from photonpano.testing.sameness import fingerprint
from photonpano.testing.scenes import Scene
from photonpano.testing.stages import Answer, AnswerConformance, accepts_read_only
from photonpano.values import FloatArray, FrameSpan, Refined, SpanResiduals

SHAPE = (32, 48)
FRAMES = 512
LOCATED = FrameSpan(16, 488)  # the frames that were located: the expected error of the others is infinite
SPAN_FRAMES = 8
REFERENCE = 256
TREMOR_PX = 1.5
PERIOD_FRAMES = 64
SHARE_OF_NOISE = 0.4  # expected error of the motion that refiners are given, over the error of the shift of a span
TOLERANCE = 4.0  # largest correction of a motion without error, in expected errors


class SeenScene:
    """The view of a panorama without noise: a `photonpano.PanoramaView`."""

    def __init__(self, scene: Scene, trajectory: Trajectory) -> None:
        self._scene = scene
        self._trajectory = trajectory

    def predicted(self, instant: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return mean count and variance of a binary frame: two (H, W) float32."""
        mean = -np.expm1(-self._scene.view(self._trajectory.at([instant])[0], SHAPE))
        return read_only(mean.astype(np.float32)), read_only((mean * (1 - mean)).astype(np.float32))


@dataclass(frozen=True, eq=False)
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
    source = ReadOnlySource(recorded(scene, motion, FRAMES, SHAPE))
    view = SeenScene(scene, pan)
    residuals = measured(source, view, tuple(LOCATED.blocks(SPAN_FRAMES)))
    std_px = np.full(FRAMES, np.inf)
    variances = np.diagonal(np.linalg.inv(residuals.information), axis1=1, axis2=2)
    noise_px = float(np.sqrt(variances[:, :2].sum(axis=1)).mean())  # that photons cause in the shift of a span
    std_px[LOCATED.start : LOCATED.stop] = SHARE_OF_NOISE * noise_px
    return Case(source, motion, pan, read_only(std_px), residuals, view)


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
    """Checks of a refiner.

    The capture has 512 binary frames of 32x48 px, of which 472 are located, and residuals of spans of 8 frames. Its frame rate
    is not known. The tremor has an amplitude of 1.5 px along x and of 0.9 px along y, and a period of 64 frames.
    """

    kind: ClassVar[str] = "refiner"
    contracts = (REFINED,)

    contribution: RefinerContribution

    def refined(self, given: Case) -> Refined | None:
        """Refine the motion of a case."""
        refiner = self.built(given.source.info)
        found: Refined | None = must_not_raise(
            "refine()", refiner.refine, given.source, given.trajectory, given.std_px, given.residuals, given.view
        )
        return found

    def answers(self) -> Iterator[Answer]:
        """Yield the refined motion of a still camera, and of one with a tremor."""
        for tremor_px in (0.0, TREMOR_PX):
            given = case(tremor_px)
            if (found := self.refined(given)) is not None:
                yield f"the refined motion with a tremor of {tremor_px:g} px", REFINED, found, given.std_px

    @pytest.mark.parametrize("tremor_px", [0.0, TREMOR_PX])
    def test_reference_frame_stays_the_identity(self, tremor_px: float) -> None:
        """The panorama lies in its plane."""
        if (found := self.refined(case(tremor_px))) is None:
            return
        apart = float(np.abs(found.homographies[REFERENCE] - np.eye(3)).max())
        assert apart < 1e-9, (
            f"the homography of the reference frame, here {REFERENCE}, must stay the identity; it differs by {apart:.3g}: "
            "multiply all homographies by its inverse, from the left"
        )

    def test_photon_noise_is_not_corrected(self) -> None:
        """Where the motion is right, the residuals are photon noise: `None`, or a correction within the expected error."""
        given = case(0.0)
        if (found := self.refined(given)) is None:
            return
        errors_px = given.errors_px(found.homographies)
        ratios = errors_px / given.std_px[LOCATED.start : LOCATED.stop]
        worst = int(ratios.argmax())
        assert ratios[worst] <= TOLERANCE, (
            f"residuals that are photon noise must not be corrected by more than {TOLERANCE:g} expected errors; "
            f"frame {LOCATED.start + worst} was moved by {errors_px[worst]:.3g} px, which is {ratios[worst]:.1f} of them"
        )

    def test_tremor_is_reduced_or_left(self) -> None:
        """A refiner may look for something else, but must not make a tremor worse."""
        given = case(TREMOR_PX)
        if (found := self.refined(given)) is None:
            return
        before = float(np.mean(given.errors_px(given.trajectory.at(np.arange(FRAMES)))))
        after = float(np.mean(given.errors_px(found.homographies)))
        assert after < before, (
            f"a tremor of {TREMOR_PX:g} px must be reduced, or left with None; the mean corner error was {before:.3g} px, "
            f"and is {after:.3g} px. The refined motion is `trajectory.at(frame) @ step`"
        )

    @pytest.mark.parametrize("n_spans", [1, 2, 3])
    def test_few_spans_are_enough(self, n_spans: int) -> None:
        """A short capture has few of them."""
        whole = case(TREMOR_PX)
        residuals = SpanResiduals(
            whole.residuals.spans[:n_spans], whole.residuals.steps[:n_spans], whole.residuals.information[:n_spans]
        )
        std_px = np.where(np.arange(FRAMES) < residuals.spans[-1].stop, whole.std_px, np.inf)
        self.refined(replace(whole, std_px=std_px, residuals=residuals))

    def test_refine_accepts_spans_without_information(self) -> None:
        """A span over a dark part of the scene determines no step."""
        whole = case(TREMOR_PX)
        steps, information = whole.residuals.steps.copy(), whole.residuals.information.copy()
        steps[10:14], information[10:14] = 0, 0
        found = self.refined(replace(whole, residuals=SpanResiduals(whole.residuals.spans, steps, information)))
        assert found is None or np.isfinite(found.homographies).all(), (
            "homographies must be finite, also if the photons of some spans determine no step: their information is 0"
        )

    def test_refine_leaves_inputs_unchanged(self) -> None:
        """The framework uses them again, to compare the motion before and after."""
        whole = case(TREMOR_PX)
        steps, information, std_px = whole.residuals.steps.copy(), whole.residuals.information.copy(), whole.std_px.copy()
        before = fingerprint((steps, information, std_px))
        self.refined(replace(whole, std_px=std_px, residuals=SpanResiduals(whole.residuals.spans, steps, information)))
        same = fingerprint((steps, information, std_px)) == before
        assert same, "refine() modifies its arguments; copy an array before you change it"
        with accepts_read_only("refine()"):
            self.built(whole.source.info).refine(whole.source, whole.trajectory, whole.std_px, whole.residuals, whole.view)

    @pytest.mark.parametrize("tremor_px", [0.0, TREMOR_PX])
    def test_refine_is_deterministic(self, tremor_px: float) -> None:
        """A run can be repeated."""
        same = fingerprint(self.refined(case(tremor_px))) == fingerprint(self.refined(case(tremor_px)))
        assert same, "refine() returns other results for the same residuals; seed random numbers with context.seed"
