"""The loop of the paper (section 4): re-sample, merge, locate, interpolate; each level with denser groups."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.ndimage import uniform_filter1d

from photonpano.capture import capture_of, seen_through
from photonpano.contracts.attribution import blaming
from photonpano.contracts.protocols import Source, Trajectory, camera_of_motion
from photonpano.contracts.requirements import require_near_knots
from photonpano.execution.threads import Stopwatch
from photonpano.filtering import smooth_share
from photonpano.geometry import align_planes, corner_displacements, corners, inverse, moving_corners, transform_points
from photonpano.motion.adjustment import std_of
from photonpano.motion.diagnosis import require_in_front
from photonpano.motion.level import Level, Timeline, VirtualExposures
from photonpano.motion.locate import LocatedLevel, LoopSetting, locate
from photonpano.motion.models import SAME_LENS_PX, MotionModel
from photonpano.motion.pairs import require_agreement, ties_of
from photonpano.motion.rotations import ReferencedTrajectory, RotationTrajectory, fit_rotations
from photonpano.motion.smooth_path import SmoothPath
from photonpano.motion.tracking import starting_motion
from photonpano.motion.trajectories import Interpolated, Knots, RefinedMotion, Uncertainty
from photonpano.values import FloatArray, FrameSpan, Group

_DRAWS = 4  # errors of knots by which it is found how much of them an interpolator leaves
_FEWEST_KNOTS = 8  # that an interpolator smooths
_AROUND, _LEAST_LEFT = 9, 0.05  # knots over which that is averaged, and least share of the variance that is left
_BESIDE = 33  # knots over which it is averaged how far they lie beside the motion
_CENTRED = 2  # times that knots are moved to the instants of their exposures
_SHRINKS = 0.75  # change of the motion by a level, over that by the level before, from which on it no longer converges

TOO_NARROW = 3.0  # expected errors by which homographies that are likelier differ from what a model of the motion can hold


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class LevelResult:
    """The motion after one level."""

    level: Level  # its components
    groups: tuple[Group, ...]  # the frames of each virtual exposure
    located: LocatedLevel  # pairs of exposures, their motions, and the homography of each exposure
    trajectory: Trajectory  # the motion of every frame; the reference frame's homography is the identity
    uncertainty: Uncertainty  # the expected error of the trajectory
    seconds: dict[str, float]
    exposures: VirtualExposures  # its virtual exposures, which can be merged again

    @property
    def change_px(self) -> float | None:
        """Mean displacement of the corners of the frames since the previous level, px of a frame; None at the first level."""
        return self.uncertainty.change_px

    @property
    def narrow(self) -> float:
        """How far homographies lie from a model that is less likely, in expected errors; 0 otherwise."""
        rivals, model = self.located.rivals, self.located.solution.model
        if model.kind == "homography" or "homography" not in rivals or not rivals[model.name].deviance:
            return 0.0
        return rivals["homography"].apart_px / float(np.hypot(self.uncertainty.mean_px, SAME_LENS_PX))

    @property
    def converged(self) -> bool:
        """Whether the level changed the motion by no more than its expected error."""
        return self.change_px is not None and self.change_px <= self.uncertainty.mean_px


def converges(results: Sequence[LevelResult]) -> bool:
    """Return whether another level may gain: the last one changed the motion by more than its error, and less than before.

    What changes hardly less from level to level is faster than the groups, as a tremor, which refiners correct.
    """
    last, before = results[-1], results[-2].change_px if len(results) > 1 else None
    return not last.converged and (before is None or last.change_px is None or last.change_px < _SHRINKS * before)


def estimate_motion(
    setting: LoopSetting,
    levels: Sequence[Level],
    previous: Trajectory | None = None,
    *,
    known: FrameSpan | None = None,
    corrected: Trajectory | None = None,
    until_converged: bool = False,
) -> list[LevelResult]:
    """Estimate the motion of a capture, level by level (paper, section 4).

    Virtual exposures are planned first. `locate` merges each of them in its pool of threads, has it described, and releases
    it; the description is kept until the last pair of the exposure is registered. Memory therefore does not grow with the
    number of groups. An exposure that a fallback locator or a loop closure needs is merged again.

    `previous` is the motion known so far, which each level replaces; one that is `known` in some frames alone was extrapolated
    to the others. A motion that is `corrected`, by default that of the gyroscope, is not replaced: it keeps its tremor, and
    goes on beyond the first and the last exposure. With `until_converged`, the loop ends as soon as another level would gain
    nothing: see `converges`.

    Raises:
        InputError: the images contradict points that are tied by hand, or the gyroscope.
        LocationError: too few exposures could be located.
        PluginError: a component failed, or broke its contract.
    """
    results: list[LevelResult] = []
    source, context, reference, timeline = setting.source, setting.context, setting.reference, setting.timeline
    if corrected is None and setting.gyroscope is not None:
        corrected = setting.gyroscope.trajectory(reference)
    previous = corrected if previous is None else previous
    for level in levels:
        if results and context.time_limit.leaves_out("further levels"):
            break
        clock = Stopwatch()
        layered = capture_of(source).background is not None
        model = replace(setting.model.knowing(camera_of_motion(previous)), layered=layered, rough=level.scale < setting.finest)
        setting = replace(setting, model=model)
        groups = timeline.parts(resample(level, source.info.n_frames, clock))
        turning = level.turning(model.turning_camera(source.info.frame_shape))
        seen = through_lens(source, model)
        start = None
        if previous is None:
            with clock("locate"):
                start = context.checkpoints.once("level-1-start", partial(starting_motion, seen, groups, context), groups)
            start = start and replace(start, timeline=timeline)
        exposures = VirtualExposures(
            level=turning,
            source=seen,
            groups=groups,
            previous=previous,
            clock=clock,
            timeline=timeline,
            start=start,
            known=known,
        )
        located = locate(exposures, setting, start)
        interpolated = interpolate(exposures, located, timeline, reference, corrected)
        trajectory = interpolated.trajectory
        require_agreement(ties_of(setting.graph.tie, seen), groups, located.solution.located, trajectory)
        uncertainty = Uncertainty(located, interpolated, previous, timeline)
        results.append(
            LevelResult(
                level=level,
                groups=groups,
                located=located,
                trajectory=trajectory,
                uncertainty=uncertainty,
                seconds=clock.seconds,
                exposures=exposures,
            )
        )
        context.progress.note(_summary(results[-1]))
        context.on_level(results[-1])
        previous, known = trajectory, located.covered
        # A level at half size only prepares for one at full size.
        if until_converged and level.scale == levels[-1].scale and not converges(results):
            break
    return results


def through_lens(source: Source, model: MotionModel) -> Source:
    """Return a capture as the camera of a model sees it, whose lens bends frames as far as it is known."""
    camera = model.seen_by(source.info.frame_shape)
    return seen_through(source, camera) if camera.distorts else source


def resample(level: Level, n_frames: int, clock: Stopwatch) -> tuple[Group, ...]:
    """Choose the groups of a level (paper, section 4, "Re-sample"), or raise a `PluginError`."""
    with clock("resample"):
        return level.resampler.groups(n_frames, level.number)


def interpolate(
    exposures: VirtualExposures, located: LocatedLevel, timeline: Timeline, reference: int, refined: Trajectory | None = None
) -> Interpolated:
    """Fit a homography for every frame to the located instants (paper, section 4, "Interpolate"), between cuts.

    An exposure shows the mean of its frames, which lies elsewhere than its instant if the motion within it was not what it was
    merged along. How far is known as soon as the motion is, so that the knots are moved there, and the motion is fitted again:
    as far as accelerations predict it, since a motion that trembles within groups is not known from their means.

    A `refined` motion is not replaced: what is interpolated is how far the exposures merged along it are from it.

    Raises:
        LocationError: the interpolator failed because exposures reach the horizon of the plane.
        PluginError: the interpolator failed, or its trajectory has nothing to do with these instants.
    """
    measured = Knots.of(located)
    with exposures.clock("interpolate"):
        knots, trajectory = (
            measured,
            _through(measured, exposures, located, timeline=timeline, reference=reference, refined=refined),
        )
        for _ in range(_CENTRED):
            displaced = exposures.off_centre(trajectory)[located.solution.located]
            smooth = _smooth_share(trajectory, located)
            knots = measured.moved(smooth * displaced + (1 - smooth) * np.eye(3))
            trajectory = _through(knots, exposures, located, timeline=timeline, reference=reference, refined=refined)
        # No interpolator smooths what all exposures share, such as the error of a focal length.
        shared_px = std_of(located.assessed.shared_px)
        # Neither do exposures see how a path errs within them.
        unseen_px = refined.std_px if isinstance(refined, SmoothPath) else 0.0
        std_px = np.hypot(located.std_px, unseen_px)
        own_px = located.assessed.errors_px - located.assessed.shared_px
        if len(std_px) < _FEWEST_KNOTS:
            return Interpolated(trajectory, std_px, np.zeros(len(std_px)))
        products, here, known = np.zeros((2, len(std_px))), corners(located.frame_shape), trajectory.at(located.instants)
        among = trajectory.at(knots.instants)
        aligned = inverse(among) @ align_planes(knots.homographies, among, located.frame_shape) @ knots.homographies
        left_px2 = (corner_displacements(aligned, np.eye(3), located.frame_shape) ** 2).mean(axis=-1)
        for errors in np.moveaxis(own_px, -1, 0)[:_DRAWS]:
            moved = knots.moved(moving_corners(errors, located.frame_shape))
            answer = _through(moved, exposures, located, timeline=timeline, reference=reference, refined=refined).at(
                located.instants
            )
            answer = inverse(known) @ align_planes(answer, known, located.frame_shape) @ answer
            products += (errors**2).sum(axis=1), ((transform_points(answer, here) - here).reshape(-1, 8) * errors).sum(axis=1)
    # The covariance of what is smoothed with the errors of what it is made of is its variance (a Gaussian smoother), and knots
    # lie beside it by the rest of theirs.
    before, after = uniform_filter1d(products, _AROUND, axis=1, mode="nearest")
    share = np.clip(after / np.maximum(before, np.finfo(float).tiny), _LEAST_LEFT, 1)
    own_std_px = std_of(own_px)
    beyond = uniform_filter1d(left_px2 - (1 - share) * own_std_px**2, _BESIDE, mode="reflect")
    std_px = np.sqrt(shared_px**2 + share * own_std_px**2 + unseen_px**2)
    return Interpolated(trajectory, std_px, np.sqrt(np.maximum(beyond, 0)))


def _smooth_share(trajectory: Trajectory, located: LocatedLevel) -> float:
    """Return how far accelerations predict the motion, at the mean distance of the exposures; 0 for few of them."""
    instants = located.instants
    if len(instants) < _FEWEST_KNOTS:
        return 0.0
    motions = trajectory.at(np.linspace(instants[0], instants[-1], len(instants)))
    here = corners(located.frame_shape)
    steps = transform_points(inverse(motions[:-1]) @ motions[1:], here) - here
    return smooth_share(np.cumsum(steps.reshape(len(steps), -1), axis=0))


def _through(
    knots: Knots,
    exposures: VirtualExposures,
    located: LocatedLevel,
    *,
    timeline: Timeline,
    reference: int,
    refined: Trajectory | None,
) -> Trajectory:
    """Interpolate knots, between cuts."""
    level, turns, shape = exposures.level, located.solution.rotations, located.frame_shape
    camera = None if turns is None else turns.camera
    known = None if refined is None else RefinedMotion(refined, len(timeline.taken), camera, shape)
    instants, homographies, information, rotations = knots if known is None else known.corrections(knots)

    def kept(found: Trajectory, knots: slice, times: FloatArray, homographies: FloatArray) -> Trajectory:
        with blaming(level.interpolator):
            require_near_knots(found, times, homographies, located.std_px[knots], shape)
        return found

    def fitted(knots: slice, times: FloatArray) -> Trajectory:
        of_knots = None if information is None else information[knots].copy()
        if rotations is not None:
            checked = partial(kept, knots=knots, times=times)
            return fit_rotations(level.interpolator, times, rotations.of(knots), of_knots, checked)
        try:
            found = level.interpolator.fit(times, homographies[knots], of_knots)
        except Exception as error:
            require_in_front(level.number, located.groups, located.solution, shape, error)
            raise
        return kept(found, knots, times, homographies[knots])

    free = timeline.fit(fitted, instants)
    if known is not None:
        free = known.corrected(free)
    return ReferencedTrajectory(free, reference) if camera is None else RotationTrajectory(free, camera, reference)


def _summary(result: LevelResult) -> str:
    located = result.located
    text = f"level {result.level.number}: {located.n_located} of {len(result.groups)} exposures located"
    if located.failures:
        text += f", {len(located.failures)} of {len(located.edges)} pairs failed"
    return text if result.change_px is None else f"{text}, the motion changed by {result.change_px:.2f} px"
