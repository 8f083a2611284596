"""How well a motion explains the photons of the panorama along it, and its errors beyond photon noise, frame by frame."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d

from photonpano.contracts.protocols import Refiner, Source
from photonpano.execution.context import Context
from photonpano.filtering import SYSTEMATIC_PX
from photonpano.geometry import Canvas, corners, inverse, steps_of
from photonpano.merging.accumulate import bytes_of_light
from photonpano.merging.colour import channels_of
from photonpano.merging.panorama import BYTES_PER_PIXEL, plan_canvas, render
from photonpano.motion.frame_motion import FrameMotion, view_of
from photonpano.residuals.halves import Halves, halves_of
from photonpano.residuals.measure import Lasting, Residuals, lasting_of, measure, noise_hides_shifts
from photonpano.residuals.patterns import LensDistortion, lens_distortion
from photonpano.residuals.prediction import Predictions
from photonpano.values import FloatArray, Panorama

_SMOOTH_SPANS = 25  # the ratio is that of motion faster than this many spans
FEWEST_SPANS = 2 * _SMOOTH_SPANS  # for the ratio
_LOCAL_SPANS = 33  # the size is averaged over this many spans
# Motion is taken to be left where the mean square exceeds that of the noise by this many of its standard deviations.
_SIGNIFICANT = 3.0
# A single span stands out if the sum of its four squared steps, over their variances, exceeds this. Noise does so once in
# 200,000 spans.
_STANDS_OUT = 30.0
# The measured steps of three spans bound the error of frames that are at most one span away from one.
_BOUND_SPANS, _NEAR_SPANS = 3, 1.0

# Motion within which frames are summed for the panorama of the residuals, which is smoothed by more than this. Within 0.125 px,
# there are four times as many warps, and the errors of three captures were the same to 0.001 px.
TOLERANCE_PX = 0.5
_DARK = -0.5  # spans that are darker than predicted by half of the light or more show too little to be measured
# A motion is worse if the scatter of the shifts grows by this factor, or the reduced chi-square of the photons by this much.
_WORSE_RATIO, _WORSE_CHI2 = 1.05, 0.01


def residual_ratio(residuals: Residuals) -> float:
    """Return the scatter of the shifts of short spans over that of photon noise and interpolation; NaN for fewer than 50.

    It is 1 where the motion is all there is. Slow changes are left out, since the panorama follows them.
    """
    steps, variances = _series(residuals)
    shifts, expected = steps[:, :2], variances[:, :2]
    known = np.isfinite(expected).all(axis=1)
    if known.sum() < FEWEST_SPANS:
        return float("nan")
    ratios = shifts[known] / np.sqrt(expected[known])
    kernel = np.ones(_SMOOTH_SPANS) / _SMOOTH_SPANS
    slow = np.stack([np.convolve(np.pad(each, _SMOOTH_SPANS // 2, mode="edge"), kernel, "valid") for each in ratios.T], axis=1)
    return float(np.sqrt(np.mean((ratios - slow) ** 2) / (1 - 1 / _SMOOTH_SPANS)))


def unexplained_px(residuals: Residuals, n_frames: int) -> FloatArray:
    """Return the corner error that the residuals show beyond photon noise, for every frame of the capture: (n_frames,).

    It is the root mean square over 33 spans around the frame, or the step of a single span if that stands out, as at a place
    where frames are missing; 0 where noise explains it. What frames shake within spans is added.
    """
    return np.hypot(_beyond_noise_px(residuals, n_frames), residuals.shaking.size_px)


def _beyond_noise_px(residuals: Residuals, n_frames: int) -> FloatArray:
    steps, variances = _series(residuals)
    known = np.isfinite(variances).all(axis=1)
    if known.sum() < 2:
        return np.zeros(n_frames)
    squares, noise = (steps[known] ** 2).sum(axis=1), variances[known].sum(axis=1)
    spread = 2 * (variances[known] ** 2).sum(axis=1)
    size = min(_LOCAL_SPANS, len(squares))
    kernel = np.ones(size) / size
    left, right = (size - 1) // 2, size // 2
    local, floor, width = (
        np.convolve(np.pad(each, (left, right), mode="reflect"), kernel, "valid") for each in (squares, noise, spread)
    )
    excess = local - floor
    found = np.where(excess > _SIGNIFICANT * np.sqrt(width / size), np.sqrt(np.maximum(excess, 0)), 0)
    # The frames of a span and of its neighbours may move by as much as its step.
    single = np.where((steps[known] ** 2 / variances[known]).sum(axis=1) > _STANDS_OUT, np.sqrt(squares), 0)
    found = np.maximum(found, sliding_window_view(np.pad(single, 1), 3).max(axis=1))
    return np.asarray(np.interp(np.arange(n_frames), residuals.instants[known], found))


def bounded_std_px(std_px: FloatArray, residuals: Residuals) -> FloatArray:
    """Return the expected corner errors (T,), infinite where not located, no larger than the residuals allow.

    A frame lies within its measured shift, roll and zoom of the panorama, and so of the surest frame that sees the same place.
    At the ends of a capture, where motion is extrapolated, this is less than what extrapolation lets expect.
    """
    steps, variances = _series(residuals)
    known = np.isfinite(variances).all(axis=1) & (residuals.gains()[0] > _DARK)
    if known.sum() < _BOUND_SPANS:
        return std_px
    squares = np.pad((steps[known] ** 2 + variances[known]).sum(axis=1), _BOUND_SPANS // 2, mode="edge")
    local = sliding_window_view(squares, _BOUND_SPANS).mean(axis=1)
    frames, instants = np.arange(len(std_px)), residuals.instants[known]
    measured = np.interp(frames, instants, local)
    measured[distance_to_nearest(instants, frames) > _NEAR_SPANS * np.median(np.diff(residuals.instants))] = np.inf
    reach = max(1, int(residuals.frames_seen / 4))
    surest = minimum_filter1d(std_px**2 + measured, 2 * reach + 1, mode="nearest")
    return np.asarray(np.minimum(std_px, np.where(np.isfinite(std_px), np.sqrt(surest + measured), np.inf)))


def distance_to_nearest(instants: FloatArray, frames: NDArray[np.integer]) -> FloatArray:
    """Return the distance of each frame to the nearest of instants that are in order, in frames."""
    after = np.searchsorted(instants, frames).clip(1, len(instants) - 1)
    return np.asarray(np.minimum(abs(frames - instants[after - 1]), abs(frames - instants[after])))


def _series(residuals: Residuals) -> tuple[FloatArray, FloatArray]:
    """Return the steps of the spans as motions of a corner in px, and their expected variances: (S, 4) each."""
    shape = corners(residuals.frame_shape)
    radius_px = float(np.linalg.norm(shape[0] - shape.mean(axis=0)))
    to_px = np.array([1, 1, radius_px, radius_px])
    found = residuals.steps()
    return found.steps * to_px, found.variances * to_px**2 + SYSTEMATIC_PX**2


@dataclass(frozen=True, slots=True)
class NamedRefiner:
    """A refiner of a run."""

    name: str
    component: Refiner


@dataclass(frozen=True, slots=True)
class Refinement:
    """What a refiner did."""

    name: str  # of the refiner
    rounds: tuple[str, ...]  # the summary of each correction that was used
    change_px: float  # mean displacement of the corners of the frames by all of them
    kept_out: str = ""  # why its last motion was not used; empty if it was


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Explained:
    """The refined motion, and the residuals of the photons from a panorama along it."""

    motion: FrameMotion  # of every frame; its expected error covers what the residuals show
    canvas: Canvas  # of the panorama that the residuals were measured against
    residuals: Residuals  # observed minus predicted photons
    ratio: float  # see `residual_ratio`
    halves: Halves  # how well the frames before and after cuts agree
    refinements: tuple[Refinement, ...]  # what each refiner did
    lens: LensDistortion | None = None  # that the residuals show; None if it is not significant
    lasting: Lasting | None = None  # what brief spans have in common, where photon noise hides the shift of longer ones


class MotionFit:
    """A motion, the panorama along it, and the residuals of the photons from that panorama.

    The panorama is rendered when it is first needed, which may be never where a checkpoint holds the residuals.

    Attributes:
        motion: of every frame.
        residuals: observed minus predicted photons.
        ratio: see `residual_ratio`.
    """

    def __init__(self, source: Source, motion: FrameMotion, memory: int, context: Context) -> None:
        """Measure the residuals. `memory` is in bytes.

        Raises:
            CanvasTooLargeError: the panorama is far larger than what fits into the memory.
            LocationError: frames reach the horizon of the reference plane.
        """
        self.motion = motion
        self._source, self._memory, self._context = source, memory, context
        once = context.checkpoints.once
        self.residuals: Residuals = once("residuals", self._measured, motion.homographies, motion.span)
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
        """The panorama along the motion; in colour, with an image for each colour of the filter array."""
        motion = self.motion
        return render(self._source, motion.trajectory, motion.span, self.canvas, TOLERANCE_PX, self._context)

    @cached_property
    def predictions(self) -> Predictions:
        """The panorama as the camera would see it."""
        return Predictions.of(self._source, self.panorama, self.canvas, self.motion.trajectory, self.motion.frame_shape)

    @property
    def reduced_chi2(self) -> float:
        """Mean reduced chi-square of the photons."""
        return float(self.residuals.reduced_chi2.mean())

    def explained(self, refinements: Sequence[Refinement] = ()) -> Explained:
        """Return the motion with an expected error that covers the residuals, and what else a verdict needs."""
        std_px, located, residuals = self.motion.std_px, self.motion.located, self.residuals
        beyond_px2 = unexplained_px(residuals, len(std_px)) ** 2
        # All motions are to the reference frame: what is wrong there, as where the camera turns back in it, is wrong of all.
        of_reference_px2 = max(float(beyond_px2[self.motion.reference] - np.median(beyond_px2[located])), 0.0)
        std_px = np.sqrt(bounded_std_px(std_px, residuals) ** 2 + beyond_px2 + of_reference_px2)
        compared = partial(halves_of, self._source, self.motion, self.canvas, self._context)
        once, of_motion = self._context.checkpoints.once, (self.motion.homographies, self.motion.span)
        halves = once("halves", compared, *of_motion)
        lasting = once("lasting", self._lasting, *of_motion) if noise_hides_shifts(residuals) else None
        # Two frames know no more of each other than the weakest cut between them lets through.
        motion = replace(self.motion, std_px=np.maximum(std_px, halves.tied_px(located)))
        return Explained(
            motion=motion,
            canvas=self.canvas,
            residuals=residuals,
            ratio=self.ratio,
            halves=halves,
            refinements=tuple(refinements),
            lens=self._lens(),
            lasting=lasting,
        )

    def moved(self, motion: FrameMotion) -> MotionFit:
        """Return the fit of a motion that differs by a small fraction of a pixel, to first order, from the same panorama.

        What all steps have in common moves the panorama, not the frames against it.
        """
        fit, instants = copy(self), self.residuals.instants
        steps = steps_of(inverse(self.motion.trajectory.at(instants)) @ motion.trajectory.at(instants), motion.frame_shape)
        fit.motion, fit.residuals = motion, self.residuals.moved(steps - steps.mean(axis=0))
        fit.ratio = residual_ratio(fit.residuals)
        return fit

    def _lens(self) -> LensDistortion | None:
        shown = self.motion.homographies[self.motion.located], self.residuals.frame_shape
        found = lens_distortion(*self.residuals.block_shifts(), *shown)
        # What else is not explained, such as a tremor, moves blocks by more than photon noise.
        misfit = max(1.0, float(self.residuals.reduced_chi2.mean())) ** 0.5
        return None if found is None or found.sigmas <= 5 * misfit else found

    def _lasting(self) -> Lasting:
        return lasting_of(self.residuals, self.predictions, self._context)

    def _measured(self) -> Residuals:
        return measure(self.motion.span, self.predictions, self._context)

    def worse_than(self, other: MotionFit) -> str:
        """Return how this motion explains the photons worse than another one, as a clause; empty if it does not."""
        before, reduced_chi2 = other.reduced_chi2, self.reduced_chi2
        if reduced_chi2 > before + _WORSE_CHI2:
            return f"the reduced chi-square of the photons grew from {before:.3g} to {reduced_chi2:.3g}"
        if self.ratio > _WORSE_RATIO * other.ratio:
            return f"the scatter of the shifts grew from {other.ratio:.3g} to {self.ratio:.3g} times the photon noise"
        return ""
