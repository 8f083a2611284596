"""The verdict on a run: a table of tests of the residuals and of the motion, each with a known rate of false alarms.

A test is a function under `_doubtful_above`; `judge` makes a `Reason` of what it found if that exceeds the threshold.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from photonpano.geometry import corners, jacobian
from photonpano.motion.loop import LevelResult
from photonpano.motion.timeline import DARK_JUMP, SHOTS
from photonpano.residuals.block_sums import BLOCK_PX, M, R, V
from photonpano.residuals.lens import deformation_px, lens_distortion
from photonpano.residuals.measure import Residuals
from photonpano.residuals.refinement import Explained
from photonpano.values import BoolArray, Decision, Located

REPEATS = "the scene repeats, and pairs of exposures fit at several places"
NO_TURN = "the camera does more than turn, or its lens distorts: rotations of one camera do not explain the pairs"
# Contrast of the residuals, as a share of the light, beyond which a large reduced chi-square counts.
MAX_CONTRAST = 0.02
_STANDARD_DEVIATIONS = 6.0  # that a place or a pixel must deviate by
_ASLANT = 5.0  # ratio of the errors along two directions beyond which one of them is unknown
_MIN_BLOCKS = 16  # that must have fallen on a square of the panorama


@dataclass(frozen=True, slots=True)
class Reason:
    """Why a run is doubtful."""

    what: str  # what was found, in a clause
    figure: float  # the number that decided
    threshold: float  # the largest number that is trusted
    where: str  # the frames, pixels or places, in a clause; empty if it is everywhere
    what_to_do: str  # advice, in a clause

    def __str__(self) -> str:
        where = f" ({self.where})" if self.where else ""
        return f"{self.what}{where}: {self.figure:.3g}, trusted up to {self.threshold:g}; {self.what_to_do}"


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether motion and panorama explain the photons."""

    status: Literal["trusted", "doubtful"]  # "trusted" or "doubtful"
    reasons: tuple[Reason, ...]  # why it is doubtful, the most telling first
    residual_ratio: float | None  # scatter of the shifts of short spans, in units of what noise explains; None if it is unknown


@dataclass(frozen=True, slots=True, eq=False)
class _Run:
    """Data of a run that is tested: see `judge`."""

    explained: Explained
    levels: Sequence[LevelResult]
    decisions: Sequence[Decision]

    @property
    def pairs(self) -> tuple[int, int] | None:
        """Number of contradicting pairs of the last level, and of all its pairs."""
        if not self.levels:
            return None
        located = self.levels[-1].located
        return len(located.solution.outliers), len(located.edges)

    def decided(self, what: str, meaning: str) -> _Found | None:
        """Return the figure of the last decision of a name; None if there is none."""
        figures = [float(each.value) for each in self.decisions if each.what == what]
        return _Found(figures[-1], meaning) if figures else None


class _Found(NamedTuple):
    """Figure of a test and where it occurs; `doubtful` overrides the threshold."""

    figure: float
    where: str
    doubtful: bool = False


@dataclass(frozen=True, slots=True)
class Test:
    """A row of the table: `find` returns what it found, or None where that is trusted or not known."""

    what: str
    threshold: float
    what_to_do: str
    find: Callable[[_Run], _Found | None]

    def reason(self, found: _Found | None) -> Reason | None:
        """Judge what was found; None if it is trusted, or not known."""
        if found is None or not (found.doubtful or found.figure > self.threshold):
            return None
        return Reason(self.what, found.figure, self.threshold, found.where, self.what_to_do)


_Finder: TypeAlias = Callable[[_Run], _Found | None]
TESTS: list[Test] = []


def _doubtful_above(threshold: float, what: str, what_to_do: str) -> Callable[[_Finder], Test]:
    """Add a test to the table; those that are added first are listed first."""

    def added(find: _Finder) -> Test:
        TESTS.append(Test(what, threshold, what_to_do, find))
        return TESTS[-1]

    return added


def judge(explained: Explained, levels: Sequence[LevelResult], decisions: Sequence[Decision] = ()) -> Verdict:
    """Test the result of a run; `levels` are empty if they are not known, `decisions` hold the share that stands still."""
    run = _Run(explained, levels, decisions)
    reasons = tuple(reason for test in TESTS if (reason := test.reason(test.find(run))) is not None)
    ratio = explained.ratio if np.isfinite(explained.ratio) else None
    return Verdict("doubtful" if reasons else "trusted", reasons, ratio)


