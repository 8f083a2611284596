"""Write and read the content of `run.json`: enough to repeat a run, and to see where it is weak.

It says what the run was made with, too: components, versions of libraries, memory; and warns of exposures that were not
located, outliers, and frames with a large expected error.
"""

from __future__ import annotations

import datetime
import importlib.metadata
import json
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import fields
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import TypeAdapter, ValidationError

from photonpano.errors import InputError
from photonpano.merging.panorama import RenderedPanorama
from photonpano.motion.frame_motion import FrameMotion
from photonpano.motion.level import Timeline
from photonpano.motion.loop import LevelResult, converges
from photonpano.record.schema import (
    AgreementRecord,
    CameraRecord,
    CaptureRecord,
    DecisionRecord,
    DetailRecord,
    FailureRecord,
    LevelRecord,
    MotionRecord,
    PairRecord,
    PanoramaRecord,
    PluginRecord,
    RefinementRecord,
    RescuedRecord,
    RivalRecord,
    RunRecord,
    VerdictRecord,
)
from photonpano.residuals.detail import Detail
from photonpano.residuals.findings import Findings
from photonpano.residuals.halves import Agreements
from photonpano.residuals.refinement import Explained, Refinement
from photonpano.specs.plan import Choice, Plan
from photonpano.text import listed, pixels
from photonpano.values import (
    Decision,
    Edge,
    FloatArray,
    FrameSpan,
    Group,
    Located,
    NotLocated,
    Reason,
    StreamInfo,
    Verdict,
    true_spans,
)

_FINDINGS = TypeAdapter(Findings)
# Expected corner error above which a warning names the frames: it is likely to be visible.
UNCERTAIN_PX = 0.5
SHOWN_SPANS = 4  # spans of uncertain frames that a warning names, the worst first

_MANY_COPIES = 0.25  # share of the frames from which a warning names them


def record_of(
    started: RunRecord,
    plan: Plan,
    levels: Sequence[LevelResult],
    *,
    explained: Explained,
    verdict: Verdict,
    panorama: RenderedPanorama,
    rendered: Sequence[Decision],
    findings: Findings,
) -> RunRecord:
    """Return the record of a finished run; `rendered` are the decisions of renderer and exporters."""
    motion, timeline = explained.motion, levels[-1].exposures.timeline
    decisions = [_levels_decision(levels), *rendered] if plan.until_converged else rendered
    return {
        **started,
        "decisions": [*started["decisions"], *decision_records(decisions)],
        "findings": _FINDINGS.dump_python(findings, mode="json"),
        "levels": [level_record(result, compared=result is levels[-1]) for result in levels],
        "panorama": panorama_record(plan, panorama, rendered),
        "motion": _motion_record(motion.std_px),
        "refinements": [refinement_record(each) for each in explained.refinements],
        "halves": _agreement_records(explained.halves.cuts),
        "stretches": _agreement_records(explained.halves.stretches),
        "verdict": verdict_record(verdict),
        "warnings": [
            *time_warnings(findings.left_out, plan.run.time_limit),
            *timeline_warnings(timeline, plan.output.directory),
            *motion_warnings(motion, timeline),
            *level_warnings(levels),
            *refinement_warnings(explained.refinements),
        ],
    }


def started_record(
    plan: Plan, stream: StreamInfo, decisions: Sequence[Decision], seconds: float, capture: CaptureRecord
) -> RunRecord:
    """Return the record of a finished run without its results."""
    return {
        "photonpano": importlib.metadata.version("photonpano"),
        "status": "done",
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "spec": plan.document,
        "spec_file": None if plan.file is None else str(plan.file),
        "seed": plan.run.seed,
        "source": {
            "n_frames": stream.n_frames,
            "height": stream.height,
            "width": stream.width,
            "frame_rate_hz": stream.frame_rate_hz,
            "kind": stream.kind,
        },
        "plugins": plugin_records(plan),
        "libraries": library_versions(plan),
        "decisions": decision_records(decisions),
        "levels": [],
        "panorama": None,
        "motion": None,
        "refinements": [],
        "halves": [],
        "stretches": [],
        "verdict": None,
        "warnings": [],
        "seconds": round(seconds, 3),
        "peak_memory_bytes": peak_memory_bytes(),
        "capture": capture,
        "rendered_from": None,
    }


