"""photonpano run."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from photonpano.cli.options import Overrides, Overwrite, SpecPath
from photonpano.cli.verdict import Strict

if TYPE_CHECKING:
    from photonpano.pipeline.run import RunResult
    from photonpano.record.schema import PanoramaRecord, RefinementRecord
    from photonpano.report import LiveFigures


def run(
    spec: SpecPath,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="DIR", help="The run folder, instead of the spec's output.directory.", show_default=False
        ),
    ] = None,
    overrides: Overrides = None,
    overwrite: Overwrite = False,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a run of this spec that was interrupted.")] = False,
    from_level: Annotated[
        int | None,
        typer.Option(
            "--from-level",
            metavar="N",
            help="Take the levels before N from the run before, whose work was kept, and compute N and what follows.",
            show_default=False,
        ),
    ] = None,
    keep_work: Annotated[
        bool, typer.Option("--keep-work", help="Keep what each level has found, for --from-level, in the folder DIR.work.")
    ] = False,
    follow: Annotated[
        bool,
        typer.Option(
            "--follow",
            help="Follow a capture that is still being written, or comes on standard input: locate its frames as they arrive, "
            "and write a page with the picture so far, DIR.live/live.html. Run the whole once it is complete.",
        ),
    ] = False,
    end_after: Annotated[
        float | None,
        typer.Option(
            "--end-after",
            metavar="SECONDS",
            min=0.1,
            help="With --follow: a growing file is complete when nothing has come for so long; by default 5.",
            show_default=False,
        ),
    ] = None,
    strict: Strict = False,
) -> None:
    """Make a panorama from a spec.

    Writes the run folder: panorama.png to look at, panorama.tiff with linear flux, coverage.tiff, trajectory.npz, run.json
    (settings, versions, results) and report.html. The verdict says whether motion and panorama explain the photons.
    A spec with 'pose' finds the poses of a camera instead: poses.npz, and files of other programs.

    Example: photonpano run scan.yaml --output runs/first --set render.scale=2
    """
    from photonpano.cli.errors import WrongArgumentError
    from photonpano.cli.progress import progress_for_stderr
    from photonpano.cli.verbosity import log_decisions
    from photonpano.pipeline.run import END_AFTER_S
    from photonpano.pipeline.run import run as run_plan
    from photonpano.specs import load_spec

    if resume and from_level is not None:
        raise WrongArgumentError("--resume and --from-level: give one of them")
    if follow and (resume or from_level is not None):
        raise WrongArgumentError(
            "--follow begins a new run, which --resume and --from-level do not; to go on with frames that have arrived, leave "
            "out --follow"
        )
    if end_after is not None and not follow:
        raise WrongArgumentError("--end-after says when a capture that is followed is complete; give --follow as well")
    plan = load_spec(spec, overrides or (), output, arriving=follow)
    result = run_plan(
        plan,
        progress_for_stderr(notes=follow),
        overwrite=overwrite,
        resume=resume,
        from_level=from_level,
        keep_work=keep_work,
        follow=follow,
        end_after=END_AFTER_S if end_after is None else end_after,
    )
    log_decisions(result.record)
    _print_result(result)
    if strict:
        _require_trust(result)


def _print_result(result: "RunResult") -> None:
    """Print what a run has found, and where its files are."""
    from photonpano.cli.errors import warn
    from photonpano.cli.verdict import print_verdict
    from photonpano.motion.timeline import CUT, DARK_JUMP, REPEATED
    from photonpano.pipeline.estimate import START
    from photonpano.text import counted

    record, directory = result.record, result.directory.resolve()
    if result.was_finished:
        typer.echo("finished  this run was finished before; nothing was left to do")
    if result.followed is not None:
        typer.echo(f"followed  {_delays(result.followed)}")
    if result.verdict is not None:
        print_verdict(result.verdict)
    for warning in record["warnings"]:
        warn(warning)
    for decision in record["decisions"]:
        if decision["what"] in (START, CUT, DARK_JUMP, REPEATED):
            typer.echo(f"{decision['what']:<9} {decision['value']}: {decision['reason']}")
    for refinement in record["refinements"]:
        if refinement["rounds"]:
            typer.echo(f"refined   {_correction(refinement)}")
    if line := _range(record.get("panorama")):
        typer.echo(f"range     {line}")
    if poses := record.get("poses"):
        typer.echo(f"located   {poses['located']:,} of {counted(record['source']['n_frames'], 'frame')}")
        typer.echo(f"poses     {directory / 'poses.npz'}")
    else:
        typer.echo(f"panorama  {directory / 'panorama.png'}")
    if "report.html" in record["files"]:
        typer.echo(f"report    {directory / 'report.html'}")


def _require_trust(result: "RunResult") -> None:
    """Refuse a run that is doubtful.

    Raises:
        DoubtfulError: its verdict, or that on its poses, is doubtful.
    """
    from photonpano.cli.verdict import DoubtfulError, require_trust

    if result.verdict is not None:
        require_trust(result.verdict, "all files of the run folder are written")
    if (poses := result.record.get("poses")) and poses["doubts"]:
        raise DoubtfulError("the poses are doubtful, and --strict accepts only trusted ones; all files of the run are written")


def _delays(figures: "LiveFigures") -> str:
    """Describe how fast frames were located."""
    from photonpano.text import counted, duration

    text = f"{figures.located:,} of {counted(figures.frames, 'frame')} were located as they arrived"
    if figures.delay_mean_s is None or figures.delay_longest_s is None:
        return text
    return f"{text}, {duration(figures.delay_mean_s)} later on average and {duration(figures.delay_longest_s)} at most"


def _range(panorama: "PanoramaRecord | None") -> str:
    """Describe the dynamic range of a panorama; empty where nothing exceeds its noise."""
    if panorama is None:
        return ""
    decibels, measurable = panorama.get("dynamic_range_db"), panorama.get("measurable_range_db")
    if decibels is None or measurable is None:
        return ""
    share = panorama.get("saturated_share", 0.0)
    saturated = f"; {100 * share:.2g} % of the pixels are saturated" if share else ""
    return f"{decibels:.0f} dB, of {measurable:.0f} dB that the frames over a pixel can measure{saturated}"


def _correction(refinement: "RefinementRecord") -> str:
    """Describe a correction by its first round, which is the largest."""
    return f"{refinement['change_px']:.2g} px on average by {refinement['use']}: {refinement['rounds'][0]}"
