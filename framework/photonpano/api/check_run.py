"""Judge a finished run by its capture."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from photonpano.api.command import command, require_trust, verdict_lines
from photonpano.api.opened_run import opened_run
from photonpano.capture import capture_of
from photonpano.execution.context import Context, Progress, usual
from photonpano.execution.threads import one_thread_inside, thread_count
from photonpano.pipeline.obstacles import timeline_of
from photonpano.plugins.registry import Catalog
from photonpano.record.run_json import findings_of
from photonpano.residuals.refinement import MotionFit
from photonpano.residuals.verdict import NARROW, REPEATS, judge
from photonpano.values import Reason, Verdict


@dataclass(frozen=True, slots=True)
class RunCheck:
    """What `check_run` found.

    Attributes:
        verdict: whether motion and panorama explain the photons.
    """

    verdict: Verdict


def _lines(found: RunCheck, *, strict: bool = False) -> Iterator[str]:
    yield from verdict_lines(found.verdict)
    ratio = found.verdict.residual_ratio
    yield f"scatter   {'unknown: too few frames' if ratio is None else f'{ratio:.2f} times what noise explains'}"
    if strict:
        require_trust(found.verdict, "nothing was written")


@command("runs/first --strict", _lines)
def check_run(
    run_folder: Path | str,
    progress: Progress | None = None,
    catalog: Catalog | None = None,
    *,
    capture: Path | str | None = None,
) -> RunCheck:
    """Judge a finished run: render the panorama along its motion, and compare it with the photons of the capture.

    Writes nothing. The panorama is rendered with the scale of the frames, whatever that of the run was. What only the loop can
    find, such as pairs that fit at several places, is taken from the record.

    Args:
        run_folder: written by `run`.
        progress: receives the stages; by default, bars in a notebook and nothing elsewhere.
        catalog: what can be chosen; by default what the installed plugins offer.
        capture: the capture, if it is not where the run has read it: a file, a folder, or a URL.

    Raises:
        InputError: the folder is no run folder, its capture cannot be opened, or it is another capture now.
    """
    with opened_run(Path(run_folder), catalog, moved=capture) as opened, one_thread_inside():
        record, plan = opened.record, opened.plan
        context = Context(thread_count(plan.run.threads), usual(progress))
        findings = findings_of(record)
        copies = timeline_of(opened.source, context).copies if findings.repeated else None
        source = replace(capture_of(opened.source), copies=copies)
        fit = MotionFit(source, opened.motion, int(plan.run.memory), context)
        explained = fit.explained()
    verdict = judge(explained, (), findings)
    reasons = list(verdict.reasons)
    recorded = (record.get("verdict") or {"reasons": ()})["reasons"]
    reasons += [Reason(**each) for each in recorded if each["what"] in (REPEATS, NARROW)]
    judged = Verdict.of(reasons, verdict.residual_ratio, verdict.untested, verdict.notes)
    return RunCheck(replace(judged, reduced_chi2=verdict.reduced_chi2))
