"""Find the shots of a capture: parts that no motion ties together, as where the camera was stopped and moved."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from photonpano.contracts.protocols import Source
from photonpano.errors import PhotonpanoError, described
from photonpano.execution.context import Progress
from photonpano.geometry import corners, inverse, transform_points
from photonpano.merging import binned_mean
from photonpano.motion.graph import components
from photonpano.motion.locate import LocatedLevel
from photonpano.plugins.contributions import PartOfCapture
from photonpano.record.run_json import findings_of
from photonpano.record.run_warnings import other_shots
from photonpano.record.schema import RunRecord
from photonpano.robust import robust_std
from photonpano.specs.plan import Plan
from photonpano.values import FloatArray, FrameSpan, Group

logger = logging.getLogger(__name__)
ResultT = TypeVar("ResultT")

_BLOCKS, _SHORTEST, _LONGEST = 64, 4, 32  # blocks of frames that are compared; fewest and most frames of one
_SIDE = 4  # blocks before and after an instant whose means are compared
_ABRUPT = 3.0  # least change of the image where a shot ends, relative to the changes around it, without photon noise
_SURE = 6.0  # standard deviations of these changes by which it must exceed them
_FEWEST = 3  # exposures of a shot


class ApartError(Exception):
    """Raised where the motion was known as one, and turns out to be that of several `shots`."""

    def __init__(self, shots: tuple[FrameSpan, ...]) -> None:
        super().__init__(shots)
        self.shots = shots


def parts_of(located: LocatedLevel) -> NDArray[np.integer]:
    """Number the parts that the exposures of a level fall into: (N,).

    No pair ties them together, or the image is upside down from one to the next, as no camera turns.
    """
    there, middle = np.flatnonzero(located.solution.located), corners(located.frame_shape).mean(axis=0)
    homographies = located.solution.homographies[there]
    moved = transform_points(inverse(homographies[:-1]) @ homographies[1:], middle + np.array([[0.0, 0.0], [1.0, 0.0]]))
    labels, turned = components(len(located.groups), located.edges), np.zeros(len(located.groups), dtype=int)
    turned[there[1:]] = moved[:, 1, 0] < moved[:, 0, 0]
    return np.asarray(labels + (labels.max() + 1) * turned.cumsum())


def shots_of(
    source: Source, groups: Sequence[Group], labels: NDArray[np.integer], cuts: Sequence[int] = ()
) -> tuple[FrameSpan, ...]:
    """Return the shots of a capture whose exposures fall into parts; none unless there are `cuts`, or abrupt changes, between.

    Motion that is too fast, and darkness, also tear the exposures apart; there, the image changes all the time, or not at all.
    """
    members = [np.flatnonzero(labels == part) for part in np.flatnonzero(np.bincount(labels) >= _FEWEST)]
    members.sort(key=lambda each: int(each[0]))
    if len(members) < 2 or any(one[-1] > other[0] for one, other in pairwise(members)):
        return ()
    starts = [0]
    for one, other in pairwise(members):
        # A group that holds the change may be tied to either part.
        first, last = groups[one[-1]].span, groups[other[0]].span
        between = FrameSpan(min(first.start, last.start), max(first.stop, last.stop))
        start = next((cut for cut in cuts if between.start < cut < between.stop), None) or _first_after_change(source, between)
        if start is None:
            return ()
        starts.append(start)
    return tuple(map(FrameSpan, starts, [*starts[1:], source.info.n_frames]))


def _first_after_change(source: Source, span: FrameSpan) -> int | None:
    """Return the first frame of a span after the image changes from one frame to the next; None if it changes gradually.

    How much the image changes otherwise is seen in the span, and in as many frames before and after it.
    """
    length = int(np.clip(3 * len(span) // _BLOCKS, _SHORTEST, _LONGEST))
    around = FrameSpan(max(0, span.start - len(span)), min(source.info.n_frames, span.stop + len(span)))
    blocks = [each for each in around.blocks(length) if len(each) == length]
    if len(blocks) < 4 * _SIDE:
        return None
    images = np.stack([np.nan_to_num(binned_mean(source, block)) for block in blocks])
    sums = np.concatenate([np.zeros((1, *images.shape[1:])), images.cumsum(axis=0)])
    means = (sums[_SIDE:] - sums[:-_SIDE]) / _SIDE
    # Blocks that alternate show the same image, with the same noise.
    signs = (-1.0) ** np.arange(len(images))[:, None, None]
    alternating = np.concatenate([np.zeros((1, *images.shape[1:])), (signs * images).cumsum(axis=0)])
    noise = ((alternating[2 * _SIDE :] - alternating[: -2 * _SIDE]) / _SIDE) ** 2
    changes = ((means[_SIDE:] - means[:-_SIDE]) ** 2 - noise).mean(axis=(1, 2))
    starts = around.start + length * (np.arange(len(changes)) + _SIDE)
    index = int(np.where((span.start <= starts) & (starts < span.stop), changes, -1).argmax())
    usual = float(np.median(changes))
    if changes[index] < max(_ABRUPT * usual, usual + _SURE * robust_std(changes - usual)):
        return None
    # The change lies within a block of the boundary between both means.
    first = int(starts[index]) - length
    frames = [np.nan_to_num(binned_mean(source, FrameSpan(frame, frame + 1))) for frame in range(first, first + 2 * length)]
    before, after = means[max(index - 1, 0)], means[min(index + _SIDE + 1, len(means) - 1)]
    misfit: FloatArray = np.array([((frame - before) ** 2 - (frame - after) ** 2).sum() for frame in frames])
    return first + int(np.concatenate([[0.0], misfit.cumsum()]).argmin())


def run_others(plan: Plan, record: RunRecord, run: Callable[[Plan], ResultT], progress: Progress) -> Iterator[ResultT]:
    """Run each shot that a finished run has left out, into a folder beside its own. One that fails is a warning."""
    for folder, shot in other_shots(findings_of(record).shots, plan.output.directory).items():
        progress.note(f"{plan.output.directory} is finished; {shot}, another shot, are run into {folder}")
        try:
            narrowed = _narrowed(plan, shot, record["source"]["frame_rate_hz"])
            yield run(narrowed.having("output", directory=folder))
        except Exception as error:
            message = str(error) if isinstance(error, PhotonpanoError) else described(error)
            logger.warning("no panorama of %s, another shot, was written into %s: %s", shot, folder, message)


def _narrowed(plan: Plan, shot: FrameSpan, rate_hz: float | None) -> Plan:
    """Return a plan that reads the frames of a shot alone, which count from the first frame that `plan` reads."""
    config = plan.source.config
    first = config.frames[0] if isinstance(config, PartOfCapture) and config.frames is not None else 0
    plan = plan.having("source", frames=(first + shot.start, first + shot.stop))
    plan = plan.having("graph", exclude=(), tie=None)  # their frames count from that of the whole
    prior = plan.motion.prior
    if prior is not None and prior.time_offset_s != "find" and rate_hz is not None:
        offset_s = prior.time_offset_s + shot.start / rate_hz
        plan = plan.having("motion", prior=prior.model_copy(update={"time_offset_s": offset_s}))
    for key, default in (("reference", "middle"), ("movers", "hide")):
        if isinstance(frame := getattr(plan.render, key), int):
            plan = plan.having("render", **{key: frame - shot.start if shot.start <= frame < shot.stop else default})
    return plan
