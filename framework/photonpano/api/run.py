"""Make a panorama from a spec."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path

import typer

from photonpano.api.command import CHANGES, SPEC, WrongArgumentError, command, logger, require_trust, verdict_lines, warn
from photonpano.execution.context import Progress
from photonpano.pipeline.run import END_AFTER_S, RunResult, run
from photonpano.record.run_json import findings_of
from photonpano.record.schema import DetailRecord, PanoramaRecord, RunRecord
from photonpano.specs import load_spec
from photonpano.text import byte_size, counted, duration, pixels, share


def lines_of_run(result: RunResult, *, strict: bool = False) -> Iterator[str]:
    """Yield what a run has found, and where its files are."""
    record, directory = result.record, result.directory.resolve()
    for each in record["decisions"]:
        logger.info("%s %s: %s", each["what"], each["value"], each["reason"])
    if logger.isEnabledFor(logging.INFO):
        memory = record["peak_memory_bytes"]
        logger.info("took %s%s", duration(record["seconds"]), f" and at most {byte_size(memory)} of memory" if memory else "")
    if result.was_finished:
        yield "finished  this run was finished before; nothing was left to do"
    if result.verdict is not None:
        yield from verdict_lines(result.verdict)
    for warning in record["warnings"]:
        warn(warning)
    findings = findings_of(record)
    for decision in (*findings.started, *findings.of_frames):
        yield f"{decision.what:<9} {decision.value}: {decision.reason}"
    for refinement in record["refinements"]:
        if refinement["rounds"]:  # the first of them is the largest
            change = f"{pixels(refinement['change_px'])} px on average by {refinement['use']}"
            yield f"refined   {change}: {refinement['rounds'][0]}"
    if record.get("levels"):
        yield f"found     {_found(record)}"
    if detail := record.get("detail"):
        yield f"detail    {_detail(detail)}"
    if line := _range(record.get("panorama")):
        yield f"range     {line}"
    yield from (f"{name:<9} {text}" for name, text in result.rows)
    name, file = ("panorama", "panorama.png") if result.kind is None else (result.kind.name, result.kind.file)
    yield f"{name:<9} {directory / file}"
    if "report.html" in record["files"]:
        yield f"report    {directory / 'report.html'}"
    for other in result.others:
        yield f"another   shot of {counted(other.record['source']['n_frames'], 'frame')}, run by itself:"
        yield from lines_of_run(other)
    if strict and result.verdict is not None:
        require_trust(result.verdict, "all files of the run folder are written")


@command(
    "scan.yaml --output runs/first --set render.scale=2",
    lines_of_run,
    notes="follow",
    spec=SPEC,
    changes=CHANGES,
    from_level=typer.Option(metavar="N"),
    end_after=typer.Option(metavar="SECONDS", min=0.1),
)
def _run(  # noqa: PLR0913
    spec: Path,
    output: Path | None = None,
    changes: Sequence[str] = (),
    *,
    overwrite: bool = False,
    resume: bool = False,
    from_level: int | None = None,
    keep_work: bool = False,
    follow: bool = False,
    end_after: float | None = None,
    progress: Progress | None = None,
) -> RunResult:
    """Make a panorama from a spec.

    Writes the run folder: panorama.png to look at, panorama.tiff with linear flux, panorama-std.tiff with its standard
    deviation, coverage.tiff, trajectory.npz, run.json (settings, versions, results) and report.html. The verdict says whether
    motion and panorama explain the photons.
    Of several shots, each one but the longest gets a run folder of its own, DIR.panorama-2 and so on.
    A spec with the section of another kind of run, which a plugin offers, finds that instead.

    Args:
        spec: a YAML file; or a capture, for a run with all defaults.
        output: the run folder, instead of the spec's output.directory.
        changes: overrides of values of the spec, such as run.seed=1.
        overwrite: write beside other files, which stay, or replace a run of another capture.
        resume: go on with a run of this spec that was interrupted.
        from_level: take the levels before N from the run before, whose work was kept, and compute N and what follows.
        keep_work: keep what each level has found, for --from-level, in the folder DIR.work.
        follow: follow a capture that is still being written, or comes on standard input: run the frames that are there, and
            write a page with the panorama so far, DIR.live/live.html. Run the whole once it is complete.
        end_after: with --follow, a growing file is complete when nothing has come for this time; by default 5.
        progress: receives stages and messages.

    Raises:
        WrongArgumentError: options exclude each other.
    """
    if resume and from_level is not None:
        raise WrongArgumentError("--resume and --from-level: give one of them")
    if follow and (resume or from_level is not None):
        raise WrongArgumentError(
            "--follow begins a new run, which --resume and --from-level do not; to go on with frames that have arrived, leave "
            "out --follow"
        )
    if end_after is not None and not follow:
        raise WrongArgumentError("--end-after says when a capture that is followed is complete; give --follow as well")
    return run(
        load_spec(spec, changes, output, arriving=follow),
        progress,
        overwrite=overwrite,
        resume=resume,
        from_level=from_level,
        keep_work=keep_work,
        follow=follow,
        end_after=END_AFTER_S if end_after is None else end_after,
    )


def _found(record: RunRecord) -> str:
    """Describe what a run has chosen and left out by itself: model, groups, lens, light, and what hides the background."""
    last, findings = record["levels"][-1], findings_of(record)
    shifts = record["spec"]["motion"]["model"] == "translation"
    model = "rotations" if last["camera"] else "shifts" if shifts else "homographies"
    parts = [f"{model}, from groups of {counted(last['group_frames'], 'frame')}"]
    if last["camera"] and any(last["camera"]["distortion"]):
        parts.append(f"a lens with k1 {last['camera']['distortion'][0]:.3f}")
    if findings.light_changes:
        parts.append("light that changes")
    if findings.hidden_share:
        parts.append(f"{share(findings.hidden_share)} of the frames left out, as what moves or is near")
    return "; ".join(parts)


def _detail(detail: DetailRecord) -> str:
    """Describe the finest detail that is real."""
    finest_px, grid_px = detail["finest_px"], detail["grid_px"]
    if finest_px is None:
        return "none is real: the first and the last frames that saw a place share no more than noise"
    if finest_px <= grid_px:
        return f"down to {grid_px:.2g} px is real: all that the grid holds"
    return f"down to {finest_px:.2g} px is real: the first and the last frames that saw a place share it"


def _range(panorama: PanoramaRecord | None) -> str:
    """Describe the dynamic range of a panorama; empty where nothing exceeds its noise."""
    if panorama is None:
        return ""
    decibels, measurable = panorama.get("dynamic_range_db"), panorama.get("measurable_range_db")
    if decibels is None or measurable is None:
        return ""
    share = panorama.get("saturated_share", 0.0)
    saturated = f"; {100 * share:.2g} % of the pixels are saturated" if share else ""
    return f"{decibels:.0f} dB, of {measurable:.0f} dB that the frames over a pixel can measure{saturated}"
