"""Refine the motion until the residuals are photon noise: render, measure what is left, correct the motion, and again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from photonpano.context import Context
from photonpano.geometry import FrameTrajectory, corner_displacements, inverse
from photonpano.merging.panorama import BYTES_PER_PIXEL, plan_canvas, render
from photonpano.motion.attribution import BrokenContract, attributing
from photonpano.motion.frame_motion import FrameMotion
from photonpano.protocols import Refiner, Source
from photonpano.residuals.measure import Residuals, measure
from photonpano.residuals.prediction import Prediction
from photonpano.residuals.unexplained import residual_ratio, unexplained_px
from photonpano.values import Panorama, Refined

MAX_ROUNDS = 6
"""Most corrections by one refiner. A tremor blurs the panorama that it is seen against, so that one is not enough."""
_WORSE_RATIO, _WORSE_MISFIT = 1.05, 0.01
"""A refined motion is not used if the scatter of the shifts grows by this factor, or the misfit of the photons by this much."""


@dataclass(frozen=True, slots=True)
class NamedRefiner:
    """A refiner of a run.

    Attributes:
        name: as in the spec.
        component: the refiner.
        origin: who provides it, such as "refiner 'short-spans' of photonpano 0.1.0".
    """

    name: str
    component: Refiner
    origin: str


@dataclass(frozen=True, slots=True)
class Refinement:
    """What a refiner did.

    Attributes:
        name: of the refiner.
        rounds: the summary of each correction that was used.
        change_px: mean displacement of the corners of the frames by all of them.
        kept_out: why its last motion was not used; empty if it was.
    """

    name: str
    rounds: tuple[str, ...]
    change_px: float
    kept_out: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Explained:
    """The refined motion, and what the panorama along it does not explain.

    Attributes:
        motion: of every frame; its expected error covers what the residuals show.
        panorama: rendered along the motion, for the residuals.
        residuals: observed minus predicted photons.
        ratio: see `residual_ratio`.
        refinements: what each refiner did.
    """

    motion: FrameMotion
    panorama: Panorama
    residuals: Residuals
    ratio: float
    refinements: tuple[Refinement, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    """A motion, the panorama along it, and what it does not explain."""

    motion: FrameMotion
    panorama: Panorama
    prediction: Prediction
    residuals: Residuals
    ratio: float

    def worse_than(self, other: _Look) -> str:
        """Return how the photons are explained worse than by another motion, as a clause; empty if they are not."""
        misfit, before = (float(look.residuals.misfit.mean()) for look in (self, other))
        if misfit > before + _WORSE_MISFIT:
            return f"the misfit of the photons grew from {before:.3g} to {misfit:.3g}"
        if self.ratio > _WORSE_RATIO * other.ratio:
            return f"the scatter of the shifts grew from {other.ratio:.3g} to {self.ratio:.3g} times the photon noise"
        return ""


def refine(
    source: Source, motion: FrameMotion, refiners: Sequence[NamedRefiner], tolerance_px: float, memory: int, context: Context
) -> Explained:
    """Correct the motion by what short spans of frames show beyond it, and measure what is left.

    Args:
        source: the capture.
        motion: the result of the loop.
        refiners: applied in order, each until it finds nothing, `MAX_ROUNDS` times at most.
        tolerance_px: motion within which frames are summed before they are warped, in px of a frame.
        memory: bytes that rendering may take.
        context: threads and progress.

    Raises:
        CanvasTooLargeError: the panorama is far larger than what fits into the memory.
        LocationError: frames reach the horizon of the reference plane.
        PluginError: a refiner failed, or broke its contract.
    """
    look = _look(source, motion, tolerance_px, memory, context)
    refinements = []
    for refiner in refiners:
        start, kept_out = look.motion, ""
        rounds: list[str] = []
        while len(rounds) < MAX_ROUNDS and not kept_out:
            refined = _refined(refiner, source, look, len(rounds) + 1)
            if refined is None:
                break
            corrected = replace(
                look.motion,
                trajectory=FrameTrajectory(refined.homographies),
                homographies=refined.homographies,
                std_px=refined.std_px,
            )
            seen = _look(source, corrected, tolerance_px, memory, context)
            kept_out = seen.worse_than(look)
            if not kept_out:
                look = seen
                rounds.append(refined.summary)
                context.progress.note(f"{refiner.name}: {refined.summary}")
        refinements.append(Refinement(refiner.name, tuple(rounds), _change_px(start, look.motion), kept_out))
    left_px = unexplained_px(look.residuals, len(motion.std_px))
    motion = replace(look.motion, std_px=np.hypot(look.motion.std_px, left_px))
    return Explained(motion, look.panorama, look.residuals, look.ratio, tuple(refinements))


def _look(source: Source, motion: FrameMotion, tolerance_px: float, memory: int, context: Context) -> _Look:
    """Render the panorama along a motion, at the scale of the frames or the largest that fits, and measure the residuals."""
    shape = motion.frame_shape
    canvas = plan_canvas(motion.trajectory, motion.span, shape, 1.0, memory)
    excess = canvas.height * canvas.width * BYTES_PER_PIXEL / memory
    if excess > 1:
        canvas = plan_canvas(motion.trajectory, motion.span, shape, float(0.99 / np.sqrt(excess)), memory)
    panorama = render(source, motion.trajectory, motion.span, canvas, tolerance_px, context)
    prediction = Prediction.of(panorama, source.response, motion.trajectory, shape)
    residuals = measure(source, motion.span, prediction, context)
    return _Look(motion, panorama, prediction, residuals, residual_ratio(residuals))


def _refined(refiner: NamedRefiner, source: Source, look: _Look, number: int) -> Refined | None:
    """Call a refiner, and check what it returns.

    Raises:
        PluginError: the refiner failed, or broke its contract.
    """
    motion = look.motion
    with attributing(refiner.origin, f"round {number}"):
        found = refiner.component.refine(source, motion.trajectory, motion.std_px, look.residuals.steps(), look.prediction)
        if found is None:
            return None
        if not isinstance(found, Refined):
            raise BrokenContract(f"expected a Refined or None, got {type(found).__name__}")
        n_frames = len(motion.std_px)
        shapes = np.shape(found.homographies), np.shape(found.std_px)
        if shapes != ((n_frames, 3, 3), (n_frames,)):
            raise BrokenContract(
                f"the capture has {n_frames} frames: expected homographies of the shape ({n_frames}, 3, 3) and std_px of the "
                f"shape ({n_frames},), got {shapes[0]} and {shapes[1]}"
            )
        bad = ~np.isfinite(found.homographies).all(axis=(1, 2)) | np.isnan(found.std_px) | (found.std_px < 0)
        if bad.any():
            raise BrokenContract(f"the motion of frame {int(np.argmax(bad))} is not finite, or its std_px is negative or NaN")
        homographies = inverse(found.homographies[motion.reference]) @ found.homographies
        return replace(found, homographies=homographies / homographies[:, 2:, 2:])


def _change_px(before: FrameMotion, after: FrameMotion) -> float:
    """Return the mean displacement of the corners of the located frames."""
    steps = inverse(before.homographies[before.located]) @ after.homographies[before.located]
    return float(corner_displacements(steps, np.eye(3), before.frame_shape).mean()) if len(steps) else 0.0
