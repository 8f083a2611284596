"""What `run.json` says of a run: enough to repeat it, and to see where it was weak."""

from __future__ import annotations

import importlib.metadata
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from photonpano.motion.loop import LevelResult
from photonpano.specs.plan import Choice, Plan
from photonpano.values import Decision, FloatArray, Group, Located, NotLocated, StreamInfo, true_spans

UNCERTAIN_PX = 0.5
"""Frames whose expected corner error exceeds this are named: theirs is likely to show."""
SHOWN_SPANS = 4
_LIBRARIES = ("numpy", "numba", "opencv-python-headless", "scipy", "pydantic", "pluggy", "tifffile")


def source_record(stream: StreamInfo) -> dict[str, Any]:
    """Describe the capture."""
    return {
        "n_frames": stream.n_frames,
        "height": stream.height,
        "width": stream.width,
        "frame_rate_hz": stream.frame_rate_hz,
        "kind": stream.kind,
    }


def plugin_records(plan: Plan) -> list[dict[str, str]]:
    """Say who provided each stage, each component once."""
    seen: dict[tuple[str, str], dict[str, str]] = {}
    for stage, choice in _choices(plan):
        name = choice.contribution.name
        seen[stage, name] = {"stage": stage, "use": name, "plugin": choice.origin.plugin, "version": choice.origin.version}
    return list(seen.values())


def library_versions(plan: Plan) -> dict[str, str]:
    """Return the versions of Python and of the libraries that the result depends on."""
    versions = {"python": sys.version.split()[0]}
    required = [requirement.module for _, choice in _choices(plan) for requirement in choice.contribution.requires]
    for name in dict.fromkeys((*_LIBRARIES, *required)):
        # A library may be imported under another name than it is installed under.
        with suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    return versions


def _choices(plan: Plan) -> Iterator[tuple[str, Choice]]:
    """Yield the sections of a spec with what they choose, level by level."""
    yield "source", plan.source
    for level in plan.levels:
        yield from (("resample", level.resample), ("merge", level.merge), ("locate", level.locate))
        yield from (("locate", choice) for choice in level.fallbacks)
        yield "interpolate", level.interpolate


def level_record(result: LevelResult) -> dict[str, Any]:
    """Describe one level."""
    located = result.located
    return {
        "level": result.level.number,
        "scale": result.level.scale,
        "groups": len(result.groups),
        "group_frames": int(np.median([len(group.span) for group in result.groups])),
        "pairs": len(located.edges),
        "located": located.n_located,
        "located_by": {
            locator.name: sum(edge.locator == locator.name for edge in located.edges) for locator in result.level.locators
        },
        "rescued": list(_rescued(result)),
        "failures": list(_failures(result)),
        "revisits": {
            "pairs": located.n_revisits,
            "located": sum(isinstance(edge.motion, Located) for edge in located.revisits),
        },
        "contradictions": list(_contradictions(result)),
        "change_px": result.change_px,
        "std_px": mean_px if np.isfinite(mean_px := result.uncertainty.mean_px) else None,
        "residual_px": located.solution.residual_px,
        "seconds": {stage: round(seconds, 3) for stage, seconds in result.seconds.items()},
    }


def motion_record(std_px: FloatArray) -> dict[str, Any] | None:
    """Describe how well the motion is known; None if it is not, as with a single exposure.

    Args:
        std_px: (T,) expected corner error, infinite where nothing was located.
    """
    known = np.flatnonzero(np.isfinite(std_px))
    if not len(known):
        return None
    worst = int(known[np.argmax(std_px[known])])
    return {"std_px": float(std_px[known].mean()), "worst_std_px": float(std_px[worst]), "worst_frame": worst}


def levels_decision(results: Sequence[LevelResult]) -> Decision:
    """Say after how many levels the motion was taken to have settled, and why."""
    last = results[-1]
    if last.change_px is None or not np.isfinite(last.uncertainty.mean_px):
        reason = "a single exposure tells of no motion"
    else:
        compared = "less" if last.converged else "and still more"
        reason = (
            f"the last level changed the motion by {last.change_px:.2g} px, {compared} than the "
            f"{last.uncertainty.mean_px:.2g} px that photons leave open"
        )
    return Decision("levels", len(results), reason)