def read_record(run_folder: Path) -> RunRecord:
    """Read the `run.json` of a run folder; `InputError` if there is none, or it is no record of a run."""
    file = run_folder / "run.json"
    if not file.is_file():
        raise InputError(f"{run_folder} has no run.json, so no run has finished in it; give the folder of a finished run")
    try:
        record: RunRecord = json.loads(file.read_text(encoding="utf-8"))
        record["spec"]  # what everything else can be made from
        findings_of(record)
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(
            f"{file}: cannot be read as the record of a run ({error}); give the folder of a finished run"
        ) from error
    return record


def level_record(result: LevelResult, *, compared: bool = False) -> LevelRecord:
    """Describe one level; whether models of its motion are `compared`, which may take as long as to find it."""
    located, groups = result.located, result.groups
    first, *_ = result.level.locators
    mean_px = result.uncertainty.mean_px
    return {
        "level": result.level.number,
        "scale": result.level.scale,
        "groups": len(groups),
        "group_frames": int(np.median([len(group.span) for group in groups])),
        "pairs": len(located.edges),
        "located": located.n_located,
        "located_by": {
            locator.name: sum(edge.locator == locator.name for edge in located.edges) for locator in result.level.locators
        },
        "rescued": [
            RescuedRecord(**_pair(groups, edge), by=edge.locator)
            for edge in located.edges
            if edge.locator not in ("", first.name)
        ],
        "failures": failure_records(groups, located.edges),
        "revisits": {
            "pairs": len(located.closures),
            "located": sum(isinstance(edge.motion, Located) for edge in located.closures),
        },
        "contradictions": [_pair(groups, located.edges[index]) for index in located.solution.outliers],
        "change_px": result.change_px,
        "std_px": mean_px if np.isfinite(mean_px) else None,
        "residual_px": located.solution.residual_px,
        "camera": _camera_record(result),
        "evidence": {
            name: RivalRecord(chi2=chi2, unknowns=number, deviance=more, apart_px=apart_px)
            for name, (chi2, number, more, apart_px) in (located.rivals if compared else {}).items()
        },
        "walks_px": dict(located.solution.walks_px),
        "seconds": {stage: round(seconds, 3) for stage, seconds in result.seconds.items()},
    }


def failure_records(groups: Sequence[Group], edges: Sequence[Edge]) -> list[FailureRecord]:
    """Describe the pairs that were not located."""
    return [
        FailureRecord(
            **_pair(groups, edge),
            reason=edge.motion.reason,
            evidence={key: _number(value) for key, value in edge.motion.evidence.items()},
        )
        for edge in edges
        if isinstance(edge.motion, NotLocated)
    ]


def _camera_record(result: LevelResult) -> CameraRecord | None:
    turns, std = result.located.solution.rotations, result.uncertainty.std_camera
    if turns is None or std is None:
        return None
    return {
        "focal_px": turns.camera.focal_px,
        "std_focal_px": float(std[0]),
        "centre_px": list(turns.camera.centre_px),
        "distortion": turns.camera.distortion.tolist(),
        "std_distortion": std[1:].tolist(),
    }


def decision_records(decisions: Sequence[Decision]) -> list[DecisionRecord]:
    """Describe what was chosen from the capture."""
    return [_fields(each) for each in decisions]


def findings_of(record: RunRecord) -> Findings:
    """Return the findings that a record describes; `ValueError` if they are wrong. Older records have none."""
    try:
        return _FINDINGS.validate_python(record.get("findings", {}))
    except ValidationError as error:
        first = error.errors()[0]
        raise ValueError(f"{'.'.join(['findings', *map(str, first['loc'])])}: {first['msg']}") from error


