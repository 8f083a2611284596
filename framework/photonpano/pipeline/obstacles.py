"""Find what makes a capture hard to locate: another order of pixels, repeated frames, what stands still, shots."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import pairwise
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from photonpano.capture import Capture, capture_of
from photonpano.contracts.protocols import Source
from photonpano.errors import InputError, LocationError, PhotonpanoError, described
from photonpano.execution.context import Context, Progress
from photonpano.geometry import corners, inverse, transform_points
from photonpano.merging import binned_mean
from photonpano.motion.graph import components
from photonpano.motion.level import SHORTEST_DARK, Timeline
from photonpano.motion.locate import LocatedLevel
from photonpano.motion.tracking import DARK
from photonpano.plugins.contributions import PartOfCapture
from photonpano.reading import other_order, sampled_spans
from photonpano.record.run_json import findings_of, other_shots
from photonpano.record.schema import RunRecord
from photonpano.robust import robust_std
from photonpano.specs.plan import Plan
from photonpano.values import BoolArray, FloatArray, FrameSpan, Group, true_spans

_PLACES = 5  # spans all over the capture
_STANDING = 0.3  # share of the frame from which what stands still is named
_MASKED = 0.5  # share of the pixels that are masked, from which a mask may be the wrong way round
_BLOCK_FRAMES, _FEW_FRAMES = 256, 16  # frames that are compared at a time, if they are packed and if not
_ROWS = 32  # rows of the frame on which frames are compared first
# Frames that are repeated differ from the frame before by this many newly lit pixels, and as many that went dark: dark frames
# are alike by chance, and so are saturated ones.
_FEWEST_NEW = 20
# Frames without light: the light goes off at once, or for so many frames in so few places that it does not flicker.
_MOST_DARK = 8
_FEW_PHOTONS = 100.0  # frames of fewer photons, on the rows that are compared, are averaged
_LIT = 0.5  # light beside frames without any, relative to the usual light, from which on it has gone off at once
_SHAPE_PX, _COLD = 15, 0.99  # binned pixels are compared with the mean around them; the share that is not hot
_SHAPE_SIGMAS, _MOST_SHAPES = 5.0, 64  # from which on they show a scene; most spans that are looked at
logger = logging.getLogger(__name__)
ResultT = TypeVar("ResultT")

_BLOCKS, _SHORTEST, _LONGEST = 64, 4, 32  # blocks of frames that are compared; fewest and most frames of one
_SIDE = 4  # blocks before and after an instant whose means are compared
_ABRUPT = 3.0  # least change of the image where a shot ends, relative to the changes around it, without photon noise
_SURE_CHANGE = 6.0  # standard deviations of these changes by which it must exceed them
_FEWEST = 3  # exposures of a shot


def order_warning(source: Source) -> str | None:
    """Return a warning if sampled frames of a packed source show another order of pixels in their bytes; None if not.

    Most formats fix the order, and a sensor may arrange its pixels in its own way: so this is no error.
    """
    capture, info = capture_of(source), source.info
    if not capture.is_packed:
        return None
    spans = sampled_spans(info.n_frames, info.height * -(-info.width // 8))
    other = other_order([capture.packed(span) for span in spans])
    if other is None:
        return None
    return f"the pixels of the frames seem to be in another order than they are read in: {other}; check the source and its keys"


@contextmanager
def naming_obstacles(source: Source) -> Iterator[None]:
    """Append sentences about what makes a capture hard to locate to the `LocationError` of a block."""
    try:
        yield
    except LocationError as error:
        masked, share = 1 - float(source.valid.mean()), capture_of(source).still.share
        if masked > _MASKED:
            inverted = "of the pixels are masked: if the mask marks the pixels that count, invert it."
            error.args = (f"{error}\n{masked:.0%} {inverted}",)
        if share >= _STANDING:
            stands = "of the frame stands still while the rest moves, as a window or dirt in front of the sensor does."
            error.args = (f"{error}\n{share:.0%} {stands}",)
        raise


def timeline_of(source: Source, context: Context) -> Timeline:
    """Return the timeline of a capture, in which repeated frames take no time, and frames without light are left out.

    Raise an `InputError` if all frames are copies. Frames that are not packed have to be read twice: they are compared only if
    some at five places are copies, and frames without light are not looked for.
    """
    capture, n_frames = capture_of(source), source.info.n_frames
    if not capture.is_packed and not any(
        _compared(capture, span)[0].any() for span in source.info.spread(_PLACES, _FEW_FRAMES)
    ):
        return Timeline.regular(n_frames)
    length = _BLOCK_FRAMES if capture.is_packed else _FEW_FRAMES
    spans = [FrameSpan(max(0, span.start - 1), span.stop) for span in source.info.span.blocks(length)]
    same, photons = np.zeros(n_frames, dtype=bool), np.zeros(n_frames)
    for span, (found, lit) in zip(spans, context.in_order(partial(_compared, capture), spans), strict=True):
        same[span.start + 1 : span.stop], photons[span.start : span.stop] = found, lit
    if n_frames > 1 and same[1:].all():
        raise InputError(f"all {n_frames} frames are copies of the first one; check that the camera went on recording")
    for run in true_spans(same):
        original = run.start - 1
        if original and not _differ(*_frames(capture, FrameSpan(original - 1, original + 1))):
            same[run.start : run.stop] = False
    return Timeline.with_repeats(same, _unlit_spans(capture, photons) if capture.is_packed else ())


def _unlit_spans(capture: Capture, photons: FloatArray) -> tuple[FrameSpan, ...]:
    """Return the frames without light, as of a closed shutter or a lamp that is off, from the (T,) photons of some rows."""
    usual = float(np.quantile(photons, 0.9))
    size = int(np.clip(_FEW_PHOTONS / max(usual, 1e-9), 1, len(photons)))
    light = ndimage.uniform_filter1d(photons, size, mode="nearest") / max(usual, 1e-9)
    runs = true_spans(light < DARK)
    closed = [run for run in runs if len(run) >= SHORTEST_DARK]
    if len(closed) > _MOST_DARK:
        closed = []
    beside = np.pad(light, 1 + size, constant_values=1.0)
    sides = [(beside[run.start : run.start + 1 + size], beside[run.stop + 1 + size : run.stop + 2 + 2 * size]) for run in runs]
    off = [run for run, (before, after) in zip(runs, sides, strict=True) if min(before.max(), after.max()) > _LIT]
    brief = [run for run in off if len(run) < SHORTEST_DARK]
    unlit = [run for run in {*closed, *off}.difference(brief) if not _has_shape(capture, [run])]
    if brief and not _has_shape(capture, brief[:: -(-len(brief) // _MOST_SHAPES)]):
        unlit += brief
    return tuple(sorted(unlit, key=lambda run: run.start))


def _has_shape(capture: Capture, spans: Sequence[FrameSpan]) -> bool:
    """Return whether frames show a scene, however dim: it makes neighbouring pixels alike, and noise does not."""
    alike = variance = 0.0
    for span in spans:
        mean = binned_mean(capture, span)
        valid = np.isfinite(mean)
        if not valid.any():
            continue
        # Hot pixels, and a slow change of the dark counts over the sensor, are no scene.
        counts = np.minimum(np.nan_to_num(mean), np.quantile(mean[valid], _COLD, method="lower")).astype(np.float64)
        around = [ndimage.uniform_filter(each, _SHAPE_PX) for each in (counts * valid, valid.astype(np.float64))]
        beyond = np.where(valid, counts - around[0] / np.maximum(around[1], 1e-9), 0)
        for products in (beyond[1:] * beyond[:-1], beyond[:, 1:] * beyond[:, :-1]):
            alike, variance = alike + float(products.sum()), variance + float((products**2).sum())
    return bool(alike > _SHAPE_SIGMAS * np.sqrt(variance))


def _compared(capture: Capture, span: FrameSpan) -> tuple[BoolArray, NDArray[np.integer]]:
    """Return whether each frame of a span but the first equals the one before it, and the photons of some rows of each."""
    frames = _frames(capture, span)
    stride = max(1, frames.shape[1] // _ROWS)
    some = frames[:, ::stride]
    same = (some[1:] == some[:-1]).all(axis=(1, 2))
    for index in np.flatnonzero(same):
        same[index] = np.array_equal(frames[index], frames[index + 1])
    if not capture.is_packed:
        return np.asarray(same), np.zeros(len(span), np.int64)
    usable, always = (each.valid[::stride] for each in (capture.masked_in(span), capture))
    lit = np.bitwise_count(some & np.packbits(usable, axis=-1)).sum(axis=(1, 2), dtype=np.int64)
    return np.asarray(same), lit if usable is always else lit * always.sum() // max(int(usable.sum()), 1)


def _frames(capture: Capture, span: FrameSpan) -> NDArray[np.integer]:
    """Return the frames of a span, packed if the source gives them so."""
    return capture.packed(span) if capture.is_packed else capture.frames(span)


def _differ(first: NDArray[np.integer], second: NDArray[np.integer]) -> bool:
    """Return whether photons make two frames differ, so that others that are equal are copies."""
    return all(int(np.bitwise_count(new).sum()) >= _FEWEST_NEW for new in (first & ~second, second & ~first))


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
    if changes[index] < max(_ABRUPT * usual, usual + _SURE_CHANGE * robust_std(changes - usual)):
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
            from_frame = f"frames count from frame {shot.start} of the capture: " if shot.start else ""
            logger.warning("no panorama of %s, another shot, was written into %s: %s%s", shot, folder, from_frame, message)


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
