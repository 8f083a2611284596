"""Refine the motion until the residuals are photon noise: render, measure what is left, correct the motion, and again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from photonpano.context import Context
from photonpano.contracts.attribution import attributing
from photonpano.contracts.results import REFINED
from photonpano.errors import CanvasTooLargeError, LocationError
from photonpano.geometry import BLOCK_FRAMES, Canvas, FrameTrajectory, corner_displacements, inverse, nearest_rotations
from photonpano.merging.canvas_plan import BYTES_PER_PIXEL, plan_canvas
from photonpano.merging.colour import channels_of
from photonpano.merging.light import bytes_of_light
from photonpano.merging.panorama import render
from photonpano.motion.frame_motion import FrameMotion, view_of
from photonpano.protocols import Refiner, Source
from photonpano.residuals.measure import Residuals, measure
from photonpano.residuals.prediction import Predictions
from photonpano.residuals.unexplained import bounded_std_px, residual_ratio, unexplained_px
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
        panorama: rendered along the motion, for the residuals; in colour, with an image for each colour of the filter array.
        canvas: of the panorama.
        residuals: observed minus predicted photons.
        ratio: see `residual_ratio`.
        refinements: what each refiner did.
    """

    motion: FrameMotion
    panorama: Panorama
    canvas: Canvas
    residuals: Residuals
    ratio: float
    refinements: tuple[Refinement, ...]


class Look:
    """A motion, the panorama along it, and what it does not explain.

    The panorama is rendered when it is first needed; where the residuals were kept, that may be never.

    Attributes:
        motion: of every frame.
        residuals: what the panorama along the motion does not explain.
        ratio: see `residual_ratio`.
    """

    def __init__(self, source: Source, motion: FrameMotion, tolerance_px: float, memory: int, context: Context) -> None:
        self.motion = motion
        self._source, self._tolerance_px, self._memory, self._context = source, tolerance_px, memory, context
        given = motion.homographies, motion.span
        self.residuals: Residuals = context.checkpoints.once("residuals", self._measured, *given)
        self.ratio = residual_ratio(self.residuals)

    @cached_property
    def canvas(self) -> Canvas:
        """The canvas at the scale of the frames, or at the largest that fits."""
        motion, view = self.motion, view_of(self.motion, self._source)
        shown = motion.trajectory, motion.span, motion.frame_shape
        bytes_per_pixel = channels_of(self._source) * (BYTES_PER_PIXEL + bytes_of_light(self._source))
        canvas = plan_canvas(*shown, 1.0, self._memory, bytes_per_pixel, view=view)
        excess = canvas.height * canvas.width * bytes_per_pixel / self._memory
        if excess <= 1:
            return canvas
        return plan_canvas(*shown, float(0.99 / np.sqrt(excess)), self._memory, bytes_per_pixel, view=view)

    @cached_property
    def panorama(self) -> Panorama:
        """The panorama along the motion."""
        motion = self.motion
        return render(self._source, motion.trajectory, motion.span, self.canvas, self._tolerance_px, self._context)

    @cached_property
    def predictions(self) -> Predictions:
        """The panorama as the camera would see it."""
        return Predictions.of(self._source, self.panorama, self.canvas, self.motion.trajectory, self.motion.frame_shape)

    def _measured(self) -> Residuals:
        return measure(self.motion.span, self.predictions, self._context)

    def worse_than(self, other: Look) -> str:
        """Return how the photons are explained worse than by another motion, as a clause; empty if they are not."""
        misfit, before = (float(look.residuals.misfit.mean()) for look in (self, other))
        if misfit > before + _WORSE_MISFIT:
            return f"the misfit of the photons grew from {before:.3g} to {misfit:.3g}"
        if self.ratio > _WORSE_RATIO * other.ratio:
            return f"the scatter of the shifts grew from {other.ratio:.3g} to {self.ratio:.3g} times the photon noise"
        return ""


def refine(
    source: Source, look: Look, refiners: Sequence[NamedRefiner], tolerance_px: float, memory: int, context: Context
) -> Explained:
    """Correct the motion by what short spans of frames show beyond it, and measure what is left.

    Args:
        source: the capture.
        look: the result of the loop, and what it does not explain.
        refiners: applied in order, each until it finds nothing, `MAX_ROUNDS` times at most.
        tolerance_px: motion within which frames are summed before they are warped, in px of a frame.
        memory: bytes that rendering may take.
        context: threads and progress.

    Raises:
        CanvasTooLargeError: the panorama is far larger than what fits into the memory.
        LocationError: frames reach the horizon of the reference plane.
        PluginError: a refiner failed, or broke its contract.
    """
    refinements = []
    for place, refiner in enumerate(refiners):
        start, kept_out = look.motion, ""
        rounds: list[str] = []
        while len(rounds) < MAX_ROUNDS and not kept_out:
            number = len(rounds) + 1
            correct = partial(_refined, refiner, source, look, number)
            given = place, number, look.motion.homographies, look.motion.std_px
            refined = context.checkpoints.once("refined", correct, *given)
            if refined is None:
                break
            corrected = replace(
                look.motion,
                trajectory=FrameTrajectory(refined.homographies),
                homographies=refined.homographies,
                std_px=refined.std_px,
            )
            try:
                seen = Look(source, corrected, tolerance_px, memory, context)
                kept_out = seen.worse_than(look)
            except (CanvasTooLargeError, LocationError) as error:
                kept_out = " ".join(str(error).split())
            if not kept_out:
                look = seen
                rounds.append(refined.summary)
                context.progress.note(f"{refiner.name}: {refined.summary}")
        refinements.append(Refinement(refiner.name, tuple(rounds), _change_px(start, look.motion), kept_out))
    left_px = unexplained_px(look.residuals, len(look.motion.std_px))
    motion = replace(look.motion, std_px=np.hypot(bounded_std_px(look.motion.std_px, look.residuals), left_px))
    return Explained(motion, look.panorama, look.canvas, look.residuals, look.ratio, tuple(refinements))


def _refined(refiner: NamedRefiner, source: Source, look: Look, number: int) -> Refined | None:
    """Call a refiner, and check what it returns.

    Raises:
        PluginError: the refiner failed, or broke its contract.
    """
    motion = look.motion
    with attributing(refiner.origin, f"round {number}"):
        std_px = motion.std_px.copy()
        found = refiner.component.refine(source, motion.trajectory, std_px, look.residuals.steps(), look.predictions)
        if found is None:
            return None
        found = REFINED.require(found, motion.std_px)
        homographies = inverse(found.homographies[motion.reference]) @ found.homographies
        if motion.camera is not None:
            turned = nearest_rotations(motion.camera.rotations(homographies))
            return replace(found, homographies=motion.camera.homographies(turned[motion.reference].T @ turned))
        homographies /= homographies[:, 2:, 2:].copy()
        return replace(found, homographies=homographies)


def _change_px(before: FrameMotion, after: FrameMotion) -> float:
    """Return the mean displacement of the corners of the located frames."""
    total = 0.0
    for block in before.span.blocks(BLOCK_FRAMES):
        first, last = (motion.homographies[block.start : block.stop] for motion in (before, after))
        total += float(corner_displacements(inverse(first) @ last, np.eye(3), before.frame_shape).mean(axis=-1).sum())
    return total / len(before.span)
