"""The verdict on a run: tests of the residuals and of the motion, each with a known rate of false alarms."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from photonpano.motion.frame_motion import FrameMotion
from photonpano.motion.loop import LevelResult
from photonpano.motion.timeline import DARK_JUMP
from photonpano.residuals.block_sums import BLOCK_PX, GX_R, GXX, GXY, GY_R, GYY, M, R, V
from photonpano.residuals.lens import lens_distortion
from photonpano.residuals.measure import Residuals
from photonpano.residuals.refinement import Explained
from photonpano.values import BoolArray, Decision, FloatArray

MAX_RATIO = 2.0
"""Scatter of the shifts of short spans, in units of what noise explains."""
MAX_MISFIT, MAX_CONTRAST = 1.1, 0.02
"""Mean squared residual / variance of blocks, and the part of the light that it stands for: both must be exceeded."""
MAX_MOVING_SHARE, _MOVING_CONTRAST = 0.03, 0.05
"""Share of the panorama whose photons change over time, and by how much of the light at least."""
MAX_GAIN = 0.03
"""Root mean square of the relative brightness, over the blocks of the sensor or over the spans of the capture."""
MAX_HOT_SHARE = 0.005
"""Share of the pixels that count far more, or far fewer, photons than the panorama predicts."""
MAX_LENS, _LENS_SIGMAS = 0.002, 5.0
"""Radial distortion at the corners, relative to their distance from the centre, and its significance: both must be exceeded.
Even a small one bends a long path; half of this is seen without a lens."""
MAX_DEFORMATION_PX = 0.05
"""Root mean square of the shifts of blocks of the sensor that no motion of the whole frame explains."""
MAX_STD_PX = 1.0
"""Mean expected error of the motion."""
MAX_CONTRADICTIONS = 0.1
"""Share of the pairs of the last level that were dropped because they contradict the others."""
MAX_AMBIGUOUS, _FEWEST_AMBIGUOUS = 0.05, 3
"""Share of the pairs of a level that fit the scene at another place as well. One or two pairs may do so by their noise."""
MAX_STANDING = 0.5
"""Share of the frame that stands still while the rest moves."""
REPEATS = "the scene repeats, and pairs of exposures fit at several places"
"""A reason that only the loop can find: a run folder does not hold the other places."""
NO_TURN = "the camera does more than turn, or its lens distorts: rotations of one camera do not explain the pairs"
"""A reason that only the loop can find: a run folder does not hold the pairs."""
MAX_TURN_RESIDUAL = 3.0
"""Root mean square of the residuals of the pairs of rotations, in units of their noise."""
_SIGMAS = 6.0
"""A place stands out if it exceeds what is expected by this many standard deviations."""
_FEWEST = 16
"""Blocks that must have fallen on a square of the panorama."""


@dataclass(frozen=True, slots=True)
class Reason:
    """Why a run is doubtful.

    Attributes:
        what: what was found, in a clause.
        figure: the number that decided.
        threshold: the largest number that is trusted.
        where: the frames, pixels or places, in a clause; empty if it is everywhere.
        what_to_do: advice, in a clause.
    """

    what: str
    figure: float
    threshold: float
    where: str
    what_to_do: str

    def __str__(self) -> str:
        where = f" ({self.where})" if self.where else ""
        return f"{self.what}{where}: {self.figure:.3g}, trusted up to {self.threshold:g}; {self.what_to_do}"


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether motion and panorama explain the photons.

    Attributes:
        status: "trusted" or "doubtful".
        reasons: why it is doubtful, the most telling first.
        residual_ratio: scatter of the shifts of short spans, in units of what noise explains; None if it is unknown.
    """

    status: Literal["trusted", "doubtful"]
    reasons: tuple[Reason, ...]
    residual_ratio: float | None


