"""Warnings of a run: exposures that were not located, outliers, frames with a large expected error."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from photonpano.motion.frame_motion import FrameMotion
from photonpano.motion.loop import LevelResult
from photonpano.motion.timeline import Timeline
from photonpano.residuals.refinement import Refinement
from photonpano.text import listed
from photonpano.values import FrameSpan, true_spans

# Expected corner error above which a warning names the frames: it is likely to be visible.
UNCERTAIN_PX = 0.5
SHOWN_SPANS = 4  # spans of uncertain frames that a warning names, the worst first

_MANY_COPIES = 0.25  # share of the frames from which a warning names them


def level_warnings(results: Sequence[LevelResult]) -> list[str]:
    """Warn of exposures that were not located, and of pairs that were dropped as outliers."""
    warnings = []
    for result in results:
        located, groups = result.located, result.groups
        lost = [group for group, tied in zip(groups, located.solution.located, strict=True) if not tied]
        if lost:
            between = [group for group in lost if located.instants[0] < group.reference < located.instants[-1]]
            across = f"; the motion is interpolated across {len(between)} of them" if between else ""
            warnings.append(
                f"level {result.level.number}: {len(lost)} of {len(groups)} exposures are not located "
                f"({lost[0]}{' and others' if len(lost) > 1 else ''}){across}"
            )
        if ambiguity := located.ambiguity:
            moving, fixed = ambiguity.pairs[0]
            warnings.append(
                f"level {result.level.number}: {len(ambiguity.pairs)} of {len(located.edges)} pairs fit the scene as well "
                f"{ambiguity.alternative_px:.0f} px away, since it repeats ({groups[moving]} onto {groups[fixed]}"
                f"{' and others' if len(ambiguity.pairs) > 1 else ''}); the slower motion was taken"
            )
        if located.solution.outliers:
            dropped = [located.edges[index] for index in located.solution.outliers]
            first = f"{groups[dropped[0].moving]} onto {groups[dropped[0].fixed]}"
            warnings.append(
                f"level {result.level.number}: {len(dropped)} of {len(located.edges)} pairs contradict the others and were "
                f"dropped ({first}{' and others' if len(dropped) > 1 else ''})"
            )
    return warnings


def time_warnings(left_out: Sequence[str], limit_s: float | None) -> list[str]:
    """Warn of what was left out of a run whose time was over."""
    over = f"since {limit_s or 0:g} s were over (run.time_limit): the motion may not have converged"
    return [f"{listed(left_out)} are left out, {over}"] if left_out else []


def other_shots(shots: Sequence[FrameSpan], directory: Path) -> dict[Path, FrameSpan]:
    """Return all shots but the longest, longer ones first, by their run folders: `runs/scan.panorama-2` beside `runs/scan`."""
    others = sorted(shots, key=len, reverse=True)[1:]
    place = directory.absolute().resolve()
    return {place.with_name(f"{place.name}.panorama-{number}"): shot for number, shot in enumerate(others, start=2)}


def timeline_warnings(timeline: Timeline | None, directory: Path) -> list[str]:
    """Warn of shots and of dark frames, which are left out of the panorama, and of many copies."""
    warnings: list[str] = []
    if timeline is not None and timeline.shots:
        shots = timeline.shots
        others = [f"{shot} in {folder.name}" for folder, shot in other_shots(shots, directory).items()]
        warnings.append(
            f"the capture holds {len(shots)} shots that no motion ties together: {listed(map(str, shots))}. The "
            f"panorama is of {timeline.shot} alone; the others have run folders of their own beside this one, unless their "
            f"runs failed: {listed(others)}"
        )
    if timeline is not None and timeline.dark:
        warnings.append(
            f"{listed(map(str, timeline.dark))} show no light, as behind a closed shutter: they are not located, and left out "
            "of the panorama. If the shutter was meant to be open, check it, and the gate of the sensor"
        )
    if timeline is not None and timeline.copies is not None and timeline.copies.mean() > _MANY_COPIES:
        n_copies, n_frames = np.count_nonzero(timeline.copies), len(timeline.copies)
        warnings.append(
            f"{n_copies:,} of {n_frames:,} frames are copies of the frame before: they add no light, and the motion stands "
            "still in them. Check how the capture was written, and its frame rate"
        )
    return warnings


def motion_warnings(motion: FrameMotion, timeline: Timeline | None = None) -> list[str]:
    """Warn of frames whose motion is uncertain, or that show the scene and are left out."""
    warnings = uncertain_frames(motion)
    lost = ~motion.located if timeline is None else ~motion.located & timeline.shown
    if lost.any():
        n_left_out, n_frames = int(np.sum(lost)), len(lost)
        warnings.append(f"{n_left_out} of {n_frames} frames lie outside the located exposures and are left out")
    return warnings


def uncertain_frames(motion: FrameMotion) -> list[str]:
    """Warn of frames whose expected error exceeds `UNCERTAIN_PX`, or is not known."""
    std_px = motion.std_px
    if not np.isfinite(std_px).any():
        if np.ptp(motion.homographies, axis=0).any():
            return ["how far the motion errs is not known: it may be that of the scene, or of something else; see the verdict"]
        return ["only one exposure was located, so no motion is known: its frames are summed without motion compensation"]
    uncertain = np.isfinite(std_px) & (std_px > UNCERTAIN_PX)
    if not uncertain.any():
        return []
    worst_px = {span: float(std_px[span.start : span.stop].max()) for span in true_spans(uncertain)}
    spans = sorted(worst_px, key=lambda span: -worst_px[span])
    named = [f"{span} (up to {worst_px[span]:.2g} px)" for span in spans[:SHOWN_SPANS]]
    more = f" and {len(spans) - SHOWN_SPANS} more spans" if len(spans) > SHOWN_SPANS else ""
    return [
        f"the motion of {int(uncertain.sum())} of {len(std_px)} frames is uncertain: its expected error exceeds "
        f"{UNCERTAIN_PX:g} px in {', '.join(named)}{more}"
    ]


def refinement_warnings(refinements: Sequence[Refinement]) -> list[str]:
    """Warn of refiners whose motion was not used."""
    return [
        f"{'a further' if each.rounds else 'the'} motion of the refiner {each.name!r} is not used, since it explains the "
        f"photons worse: {each.kept_out}"
        for each in refinements
        if each.kept_out
    ]