def contradictions(dropped: int, pairs: int) -> Reason | None:
    """Judge the pairs of the last level, of which some, `dropped`, contradict the others."""
    return _contradictions.reason(_contradicting(dropped, pairs))


@_doubtful_above(
    1,
    "the capture holds shots that no pair of exposures ties together, and the panorama is of the longest alone",
    "look at the panoramas of the others beside the run folder: DIR.panorama-2 and so on",
)
def _shots(run: _Run) -> _Found | None:
    shots = next((str(each.value) for each in run.decisions if each.what == SHOTS), "")
    return _Found(shots.count("frame"), shots) if shots else None


@_doubtful_above(
    10,
    "the photons contradict the focal length or the lens that the spec gives",
    "write camera: {focal_px: find}, and distortion: {k1: find} if the lens distorts, or calibrate the camera anew",
)
def _given_camera(run: _Run) -> _Found | None:
    freed = run.levels[-1].located.solution.freed() if run.levels else None
    if freed is None:
        return None
    what, unit = [("a focal length", " px"), ("k1", "")][freed.number]
    where = f"{what} of {freed.found:.4g} ± {freed.std:.2g}{unit} fits, {freed.given:.4g}{unit} is given; in expected errors"
    return _Found(abs(freed.found - freed.given) / freed.std, where)


@_doubtful_above(
    2.0,
    "the image moves within groups by more than the motion that was found",
    "use the refiner short-spans, or smaller groups (resample.with.group_size)",
)
def _fast_motion(run: _Run) -> _Found:
    return _Found(run.explained.ratio, "scatter of the shifts of short spans over their noise")


@_doubtful_above(
    0.1,
    "frames shake faster than the motion that was found can follow",
    "use the refiner short-spans; if it was used, the photons do not carry this motion: use more light, or damp what shakes",
)
def _shaking(run: _Run) -> _Found | None:
    shaking = run.explained.residuals.shaking
    where = f"px within spans, most with a period of {shaking.period_frames:.3g} frames"
    return _Found(shaking.size_px, where) if shaking.size_px else None


@_doubtful_above(
    1.1,
    "the panorama does not explain the photons: they differ from its prediction by more than their noise",
    "look at the maps of the report; the motion may be wrong, or the scene changes",
)
def _photons(run: _Run) -> _Found | None:
    residuals = run.explained.residuals
    reduced_chi2 = float(residuals.reduced_chi2.mean())
    sums = residuals.blocks.sum(axis=(0, 1))
    per_span = sums / max(len(residuals.spans), 1)
    n = max(float(np.count_nonzero(residuals.blocks[..., V])), 1)
    # The squared residual of a block beyond its variance, as a part of its photons.
    contrast = float(np.sqrt(max(reduced_chi2 - 1, 0) * per_span[V] / n) / max(per_span[M] / n, 1e-9))
    return _Found(reduced_chi2, f"on average by {contrast:.0%} of the light") if contrast > MAX_CONTRAST else None


def changing_places(residuals: Residuals) -> tuple[float, BoolArray]:
    """Return the share of the panorama that changes over time by more than noise explains, and its squares of 16 px: (h, w)."""
    counted = residuals.cell_count >= _MIN_BLOCKS
    expected = 1 + _STANDARD_DEVIATIONS * np.sqrt(2 / np.maximum(residuals.cell_count, 1))
    contrast = np.sqrt(np.maximum(residuals.cell_chi2 - 1, 0) * residuals.cell_noise)
    changing = counted & (residuals.cell_chi2 > np.maximum(expected, 1.5)) & (contrast > 0.05)
    return float(changing.sum() / max(counted.sum(), 1)), changing


@_doubtful_above(
    0.03,
    "parts of the panorama change over time, as things do that move by themselves or stand at another depth",
    "mask what moves (corrections: mask); the motion may be that of the thing instead of the scene",
)
def _moving(run: _Run) -> _Found | None:
    share, changing = changing_places(run.explained.residuals)
    return _Found(share, _box(changing, "px of the panorama")) if share else None


@_doubtful_above(0.03, "the light changes over time", "keep the light steady, or shorten the capture")
def _light(run: _Run) -> _Found:
    residuals = run.explained.residuals
    # Relative to the mean light: in the dark between two flickers, an error of the gain matters little.
    gains, stds = (each * residuals.light for each in residuals.gains())
    change = float(np.sqrt(max(float(np.mean(gains**2 - stds**2)), 0)))
    return _Found(change, f"most at {residuals.spans[int(np.argmax(np.abs(gains) / np.maximum(stds, 1e-9)))]}")