def judge(explained: Explained, levels: Sequence[LevelResult], decisions: Sequence[Decision] = ()) -> Verdict:
    """Test the result of a run.

    Args:
        explained: motion and residuals.
        levels: the results of the loop; empty if they are not known.
        decisions: what was chosen from the capture, such as the share of the frame that stands still.
    """
    residuals, motion = explained.residuals, explained.motion
    tests: list[Callable[[], Reason | None]] = [
        lambda: _fast_motion(explained.ratio),
        lambda: _photons(residuals),
        lambda: _moving(residuals),
        lambda: _light(residuals),
        lambda: _sensor(residuals),
        lambda: _hot_pixels(residuals),
        lambda: _lens(residuals, motion),
        lambda: _deformation(residuals),
        lambda: _uncertain(motion),
        lambda: _contradictions(levels),
        lambda: _no_turn(levels),
        lambda: _ambiguous(levels),
        lambda: _standing(decisions),
        lambda: _jump_in_the_dark(decisions),
    ]
    reasons = tuple(reason for test in tests if (reason := test()) is not None)
    ratio = explained.ratio if np.isfinite(explained.ratio) else None
    return Verdict("doubtful" if reasons else "trusted", reasons, ratio)


def _photons(residuals: Residuals) -> Reason | None:
    misfit = float(residuals.misfit.mean())
    sums = residuals.blocks.sum(axis=(0, 1))
    per_span = sums / max(len(residuals.spans), 1)
    n = max(float(np.count_nonzero(residuals.blocks[..., V])), 1)
    # The squared residual of a block beyond its variance, as a part of its photons.
    contrast = float(np.sqrt(max(misfit - 1, 0) * per_span[V] / n) / max(per_span[M] / n, 1e-9))
    if misfit <= MAX_MISFIT or contrast <= MAX_CONTRAST:
        return None
    return Reason(
        "the panorama does not explain the photons: they differ from its prediction by more than their noise",
        misfit,
        MAX_MISFIT,
        f"on average by {contrast:.0%} of the light",
        "look at the maps of the report; the motion may be wrong, or the scene changes",
    )


def _moving(residuals: Residuals) -> Reason | None:
    counted = residuals.cell_count >= _FEWEST
    if not counted.any():
        return None
    expected = 1 + _SIGMAS * np.sqrt(2 / np.maximum(residuals.cell_count, 1))
    contrast = np.sqrt(np.maximum(residuals.cell_misfit - 1, 0) * residuals.cell_noise)
    changing = counted & (residuals.cell_misfit > np.maximum(expected, 1.5)) & (contrast > _MOVING_CONTRAST)
    share = float(changing.sum() / counted.sum())
    if share <= MAX_MOVING_SHARE:
        return None
    return Reason(
        "parts of the panorama change over time, as things do that move by themselves or stand at another depth",
        share,
        MAX_MOVING_SHARE,
        _box(changing, "px of the panorama"),
        "merge with robust-merge, or mask what moves; the motion may be that of the thing instead of the scene",
    )


def _fast_motion(ratio: float) -> Reason | None:
    if not ratio > MAX_RATIO:
        return None
    return Reason(
        "the image moves within groups by more than the motion that was found",
        ratio,
        MAX_RATIO,
        "scatter of the shifts of short spans over their noise",
        "use the refiner short-spans, or smaller groups (resample.with.group_size)",
    )


def _light(residuals: Residuals) -> Reason | None:
    # Relative to the mean light: in the dark between two flickers, an error of the gain matters little.
    gains, stds = (each * residuals.light for each in residuals.gains())
    change = float(np.sqrt(max(float(np.mean(gains**2 - stds**2)), 0)))
    if change <= MAX_GAIN:
        return None
    span = residuals.spans[int(np.argmax(np.abs(gains) / np.maximum(stds, 1e-9)))]
    return Reason(
        "the light changes over time",
        change,
        MAX_GAIN,
        f"most at {span}",
        "keep the light steady, or shorten the capture",
    )


