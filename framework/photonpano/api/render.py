"""Render a finished run again, with other settings."""

from __future__ import annotations

import datetime
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import typer

from photonpano.api.command import command
from photonpano.api.opened_run import OpenedRun, opened_run
from photonpano.errors import InputError
from photonpano.execution.context import Context, Progress, usual
from photonpano.execution.threads import one_thread_inside, thread_count
from photonpano.merging.panorama import RenderedPanorama
from photonpano.pipeline.rendering import render_into
from photonpano.pipeline.run_folder import run_folder as writing_run_folder
from photonpano.plugins.registry import Catalog
from photonpano.record.contents import capture_files, fingerprint
from photonpano.record.run_json import decision_records, library_versions, panorama_record, peak_memory_bytes, plugin_records
from photonpano.record.schema import RunRecord
from photonpano.report.notebook import run_html
from photonpano.values import Decision

# Sections of a spec that may differ from those of the run. That of the source tells where the capture is now.
_SECTIONS = ("render", "output", "run", "source")


@dataclass(frozen=True, slots=True)
class RenderResult:
    """A run that was rendered again.

    Attributes:
        directory: the new run folder.
        record: the content of its `run.json`.
    """

    directory: Path
    record: RunRecord = field(repr=False)

    def _repr_html_(self) -> str:
        return run_html(self.directory, self.record)


@command(
    "runs/first --scale 2 --output runs/large",
    lambda result: [f"panorama  {result.directory.resolve() / 'panorama.png'}"],
    settings={
        "scale": typer.Option(metavar="X", help="Pixels of the panorama per pixel of a frame."),
        "projection": typer.Option(
            metavar="NAME", help="planar, cylindrical, spherical, or auto; other than planar for a camera that only rotates."
        ),
        "extent": typer.Option(
            metavar="BOX",
            help="panorama, reference (a stabilised image), or a box x0,y0,x1,y1: in pixels of the reference frame, but in "
            "degrees on a cylinder or a sphere.",
        ),
    },
)
def render(
    run_folder: Path | str,
    output: Path | str,
    changes: Sequence[str] = (),
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
    catalog: Catalog | None = None,
) -> RenderResult:
    """Render the panorama of a finished run again, with other settings. Nothing is located again.

    The new folder is a run folder without a report. Its files are, byte for byte, those of a whole run with these settings.

    Args:
        run_folder: written by `run`.
        output: the new run folder.
        changes: values of the recorded spec to change, such as `render.scale=2`, `output.formats=[exr]`, or
            `source.with.path=...` for a capture that was moved.
        overwrite: write beside other files, which stay, or replace a run of another capture.
        progress: receives the stages; by default, bars in a notebook and nothing elsewhere.
        catalog: what can be chosen; by default what the installed plugins offer.

    Raises:
        CanvasTooLargeError: the panorama would exceed `run.memory`.
        InputError: the folder is no run folder, its capture cannot be opened, or it is another capture now; `output` is
            that folder.
        OutputError: the new folder cannot be written.
        PluginError: the renderer or an exporter failed, or broke its contract.
        SpecError: a change is wrong.
    """
    for change in changes:
        require_harmless(change)
    if any(_key(change) == "render.use" for change in changes):
        changes = ["render.with={}", *changes]  # the recorded keys are those of another renderer
    start, folder = time.perf_counter(), Path(run_folder)
    if Path(output).absolute().resolve() == folder.absolute().resolve():
        raise InputError(f"{folder} would be replaced by its own rendering; choose another folder with --output")
    with (
        opened_run(folder, catalog, changes, Path(output)) as opened,
        writing_run_folder(
            opened.plan.output.directory, overwrite=overwrite, inputs=[folder, *capture_files(opened.plan)]
        ) as written,
        one_thread_inside(),
    ):
        require_same_plane(opened)
        context = Context(thread_count(opened.plan.run.threads), usual(progress))
        rendered = render_into(written, opened.plan, opened.source, opened.vignette, opened.motion, context)
        record = written.commit(_record(opened, *rendered, time.perf_counter() - start))
    return RenderResult(opened.plan.output.directory, record)


def require_harmless(change: str) -> None:
    """Refuse a change of what a rendering does not do."""
    if _key(change).partition(".")[0] not in _SECTIONS:
        raise InputError(
            f"{change}: a rendering has only the sections {', '.join(_SECTIONS[:-1])} and {_SECTIONS[-1]}; "
            "run the spec again to change others"
        )


def _key(change: str) -> str:
    return change.partition("=")[0].strip()


def require_same_plane(opened: OpenedRun) -> None:
    """Refuse another reference frame than that of the run."""
    recorded, wanted = opened.record["spec"]["render"]["reference"], opened.plan.render.reference
    if recorded != wanted:
        raise InputError(
            f"render.reference: the panorama of {opened.folder} lies in the plane of frame {recorded!r}, and a rendering stays "
            f"there; run the spec again for {wanted!r}"
        )


def _record(opened: OpenedRun, panorama: RenderedPanorama, chosen: Sequence[Decision], seconds: float) -> RunRecord:
    """Return the record of the run, with what was rendered again."""
    plan, old = opened.plan, opened.record
    # The last decisions are those of renderer and exporters.
    before = [] if old["panorama"] is None else old["panorama"].get("decisions", [])
    kept = old["decisions"][: len(old["decisions"]) - len(before)]
    return {
        **old,
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "spec": plan.document,
        "plugins": plugin_records(plan),
        "libraries": library_versions(plan),
        "decisions": [*kept, *decision_records(chosen)],
        "findings": {**old.get("findings", {}), "never_seen_share": panorama.never_seen_share},
        "panorama": panorama_record(plan, panorama, chosen),
        "seconds": round(seconds, 3),
        "peak_memory_bytes": peak_memory_bytes(),
        "capture": fingerprint(plan, opened.capture),
        "rendered_from": str(opened.folder.absolute()),
    }