def warnings_of(results: Sequence[LevelResult]) -> list[str]:
    """Say what a user should know of a run that went through."""
    warnings = []
    for result in results:
        located = result.located
        lost = [group for group, tied in zip(result.groups, located.solution.located, strict=True) if not tied]
        if lost:
            between = [group for group in lost if located.instants[0] < group.reference < located.instants[-1]]
            across = f"; the motion is interpolated across {len(between)} of them" if between else ""
            warnings.append(
                f"level {result.level.number}: {len(lost)} of {len(result.groups)} exposures are not located "
                f"({lost[0]}{' and others' if len(lost) > 1 else ''}){across}"
            )
        if located.solution.contradictions:
            dropped = [located.edges[index] for index in located.solution.contradictions]
            first = _pair(result.groups, dropped[0].moving, dropped[0].fixed)
            warnings.append(
                f"level {result.level.number}: {len(dropped)} of {len(located.edges)} pairs contradict the others and were "
                f"dropped ({first}{' and others' if len(dropped) > 1 else ''})"
            )
    return warnings


def uncertain_frames(std_px: FloatArray) -> list[str]:
    """Warn of the frames whose expected error is more than merging would hide.

    Args:
        std_px: (T,) expected corner error, infinite where nothing was located.
    """
    if not np.isfinite(std_px).any():
        return ["a single exposure was located, so that no motion is known: its frames are summed as they lie"]
    uncertain = np.isfinite(std_px) & (std_px > UNCERTAIN_PX)
    if not uncertain.any():
        return []
    worst_px = {span: float(std_px[span.start : span.stop].max()) for span in true_spans(uncertain)}
    spans = sorted(worst_px, key=lambda span: -worst_px[span])
    named = [f"{span} (up to {worst_px[span]:.1f} px)" for span in spans[:SHOWN_SPANS]]
    more = f" and {len(spans) - SHOWN_SPANS} more spans" if len(spans) > SHOWN_SPANS else ""
    return [
        f"the motion of {int(uncertain.sum())} of {len(std_px)} frames is uncertain: its expected error exceeds "
        f"{UNCERTAIN_PX:g} px in {', '.join(named)}{more}"
    ]


def peak_memory_bytes() -> int | None:
    """Return the largest resident size of this process so far; None where the system does not tell."""
    status = Path("/proc/self/status")
    # On Linux, getrusage tells the size of the process that started this one, if it was larger.
    if status.exists() and (found := re.search(r"VmHWM:\s*(\d+) kB", status.read_text(encoding="ascii", errors="replace"))):
        return 1024 * int(found[1])
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def _rescued(result: LevelResult) -> Iterator[dict[str, Any]]:
    for edge in result.located.edges:
        if edge.locator not in ("", result.level.locators[0].name):
            moving, fixed = result.groups[edge.moving].span, result.groups[edge.fixed].span
            yield {"moving": [moving.start, moving.stop], "fixed": [fixed.start, fixed.stop], "by": edge.locator}


def _failures(result: LevelResult) -> Iterator[dict[str, Any]]:
    for edge in result.located.failures:
        moving, fixed = result.groups[edge.moving].span, result.groups[edge.fixed].span
        assert isinstance(edge.motion, NotLocated)
        yield {
            "moving": [moving.start, moving.stop],
            "fixed": [fixed.start, fixed.stop],
            "reason": edge.motion.reason,
            "evidence": {key: _number(value) for key, value in edge.motion.evidence.items()},
        }


def _number(value: float) -> float | None:
    """Return what a locator counted as JSON can hold it: numbers of Python, None for what is not finite."""
    plain: float = value.item() if isinstance(value, np.generic) else value
    return plain if np.isfinite(plain) else None


def _contradictions(result: LevelResult) -> Iterator[dict[str, list[int]]]:
    for position in result.located.solution.contradictions:
        edge = result.located.edges[position]
        moving, fixed = result.groups[edge.moving].span, result.groups[edge.fixed].span
        yield {"moving": [moving.start, moving.stop], "fixed": [fixed.start, fixed.stop]}


def _pair(groups: Sequence[Group], moving: int, fixed: int) -> str:
    return f"{groups[moving]} onto {groups[fixed]}"
