"""The state of an estimate: the capture as corrected so far, and the motion known so far."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np

from photonpano.capture import capture_of, seen_through
from photonpano.contracts.protocols import Source, Trajectory, camera_of_motion
from photonpano.corrections import Vignette
from photonpano.execution.context import Context
from photonpano.motion.frame_motion import FrameMotion, motion_of_frames
from photonpano.motion.gyroscope import Gyroscope
from photonpano.motion.level import Level, Timeline
from photonpano.motion.locate import LoopSetting
from photonpano.motion.loop import LevelResult, estimate_motion, through_lens
from photonpano.motion.models import HOMOGRAPHIES, MotionModel
from photonpano.motion.rotations import RotationTrajectory
from photonpano.residuals.findings import NOTHING, Findings
from photonpano.residuals.refinement import MotionFit
from photonpano.specs.plan import Plan
from photonpano.values import Light


class View(NamedTuple):
    """A capture as its camera sees it, and the context of what is done with it."""

    source: Source
    context: Context


@dataclass(frozen=True, eq=False, kw_only=True)
class State:
    """A capture as corrected so far, and its motion as known so far. It is frozen: passes return new states."""

    plan: Plan
    source: Source  # the capture as corrected so far, in its light, but not yet through the camera that was found
    context: Context  # threads, progress, and checkpoints that depend on these corrections
    reference: int  # the frame whose homography is the identity
    levels: tuple[Level, ...]
    timeline: Timeline  # repeated frames, and where the motion is cut
    model: MotionModel = HOMOGRAPHIES
    start: Trajectory | None = None  # the motion known before the first level; None if there is none
    gyroscope: Gyroscope | None = None  # that turned with the camera; None if there is none
    shortened: int = 1  # groups whose size is chosen from the capture are shortened that many times
    results: tuple[LevelResult, ...] = ()
    outdated: bool = False  # whether the source was corrected since these levels were located
    watched: bool = False  # whether what hides the background was looked for
    vignette: Vignette | None = None  # by which the source is divided
    light: Light | None = None  # in which the source is seen; None for steady light
    findings: Findings = NOTHING
    refined: FrameMotion | None = None  # the motion corrected by refiners; None for that of the last level
    known_fit: MotionFit | None = None  # how well that explains the photons, if it is known without measuring them

    def located(self, levels: Sequence[Level], previous: Trajectory | None, corrected: Trajectory | None = None) -> State:
        """Run some levels of the loop from a motion, if one is known; they replace results of the same and later levels.

        They correct the motion that is `corrected`, instead of replacing it: by default that of the gyroscope, or the start.
        """
        if not levels:
            return self
        before = [each for each in self.results if each.level.number < levels[0].number]
        known = self.results[-1].located.covered if self.results else None
        if corrected is None and self.gyroscope is None:
            corrected = self.start
        setting = LoopSetting(
            source=self.source,
            graph=self.plan.graph,
            context=self.context,
            reference=self.reference,
            timeline=self.timeline,
            finest=self.levels[-1].scale,
            model=self.model,
            gyroscope=self.gyroscope,
        )
        until_converged = self.plan.until_converged
        results = estimate_motion(setting, levels, previous, known=known, corrected=corrected, until_converged=until_converged)
        return replace(self, results=(*before, *results), outdated=False)

    def relocated(self) -> State:
        """Run the last level again along the refined motion, which it corrects: its exposures are then sharper.

        The model of the motion stays the one that was chosen, since tremor in each exposure is explained by any that is richer.
        Exposures average over the noise of single frames that refiners let through, which stays in the motion and its error.
        """
        motion: Trajectory = self.motion.trajectory
        if self.motion.camera is not None:
            motion = RotationTrajectory(motion, self.motion.camera, self.reference)
        result = self.results[-1]
        again = replace(self, model=replace(result.located.solution.model, doubts_lens=False)).located(
            [result.level], motion, motion
        )
        again = replace(again, refined=None, known_fit=None)
        known, before = self.motion.noise_px, replace(self, refined=None).motion.noise_px
        finite = np.isfinite(known) & np.isfinite(before)
        noise_px = np.zeros_like(known)
        noise_px[finite] = np.sqrt(np.maximum(known[finite] ** 2 - before[finite] ** 2, 0))
        return replace(again, refined=replace(again.motion, std_px=np.hypot(again.motion.std_px, noise_px)))

    def corrected(self, source: Source, correction: Vignette | Light) -> State:
        """Return the state of a capture with one more correction, on which its checkpoints then depend."""
        state = replace(self, source=source, context=within(self.context, correction), outdated=True)
        return replace(state, light=correction) if isinstance(correction, Light) else replace(state, vignette=correction)

    def found(self) -> Findings:
        """Return the findings so far, with those of the timeline, of the background, and of the time limit."""
        background, left_out = capture_of(self.source).background, tuple(self.context.time_limit.left_out)
        hidden_share = None if background is None else round(background.hidden_share, 4)
        found = self.findings.along(self.timeline)
        return replace(found, light_changes=self.light is not None, hidden_share=hidden_share, left_out=left_out)

    @property
    def trajectory(self) -> Trajectory:
        """The motion after the last level."""
        return self.results[-1].trajectory

    @cached_property
    def view(self) -> View:
        """The capture as the camera sees it that the last level has found."""
        camera = camera_of_motion(self.trajectory) if self.results else None
        if camera is None:
            return View(through_lens(self.source, self.model), self.context)
        return View(seen_through(self.source, camera), within(self.context, camera))

    @cached_property
    def motion(self) -> FrameMotion:
        """The motion of every frame."""
        return self.refined or motion_of_frames(self.results, self.source.info, self.reference)

    def fit(self) -> MotionFit:
        """Return how well the motion explains the photons; `CanvasTooLargeError` or `LocationError` if that has no canvas."""
        return self.known_fit or self._fit

    @cached_property
    def _fit(self) -> MotionFit:
        return MotionFit(self.view.source, self.motion, int(self.plan.run.memory), self.view.context)


def model_of(plan: Plan) -> MotionModel:
    """Return the motions that a spec allows the camera."""
    camera, distortion = plan.camera, plan.camera.distortion
    k1, k2, p1, p2 = (_given(each) for each in (distortion.k1, distortion.k2, distortion.p1, distortion.p2))
    return MotionModel(
        kind=plan.motion.model, focal_px=_given(camera.focal_px), centre_px=camera.centre_px, distortion=(k1, k2, p1, p2)
    )


def _given(number: float | Literal["find"]) -> float | None:
    return None if number == "find" else number


def within(context: Context, given: object) -> Context:
    """Return a context whose checkpoints depend on one more value."""
    return replace(context, checkpoints=context.checkpoints.within(given))
