"""photonpano run."""

from pathlib import Path
from typing import Annotated

import typer

from photonpano.cli.options import Overrides, SpecPath


def run(
    spec: SpecPath,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="DIR", help="The run folder, instead of the spec's output.directory.", show_default=False
        ),
    ] = None,
    overrides: Overrides = None,
) -> None:
    """Make a panorama from a spec.

    Writes the run folder: panorama.png to look at, panorama.tiff with linear flux, coverage.tiff, trajectory.npz, run.json
    (settings, versions, results) and report.html.

    Example: photonpano run scan.yaml --output runs/first --set render.scale=2
    """
    from photonpano.cli.errors import warn
    from photonpano.cli.progress import progress_for_stderr
    from photonpano.pipeline.run import run as run_plan
    from photonpano.specs import load_spec

    result = run_plan(load_spec(spec, overrides or (), output), progress_for_stderr())
    for warning in result.record["warnings"]:
        warn(warning)
    directory = result.directory.resolve()
    typer.echo(f"panorama  {directory / 'panorama.png'}")
    typer.echo(f"report    {directory / 'report.html'}")