@_doubtful_above(
    0.03,
    "parts of the sensor count more or fewer photons than others, as with a vignette, dirt or a window in front of it",
    "mask these pixels (corrections: mask), or divide by a flat field (corrections: flat-field)",
)
def _sensor(run: _Run) -> _Found | None:
    sums = run.explained.residuals.blocks
    seen = sums[..., M] > 0
    if not seen.any():
        return None
    gain = np.divide(sums[..., R], sums[..., M], out=np.zeros(seen.shape), where=seen)
    noise = np.divide(sums[..., V], sums[..., M] ** 2, out=np.zeros(seen.shape), where=seen)
    change = float(np.sqrt(max(np.mean((gain**2 - noise)[seen]), 0)))
    y, x = (int(index) * BLOCK_PX + BLOCK_PX // 2 for index in np.unravel_index(np.argmax(np.abs(gain)), gain.shape))
    return _Found(change, f"most at pixel ({x}, {y}) of the frame")


@_doubtful_above(
    0.005,
    "single pixels count far more, or far fewer, photons than the panorama predicts",
    "mask them (corrections: hot-pixels)",
)
def _hot_pixels(run: _Run) -> _Found:
    predicted = run.explained.residuals.pixel_mean
    known = predicted > 0
    excess = np.abs(run.explained.residuals.pixel_gain - 1) * predicted
    outlier = known & (excess > _STANDARD_DEVIATIONS * np.sqrt(predicted) + 5) & (excess > 0.5 * predicted)
    return _Found(float(outlier.sum() / max(known.sum(), 1)), f"{int(outlier.sum())} pixels")


@_doubtful_above(
    0.002,
    "the lens distorts the frames, which bends the motion",
    "write motion: {model: rotation} and camera: {distortion: {k1: find}} for a camera that only turns; or undistort the "
    "frames before, or use their middle only (corrections: crop)",
)
def _lens(run: _Run) -> _Found | None:
    residuals, motion = run.explained.residuals, run.explained.motion
    # Half of the threshold is seen without a lens; even a small distortion bends a long path.
    found = lens_distortion(*residuals.block_shifts(), motion.homographies[motion.located], residuals.frame_shape)
    # What else is not explained, such as a tremor, moves blocks by more than photon noise.
    misfit = max(1.0, float(residuals.reduced_chi2.mean())) ** 0.5
    if found is None or found.sigmas <= 5 * misfit:
        return None
    return _Found(abs(found.k1), f"about {found.k1:.1%} at the corners")


@_doubtful_above(
    0.05,
    "frames are deformed as no motion of the whole frame explains",
    "look at the arrows in the report; correct the lens or the rolling shutter before",
)
def _deformation(run: _Run) -> _Found | None:
    size = deformation_px(*run.explained.residuals.block_shifts())
    return None if size is None else _Found(size, "px, over the frame")


@_doubtful_above(1.0, "no motion is known", "use smaller groups, or more light")
def _unknown(run: _Run) -> _Found | None:
    known = run.explained.motion.std_px[run.explained.motion.located]
    return None if len(known) and np.isfinite(known).all() else _Found(0.0, "a single exposure was located", doubtful=True)


@_doubtful_above(
    2.0,
    "the image says nothing of motion along one direction",
    "the motion may be wrong by any distance along it, which this panorama does not show; keep other structures in view",
)
def _one_direction(run: _Run) -> _Found | None:
    located = run.levels[-1].located if run.levels else None
    pairs = [] if located is None else [edge.motion for edge in located.edges if isinstance(edge.motion, Located)]
    informed = [pair for pair in pairs if pair.information is not None]
    if located is None or not informed:
        return None
    middle = corners(located.frame_shape).mean(axis=0)[None]
    slopes = np.array([jacobian(pair.homography, middle)[0] for pair in informed])
    covariances = slopes @ np.linalg.pinv(np.array([pair.information for pair in informed])) @ slopes.transpose(0, 2, 1)
    variances, directions = np.linalg.eigh(np.median(covariances, axis=0))
    strong, weak = np.sqrt(np.maximum(variances, 0)).tolist()
    if weak < _ASLANT * strong:
        return None
    x, y = directions[:, 1]
    angle = round(np.degrees(np.arctan2(y, x))) % 180
    return _Found(weak, f"px, the error of a pair at {angle} degrees from x towards y; {strong:.2g} px across")


@_doubtful_above(1.0, "the expected error of the motion is large", "use more light")
def _uncertain(run: _Run) -> _Found | None:
    motion = run.explained.motion
    known = motion.std_px[motion.located]
    if not len(known) or not np.isfinite(known).all():
        return None
    worst = int(np.argmax(np.where(motion.located, motion.std_px, 0)))
    return _Found(float(known.mean()), f"px on average, most at frame {worst}")


@_doubtful_above(
    0.1,
    "pairs of exposures contradict each other, as where a scene repeats",
    "look at the path in the report; use a slower motion, or smaller groups",
)
def _contradictions(run: _Run) -> _Found | None:
    return None if run.pairs is None else _contradicting(*run.pairs)


def _contradicting(dropped: int, pairs: int) -> _Found:
    return _Found(dropped / max(pairs, 1), f"{dropped} of {pairs} pairs of the last level")


@_doubtful_above(3.0, NO_TURN, "write motion: {model: homography}, or find the lens with camera: {distortion: {k1: find}}")
def _no_turn(run: _Run) -> _Found | None:
    if not run.levels or run.levels[-1].located.solution.rotations is None:
        return None
    located = run.levels[-1].located
    evidence, name = located.evidence, located.solution.model.name
    if evidence is None or not {name, "homography"} <= evidence.rivals.keys():
        return None
    residual, free = np.sqrt([evidence.rivals[each].chi2 for each in (name, "homography")]).tolist()
    where = f"residuals in units of their noise; those of any homographies are {free:.2g}"
    return _Found(residual, where, doubtful=not evidence.suffices(name))


@_doubtful_above(0.05, REPEATS, "look at the path in the report; a slower motion tells the places apart")
def _ambiguous(run: _Run) -> _Found | None:
    def found() -> Iterator[_Found]:
        for result in run.levels:
            ambiguity, n_edges = result.located.ambiguity, len(result.located.edges)
            # One or two pairs may be ambiguous by their noise.
            if ambiguity is not None and len(ambiguity.pairs) > 2:
                of_level = f"{len(ambiguity.pairs)} of {n_edges} pairs of level {result.level.number}"
                yield _Found(len(ambiguity.pairs) / max(n_edges, 1), f"{of_level}, {ambiguity.alternative_px:.0f} px away")

    return max(found(), key=lambda each: each.figure > 0.05, default=None)


@_doubtful_above(
    0.5,
    "more than half of the frame stands still while the rest moves",
    "mask what stands in the frame (corrections: mask); the motion may be that of either part",
)
def _standing(run: _Run) -> _Found | None:
    return run.decided("standing_share", "share of the parts that show motion or rest")


@_doubtful_above(
    0.5,
    "more than half of what the frames show does not follow one turn of the camera, as where it travels past near things",
    "keep away from what is near, or ask for the poses of a camera that travels (pose); the motion may be that of either part",
)
def _layers(run: _Run) -> _Found | None:
    # Later levels leave out what is near.
    parallax = max((each.located.solution.parallax for each in run.levels), default=0.0)
    where = "share of the frames that is left out, on average"
    if parallax:
        where += f"; if what is near stands still, the camera travelled by about {parallax:.1g} of its distance"
    return run.decided("movers", where)


@_doubtful_above(
    0.35,
    "the background of much of the panorama was never seen, as where one thing fills the middle of all frames",
    "record so that each place is seen without what hides it; the motion may be that of what fills the frames",
)
def _never_seen(run: _Run) -> _Found | None:
    return run.decided("background_never_seen", "share of the panorama")


@_doubtful_above(
    0,
    "the image jumps while frames show nothing, so that it is unknown where they lie, and whether frames are missing",
    "leave these frames out, or keep the light on",
)
def _jump_in_the_dark(run: _Run) -> _Found:
    found = [str(each.value) for each in run.decisions if each.what == DARK_JUMP]
    return _Found(len(found), ", ".join(found))


def _box(cells: BoolArray, unit: str) -> str:
    y, x = np.nonzero(cells)
    low, high = (int(np.quantile(y, q) * BLOCK_PX) for q in (0.05, 0.95))
    left, right = (int(np.quantile(x, q) * BLOCK_PX) for q in (0.05, 0.95))
    return f"mostly x {left} to {right + BLOCK_PX}, y {low} to {high + BLOCK_PX} in {unit}"