def panorama_record(plan: Plan, panorama: RenderedPanorama, rendered: Sequence[Decision]) -> PanoramaRecord:
    """Describe the panorama, and name the choices of renderer and exporters."""
    found = panorama.dynamic_range
    return {
        "height": panorama.canvas.height,
        "width": panorama.canvas.width,
        "scale": plan.render.scale,
        "picture_reduction": panorama.reduction,
        "white_flux": panorama.white_flux,
        "coverage_share": panorama.coverage_share,
        "seconds": round(panorama.seconds, 3),
        "decisions": [each.what for each in rendered],
        "dynamic_range_db": _rounded(found.decibels),
        "measurable_range_db": _rounded(found.measurable_decibels),
        "saturated_share": found.saturated_share,
    }


def _rounded(decibels: float | None) -> float | None:
    return None if decibels is None else round(decibels, 2)


def _motion_record(std_px: FloatArray) -> MotionRecord | None:
    """Describe the expected error of the motion; None where no motion is known, as with a single exposure.

    `std_px` is (T,), infinite where nothing was located.
    """
    known = np.flatnonzero(np.isfinite(std_px))
    if not len(known):
        return None
    worst = int(known[np.argmax(std_px[known])])
    return {"std_px": float(std_px[known].mean()), "worst_std_px": float(std_px[worst]), "worst_frame": worst}


def verdict_record(verdict: Verdict) -> VerdictRecord:
    """Describe a verdict."""
    reasons, notes = ([_fields(each) for each in listed] for listed in (verdict.reasons, verdict.notes))
    judged: VerdictRecord = _fields(verdict) | {"reasons": reasons, "untested": list(verdict.untested), "notes": notes}
    return judged


def verdict_of(found: VerdictRecord) -> Verdict:
    """Return the verdict that a record describes."""
    status: Literal["trusted", "doubtful"] = "trusted" if found["status"] == "trusted" else "doubtful"
    reasons, notes = (tuple(Reason(**each) for each in listed) for listed in (found["reasons"], found.get("notes", ())))
    untested = tuple(found.get("untested", ()))
    return Verdict(status, reasons, found["residual_ratio"], untested, notes, found.get("reduced_chi2"))


def refinement_record(refinement: Refinement) -> RefinementRecord:
    """Describe what a refiner did."""
    return {
        "use": refinement.name,
        "rounds": list(refinement.rounds),
        "change_px": refinement.change_px,
        "kept_out": refinement.kept_out or None,
    }


def detail_record(found: Detail | None) -> DetailRecord | None:
    """Describe the finest detail that is real; None where no place was seen often enough."""
    if found is None or not len(found.halves):
        return None
    finest, *of_parts = found.finest_px
    return {
        "finest_px": finest,
        "grid_px": float(1 / found.frequencies[-1]),
        "frequencies": found.frequencies.tolist(),
        "halves": found.halves[0].tolist(),
        "scene": found.scene[0].tolist(),
        "parts": [
            {"frames": float(frames), "finest_px": each} for frames, each in zip(found.frames[1:], of_parts, strict=True)
        ],
        "noise": _number(found.noise),
    }


def _agreement_records(found: Agreements) -> list[AgreementRecord]:
    """Describe how frames agree across cuts, or those of stretches with all others."""
    columns = found.firsts, found.coherence, found.std_coherence, found.std_px, found.angles_deg
    return [
        {
            "frame": int(frame),
            "coherence": _number(coherence),
            "std_coherence": _number(std_coherence),
            "std_px": std_px.tolist(),
            "angle_deg": _number(angle),
        }
        for frame, coherence, std_coherence, std_px, angle in zip(*columns, strict=True)
    ]


