"""How well a motion explains the photons: render the panorama along it, and compare it with what was observed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from photonpano.context import Context
from photonpano.geometry import Canvas
from photonpano.merging.canvas_plan import BYTES_PER_PIXEL, plan_canvas
from photonpano.merging.colour import channels_of
from photonpano.merging.light import bytes_of_light
from photonpano.merging.panorama import render
from photonpano.motion.frame_motion import FrameMotion, view_of
from photonpano.protocols import Refiner, Source
from photonpano.residuals.measure import Residuals, measure
from photonpano.residuals.prediction import Predictions
from photonpano.residuals.unexplained import bounded_std_px, residual_ratio, unexplained_px
from photonpano.values import Panorama

# A motion is worse if the scatter of the shifts grows by this factor, or the reduced chi-square of the photons by this much.
_WORSE_RATIO, _WORSE_MISFIT = 1.05, 0.01


@dataclass(frozen=True, slots=True)
class NamedRefiner:
    """A refiner of a run."""

    name: str
    component: Refiner
    origin: str  # who provides it, such as "refiner 'short-spans' of photonpano 0.1.0"


@dataclass(frozen=True, slots=True)
class Refinement:
    """What a refiner did."""

    name: str  # of the refiner
    rounds: tuple[str, ...]  # the summary of each correction that was used
    change_px: float  # mean displacement of the corners of the frames by all of them
    kept_out: str = ""  # why its last motion was not used; empty if it was


@dataclass(frozen=True, slots=True, eq=False)
class Explained:
    """The refined motion, and the residuals of the photons from the panorama along it."""

    motion: FrameMotion  # of every frame; its expected error covers what the residuals show
    # rendered along the motion, for the residuals; in colour, with an image for each colour of the filter array
    panorama: Panorama
    canvas: Canvas  # of the panorama
    residuals: Residuals  # observed minus predicted photons
    ratio: float  # see `residual_ratio`
    refinements: tuple[Refinement, ...]  # what each refiner did


class MotionFit:
    """A motion, the panorama along it, and the residuals of the photons from that panorama.

    The panorama is rendered when it is first needed, which may be never where a checkpoint holds the residuals.

    Attributes:
        motion: of every frame.
        residuals: observed minus predicted photons.
        ratio: see `residual_ratio`.
    """

    def __init__(self, source: Source, motion: FrameMotion, tolerance_px: float, memory: int, context: Context) -> None:
        """Measure the residuals; frames are summed where the motion stays within `tolerance_px`. `memory` is in bytes.

        Raises:
            CanvasTooLargeError: the panorama is far larger than what fits into the memory.
            LocationError: frames reach the horizon of the reference plane.
        """
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

    @property
    def misfit(self) -> float:
        """Mean reduced chi-square of the photons."""
        return float(self.residuals.misfit.mean())

    def explained(self, refinements: Sequence[Refinement] = ()) -> Explained:
        """Return the motion with an expected error that covers the residuals, and what else a verdict needs."""
        std_px, residuals = self.motion.std_px, self.residuals
        std_px = np.hypot(bounded_std_px(std_px, residuals), unexplained_px(residuals, len(std_px)))
        motion = replace(self.motion, std_px=std_px)
        return Explained(motion, self.panorama, self.canvas, residuals, self.ratio, tuple(refinements))

    def _measured(self) -> Residuals:
        return measure(self.motion.span, self.predictions, self._context)

    def worse_than(self, other: MotionFit) -> str:
        """Return how this motion explains the photons worse than another one, as a clause; empty if it does not."""
        before, misfit = other.misfit, self.misfit
        if misfit > before + _WORSE_MISFIT:
            return f"the misfit of the photons grew from {before:.3g} to {misfit:.3g}"
        if self.ratio > _WORSE_RATIO * other.ratio:
            return f"the scatter of the shifts grew from {other.ratio:.3g} to {self.ratio:.3g} times the photon noise"
        return ""
