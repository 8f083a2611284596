"""photonpano batch."""

from pathlib import Path
from typing import Annotated

import typer

from photonpano.cli.options import Overwrite, SpecPath
from photonpano.cli.verdict import Strict


def batch(
    spec: SpecPath,
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", metavar="DIR", help="The folder of all run folders and of the summary.", show_default=False
        ),
    ],
    captures: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[CAPTURE]...",
            help="Files, folders, URLs, and patterns in quotes, such as 'captures/*.npy'. A folder that is no capture stands "
            "for those in it.",
            show_default=False,
        ),
    ] = None,
    lists: Annotated[
        list[Path] | None,
        typer.Option(
            "--from",
            metavar="LIST",
            help="A text file with one capture a line, relative to its folder; # begins a comment. - is standard input. "
            "Repeatable.",
            show_default=False,
        ),
    ] = None,
    changes: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Change a value of the spec in all runs, such as run.seed=1. A list sweeps, as in levels.0.scale=[0.5,1], "
            "unless the key takes a list. Repeatable.",
            show_default=False,
        ),
    ] = None,
    sweep: Annotated[
        list[str] | None,
        typer.Option(
            "--sweep",
            metavar="KEY=VALUE,VALUE",
            help="Run each capture with each of these values, such as resample.with.group_size=50,100. Repeatable: every "
            "combination is run.",
            show_default=False,
        ),
    ] = None,
    jobs: Annotated[
        int, typer.Option("--jobs", "-j", metavar="N", min=1, help="How many runs go on at once; they share the cores.")
    ] = 1,
    overwrite: Overwrite = False,
    strict: Strict = False,
) -> None:
    """Run one spec on many captures, and write one summary.

    Each capture takes the place of the spec's source.with.path, and gets a run folder of its name. A run that fails, crashes
    or is killed becomes a row that says why. What is finished is not run again. summary.html and summary.csv can be watched
    meanwhile. Exits with 1 if a run failed.

    Example: photonpano batch scan.yaml 'captures/*.npy' --output runs/night --jobs 2
    """
    from photonpano.api.batch.batch import prepare_batch, run_batch
    from photonpano.api.batch.summary import PAGE
    from photonpano.cli.errors import WrongArgumentError
    from photonpano.cli.progress import progress_for_stderr
    from photonpano.cli.tables import columns
    from photonpano.cli.verdict import DoubtfulError
    from photonpano.errors import InputError, PhotonpanoError
    from photonpano.record.batch_row import BatchRow
    from photonpano.text import counted

    try:
        prepared = prepare_batch(spec, captures or (), output, lists=lists or (), changes=changes or (), swept=sweep or ())
    except InputError as error:
        raise WrongArgumentError(str(error)) from error
    result = run_batch(prepared, jobs, progress_for_stderr(notes=True), overwrite=overwrite)
    typer.echo(columns([BatchRow.COLUMNS, *(row.cells() for row in result.rows)]))
    typer.echo(f"\nsummary   {result.directory / PAGE}")
    if result.failed:
        others = "; the others are done" if len(result.failed) < len(result.rows) else ""
        raise PhotonpanoError(f"{len(result.failed)} of {counted(len(result.rows), 'run')} failed{others}")
    if strict and (doubtful := [row for row in result.rows if row.verdict != "trusted"]):
        raise DoubtfulError(f"{counted(len(doubtful), 'run is', 'runs are')} doubtful, and --strict accepts only trusted ones")