def _levels_decision(results: Sequence[LevelResult]) -> Decision:
    """Return the number of levels after which the motion converged, and why."""
    last = results[-1]
    if last.change_px is None or not np.isfinite(last.uncertainty.mean_px):
        reason = "a single exposure has no motion"
    else:
        compared = "less" if last.converged else "still more" if converges(results) else "hardly less than before, but more"
        reason = (
            f"the last level changed the motion by {pixels(last.change_px)} px, {compared} than its expected error of "
            f"{pixels(last.uncertainty.mean_px)} px"
        )
    return Decision("levels", len(results), reason)


def _fields(described: Any) -> Any:
    """Return the fields of a dataclass, which are those of its record."""
    return {each.name: getattr(described, each.name) for each in fields(described)}


def _pair(groups: Sequence[Group], edge: Edge) -> PairRecord:
    moving, fixed = groups[edge.moving].span, groups[edge.fixed].span
    return {"moving": [moving.start, moving.stop], "fixed": [fixed.start, fixed.stop]}


def _number(value: float) -> float | None:
    """Return a number as JSON holds it: plain Python, None if it is not finite."""
    plain: float = value.item() if isinstance(value, np.generic) else value
    return plain if np.isfinite(plain) else None


_LIBRARIES = ("numpy", "numba", "opencv-python-headless", "scipy", "pydantic", "pluggy", "tifffile")
_version_of = cache(importlib.metadata.version)  # which reads the whole description of a distribution each time


def plugin_records(plan: Plan) -> list[PluginRecord]:
    """List the components of a plan, each once."""
    seen: dict[tuple[str, str], PluginRecord] = {}
    for stage, choice in _choices(plan):
        name = choice.contribution.name
        seen[stage, name] = {"stage": stage, "use": name, "plugin": choice.origin.plugin, "version": choice.origin.version}
    return list(seen.values())


def library_versions(plan: Plan) -> dict[str, str]:
    """Return the versions of Python and of the libraries that the result depends on."""
    versions = {"python": sys.version.split()[0]}
    required = [requirement.module for _, choice in _choices(plan) for requirement in choice.contribution.requires]
    for name in dict.fromkeys((*_LIBRARIES, *required)):
        # The distribution may have another name than the module.
        with suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = _version_of(name)
    return versions


def peak_memory_bytes() -> int | None:
    """Return the largest resident size of this process so far; None where the system does not report it."""
    status = Path("/proc/self/status")
    # On Linux, getrusage returns the size of the parent process if that was larger.
    if status.exists() and (found := re.search(r"VmHWM:\s*(\d+) kB", status.read_text(encoding="ascii", errors="replace"))):
        return 1024 * int(found[1])
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def _choices(plan: Plan) -> Iterator[tuple[str, Choice]]:
    """Yield the sections of a spec with the component that each chooses, level by level."""
    yield "source", plan.source
    if plan.kind is not None and plan.finder is not None:
        yield plan.kind.section, plan.finder
        return
    for level in plan.levels:
        yield from (("resample", level.resample), ("merge", level.merge), ("locate", level.locate))
        yield from (("locate", choice) for choice in level.fallbacks)
        yield "interpolate", level.interpolate
    yield from (("refine", choice) for choice in plan.refine)
    yield "render", plan.renderer
    yield from (("output", choice) for choice in plan.formats)


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
    if timeline is not None and timeline.unlit:
        n_unlit, n_frames, first = sum(map(len, timeline.unlit)), len(timeline.taken), timeline.unlit[0].start
        warnings.append(
            f"{n_unlit:,} of {n_frames:,} frames, the first at {first:,}, show no light, as where a lamp flashes: "
            "they are left out, and the flux is that of the other frames"
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
    warnings = []
    lost = ~motion.located if timeline is None else ~motion.located & timeline.shown
    if lost.any():
        n_left_out, n_frames = int(np.sum(lost)), len(lost)
        warnings.append(f"{n_left_out} of {n_frames} frames lie outside the located exposures and are left out")
    return warnings + uncertain_frames(motion)


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
    named = [f"{span} (up to {pixels(worst_px[span])} px)" for span in spans[:SHOWN_SPANS]]
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
