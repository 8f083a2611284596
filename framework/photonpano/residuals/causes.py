"""What may be wrong beside the motion, and the tables that the tests of a verdict are listed in."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from photonpano.motion.loop import LevelResult
from photonpano.residuals.block_sums import BLOCK_PX, M, R, V
from photonpano.residuals.findings import Findings
from photonpano.residuals.measure import FEWEST_FRAMES, Residuals
from photonpano.residuals.patterns import deformation_px
from photonpano.residuals.refinement import FEWEST_SPANS, Explained
from photonpano.values import BoolArray
from photonpano.values.verdict import Found, Test

_STANDARD_DEVIATIONS = 6.0  # that a place or a pixel must deviate by
_MIN_BLOCKS = 16  # that must have fallen on a square of the panorama


@dataclass(frozen=True, slots=True, eq=False)
class TestedRun:
    """Data of a run that is tested: see `judge`."""

    explained: Explained
    levels: Sequence[LevelResult]
    findings: Findings


_Finder: TypeAlias = Callable[[TestedRun], Found | None]


class Tests(list[Test[TestedRun]]):
    """A table of tests; those that are added first are listed first."""

    def __init__(self, *, decides: bool = True) -> None:
        super().__init__()
        self._decides = decides

    def doubtful_above(self, threshold: float, what: str, what_to_do: str) -> Callable[[_Finder], Test[TestedRun]]:
        """Add the decorated function as a test."""

        def added(find: _Finder) -> Test[TestedRun]:
            self.append(Test(what, threshold, what_to_do, find, self._decides))
            return self[-1]

        return added


CAUSES = Tests(decides=False)


@CAUSES.doubtful_above(
    0.35,
    "the background of much of the panorama was never seen, as where one thing fills the middle of all frames",
    "record so that each place is seen without what hides it; the motion may be that of what fills the frames",
)
def _never_seen(run: TestedRun) -> Found:
    return Found(run.findings.never_seen_share, "share of the panorama")


@CAUSES.doubtful_above(
    2.0,
    "the image moves within groups by more than the motion that was found",
    "use the refiner short-spans; where it was used, more light",
)
def _fast_motion(run: TestedRun) -> Found | None:
    if not np.isfinite(run.explained.ratio):
        return Found(np.nan, f"{len(run.explained.residuals.spans)} spans are too few: {FEWEST_SPANS} are needed")
    return Found(run.explained.ratio, "scatter of the shifts of short spans over their noise")


@CAUSES.doubtful_above(
    0.1,
    "frames shake faster than the motion that was found can follow",
    "use the refiner short-spans; where it was used, more light",
)
def _shaking(run: TestedRun) -> Found | None:
    shaking, longest = run.explained.residuals.shaking, max(map(len, run.explained.residuals.spans))
    if longest < FEWEST_FRAMES and not np.isfinite(run.explained.ratio):  # spans of a frame or two show all shaking themselves
        return Found(np.nan, f"spans of {FEWEST_FRAMES} frames are needed")
    where = f"px within spans, most with a period of {shaking.period_frames:.3g} frames"
    return Found(shaking.size_px, where) if shaking.size_px else None


def changing_places(residuals: Residuals) -> tuple[float, BoolArray]:
    """Return the share of the panorama that changes over time by more than noise explains, and its squares of 16 px: (h, w)."""
    counted = residuals.cell_count >= _MIN_BLOCKS
    expected = 1 + _STANDARD_DEVIATIONS * np.sqrt(2 / np.maximum(residuals.cell_count, 1))
    contrast = np.sqrt(np.maximum(residuals.cell_chi2 - 1, 0) * residuals.cell_noise)
    changing = counted & (residuals.cell_chi2 > np.maximum(expected, 1.5)) & (contrast > 0.05)
    return float(changing.sum() / max(counted.sum(), 1)), changing


@CAUSES.doubtful_above(
    0.03,
    "parts of the panorama change over time, as things do that move by themselves or stand at another depth",
    "the motion may be that of the thing instead of the scene",
)
def _moving(run: TestedRun) -> Found | None:
    if run.explained.residuals.cell_count.max(initial=0) < _MIN_BLOCKS:
        return Found(np.nan, f"no place was seen {_MIN_BLOCKS} times")
    share, changing = changing_places(run.explained.residuals)
    return Found(share, _box(changing, "px of the panorama")) if share else None


def _box(cells: BoolArray, unit: str) -> str:
    y, x = np.nonzero(cells)
    low, high = (int(np.quantile(y, q) * BLOCK_PX) for q in (0.05, 0.95))
    left, right = (int(np.quantile(x, q) * BLOCK_PX) for q in (0.05, 0.95))
    return f"mostly x {left} to {right + BLOCK_PX}, y {low} to {high + BLOCK_PX} in {unit}"


@CAUSES.doubtful_above(
    0.03,
    "the light changes over time",
    "write light: auto if the spec says that it is steady; otherwise keep it steady",
)
def _light(run: TestedRun) -> Found:
    residuals = run.explained.residuals
    # Relative to the mean light: in the dark between two flickers, an error of the gain matters little.
    gains, stds = (each * residuals.light for each in residuals.gains())
    # What all spans have in common is the panorama's, as where noise of dark places draws it down, and no change.
    gains -= np.average(gains, weights=1 / np.maximum(stds, 1e-9) ** 2)
    change = float(np.sqrt(max(float(np.mean(gains**2 - stds**2)), 0)))
    return Found(change, f"most at {residuals.spans[int(np.argmax(np.abs(gains) / np.maximum(stds, 1e-9)))]}")


@CAUSES.doubtful_above(
    0.03,
    "parts of the sensor count more or fewer photons than others, as with a vignette, dirt or a window in front of it",
    "look at the map of the sensor in the report",
)
def _sensor(run: TestedRun) -> Found | None:
    sums = run.explained.residuals.blocks
    seen = sums[..., M] > 0
    if not seen.any():
        return None
    gain = np.divide(sums[..., R], sums[..., M], out=np.zeros(seen.shape), where=seen)
    noise = np.divide(sums[..., V], sums[..., M] ** 2, out=np.zeros(seen.shape), where=seen)
    change = float(np.sqrt(max(np.mean((gain**2 - noise)[seen]), 0)))
    y, x = (int(index) * BLOCK_PX + BLOCK_PX // 2 for index in np.unravel_index(np.argmax(np.abs(gain)), gain.shape))
    return Found(change, f"most at pixel ({x}, {y}) of the frame")


@CAUSES.doubtful_above(
    0.005,
    "single pixels count far more, or far fewer, photons than the panorama predicts",
    "mask them (corrections: hot-pixels)",
)
def _hot_pixels(run: TestedRun) -> Found:
    predicted = run.explained.residuals.pixel_mean
    known = predicted > 0
    excess = np.abs(run.explained.residuals.pixel_gain - 1) * predicted
    outlier = known & (excess > _STANDARD_DEVIATIONS * np.sqrt(predicted) + 5) & (excess > 0.5 * predicted)
    number = int(outlier.sum())
    where, what_to_do, share = f"{number} pixels", "", number / max(int(known.sum()), 1)
    for how, turned in (("upside down", known[::-1]), ("left to right", known[:, ::-1]), ("by 180 degrees", known[::-1, ::-1])):
        there = int((outlier & ~turned).sum()) / max(number, 1)
        if there > 0.5 + (~turned[known]).mean():  # more than half, beside those that any mask would hold
            where += f"; {there:.0%} of them lie where a mask turned {how} has its pixels"
            what_to_do = f"turn the mask {how}"
    return Found(share, where, what_to_do=what_to_do)


@CAUSES.doubtful_above(
    0.05,
    "frames are deformed as no motion of the whole frame explains",
    "look at the arrows in the report",
)
def _deformation(run: TestedRun) -> Found | None:
    size = deformation_px(*run.explained.residuals.block_shifts())
    return None if size is None else Found(size, "px, over the frame")


@CAUSES.doubtful_above(
    0.1,
    "pairs of exposures contradict each other, as where a scene repeats",
    "look at the path in the report",
)
def _contradictions(run: TestedRun) -> Found | None:
    if not run.levels:
        return None
    dropped, pairs = len(run.levels[-1].located.solution.outliers), len(run.levels[-1].located.edges)
    return Found(dropped / max(pairs, 1), f"{dropped} of {pairs} pairs of the last level")