def _sensor(residuals: Residuals) -> Reason | None:
    sums = residuals.blocks
    seen = sums[..., M] > 0
    gain = np.divide(sums[..., R], sums[..., M], out=np.zeros(seen.shape), where=seen)
    noise = np.divide(sums[..., V], sums[..., M] ** 2, out=np.zeros(seen.shape), where=seen)
    change = float(np.sqrt(max(np.mean((gain**2 - noise)[seen]), 0))) if seen.any() else 0.0
    if change <= MAX_GAIN:
        return None
    worst = np.unravel_index(np.argmax(np.abs(gain)), gain.shape)
    return Reason(
        "parts of the sensor count more or fewer photons than others, as with a vignette, dirt or a window in front of it",
        change,
        MAX_GAIN,
        f"most at pixel ({worst[1] * BLOCK_PX + BLOCK_PX // 2}, {worst[0] * BLOCK_PX + BLOCK_PX // 2}) of the frame",
        "mask these pixels (corrections: mask), or divide by a flat field (corrections: flat-field)",
    )


def _hot_pixels(residuals: Residuals) -> Reason | None:
    predicted = residuals.pixel_mean
    known = predicted > 0
    excess = np.abs(residuals.pixel_gain - 1) * predicted
    outlier = known & (excess > _SIGMAS * np.sqrt(predicted) + 5) & (excess > 0.5 * predicted)
    share = float(outlier.sum() / max(known.sum(), 1))
    if share <= MAX_HOT_SHARE:
        return None
    return Reason(
        "single pixels count far more, or far fewer, photons than the panorama predicts",
        share,
        MAX_HOT_SHARE,
        f"{int(outlier.sum())} pixels",
        "mask them (corrections: hot-pixels)",
    )


def _lens(residuals: Residuals, motion: FrameMotion) -> Reason | None:
    found = lens_distortion(*block_shifts(residuals), motion.homographies[motion.located], residuals.frame_shape)
    if found is None or abs(found.k1) <= MAX_LENS or found.sigmas <= _LENS_SIGMAS:
        return None
    return Reason(
        "the lens distorts the frames, which bends the motion",
        abs(found.k1),
        MAX_LENS,
        f"about {found.k1:.1%} at the corners",
        "write motion: {model: rotation} and camera: {distortion: {k1: find}} for a camera that only turns; or undistort the "
        "frames before, or use their middle only (corrections: crop)",
    )


def _deformation(residuals: Residuals) -> Reason | None:
    shifts, information = block_shifts(residuals)
    known = information[..., 0, 0] > 0
    if not known.any():
        return None
    noise = np.trace(np.linalg.inv(information[known]), axis1=-2, axis2=-1)
    # A shift, roll, zoom or shear of the whole frame is no deformation. Shifts that change from block to block are those of
    # edges, interpolated at different fractions of a pixel.
    rows, columns = (np.linspace(-1, 1, n)[index] for n, index in zip(known.shape, np.nonzero(known), strict=True))
    affine = np.stack([np.ones(len(rows)), columns, rows], axis=1)
    smooth = np.stack([columns**i * rows ** (power - i) for power in (2, 3) for i in range(power + 1)], axis=1)
    weights = 1 / np.sqrt(noise)[:, None]
    beyond = smooth - affine @ np.linalg.lstsq(affine * weights, smooth * weights)[0]
    fit = beyond @ np.linalg.pinv(beyond * weights) * weights.T
    size = float(np.sqrt(max(float(np.mean(((fit @ shifts[known]) ** 2).sum(axis=-1) - fit**2 @ noise)), 0)))
    if size <= MAX_DEFORMATION_PX:
        return None
    return Reason(
        "frames are deformed as no motion of the whole frame explains",
        size,
        MAX_DEFORMATION_PX,
        "px, over the frame",
        "look at the arrows in the report; correct the lens or the rolling shutter before",
    )


def block_shifts(residuals: Residuals) -> tuple[FloatArray, FloatArray]:
    """Return the mean shift of each block of the sensor against the panorama, and its information.

    Returns:
        (h, w, 2) in px, and (h, w, 2, 2) inverse covariances by photon noise, 0 where a block carries no shift.
    """
    sums = residuals.blocks
    information = np.stack([sums[..., [GXX, GXY]], sums[..., [GXY, GYY]]], axis=-2)
    right = sums[..., [GX_R, GY_R]]
    determined = np.linalg.det(information) > 1e-6 * np.trace(information, axis1=-2, axis2=-1) ** 2
    information = np.where(determined[..., None, None], information, 0)
    field = np.linalg.solve(np.where(determined[..., None, None], information, np.eye(2)), right[..., None])[..., 0]
    return np.where(determined[..., None], field, 0), information


