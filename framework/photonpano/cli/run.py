"""photonpano run."""

from pathlib import Path
from typing import Annotated

import typer

from photonpano.cli.arguments import Overrides, Spec


def run(
    spec: Spec,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="DIR", help="The run folder, in place of the spec's.", show_default=False),
    ] = None,
    overrides: Overrides = None,
) -> None:
    """Make the panorama of a spec.

    Writes the run folder: panorama.png to look at, panorama.tiff with the linear flux, coverage.tiff, trajectory.npz,
    run.json with everything that was used and found, and report.html.

    Example: photonpano run scan.yaml --output runs/first --set render.scale=2
    """
    from photonpano.cli.outcome import warn
    from photonpano.cli.progress import progress_for_stderr
    from photonpano.pipeline.run import run as run_plan
    from photonpano.specs import load_spec

    result = run_plan(load_spec(spec, overrides or (), output), progress_for_stderr())
    for warning in result.record["warnings"]:
        warn(warning)
    directory = result.directory.resolve()
    typer.echo(f"panorama  {directory / 'panorama.png'}")
    typer.echo(f"report    {directory / 'report.html'}")