def _uncertain(motion: FrameMotion) -> Reason | None:
    known = motion.std_px[motion.located]
    mean = float(known.mean()) if len(known) else float("inf")
    if mean <= MAX_STD_PX:
        return None
    if not np.isfinite(mean):
        return Reason(
            "no motion is known", 0.0, MAX_STD_PX, "a single exposure was located", "use smaller groups, or more light"
        )
    worst = int(np.argmax(np.where(motion.located, motion.std_px, 0)))
    return Reason(
        "the expected error of the motion is large", mean, MAX_STD_PX, f"px on average, most at frame {worst}", "use more light"
    )


def _contradictions(levels: Sequence[LevelResult]) -> Reason | None:
    if not levels:
        return None
    located = levels[-1].located
    return contradictions(len(located.solution.outliers), len(located.edges))


def contradictions(dropped: int, pairs: int) -> Reason | None:
    """Judge the pairs of the last level.

    Args:
        dropped: pairs that contradict the others.
        pairs: all pairs.
    """
    share = dropped / max(pairs, 1)
    if share <= MAX_CONTRADICTIONS:
        return None
    return Reason(
        "pairs of exposures contradict each other, as where a scene repeats",
        share,
        MAX_CONTRADICTIONS,
        f"{dropped} of {pairs} pairs of the last level",
        "look at the path in the report; use a slower motion, or smaller groups",
    )


def _no_turn(levels: Sequence[LevelResult]) -> Reason | None:
    """Judge rotations of one camera by what any homographies would explain."""
    if not levels or levels[-1].located.solution.turns is None:
        return None
    evidence = levels[-1].located.evidence
    if evidence is None:
        return None
    residual, free = np.sqrt([evidence.rotation, evidence.homography]).tolist()
    if evidence.turns_only and residual <= MAX_TURN_RESIDUAL:
        return None
    return Reason(
        NO_TURN,
        residual,
        MAX_TURN_RESIDUAL,
        f"residuals in units of their noise; those of any homographies are {free:.2g}",
        "write motion: {model: homography}, or find the lens with camera: {distortion: {k1: find}}",
    )


def _ambiguous(levels: Sequence[LevelResult]) -> Reason | None:
    for result in levels:
        located = result.located
        if located.ambiguity is None:
            continue
        n_pairs = len(located.ambiguity.pairs)
        share = n_pairs / max(len(located.edges), 1)
        if share > MAX_AMBIGUOUS and n_pairs >= _FEWEST_AMBIGUOUS:
            return Reason(
                REPEATS,
                share,
                MAX_AMBIGUOUS,
                f"{n_pairs} of {len(located.edges)} pairs of level {result.level.number}, "
                f"{located.ambiguity.alternative_px:.0f} px away",
                "look at the path in the report; a slower motion tells the places apart",
            )
    return None


def _standing(decisions: Sequence[Decision]) -> Reason | None:
    share = next((float(each.value) for each in decisions if each.what == "standing_share"), 0.0)
    if share <= MAX_STANDING:
        return None
    return Reason(
        "more than half of the frame stands still while the rest moves",
        share,
        MAX_STANDING,
        "share of the parts that show motion or rest",
        "mask what stands in the frame (corrections: mask); the motion may be that of either part",
    )


def _jump_in_the_dark(decisions: Sequence[Decision]) -> Reason | None:
    found = [str(each.value) for each in decisions if each.what == DARK_JUMP]
    if not found:
        return None
    return Reason(
        "the image jumps while frames show nothing, so that it is unknown where they lie, and whether frames are missing",
        len(found),
        0,
        ", ".join(found),
        "leave these frames out, or keep the light on",
    )


def _box(cells: BoolArray, unit: str) -> str:
    y, x = np.nonzero(cells)
    low, high = (int(np.quantile(y, q) * BLOCK_PX) for q in (0.05, 0.95))
    left, right = (int(np.quantile(x, q) * BLOCK_PX) for q in (0.05, 0.95))
    return f"mostly x {left} to {right + BLOCK_PX}, y {low} to {high + BLOCK_PX} in {unit}"
