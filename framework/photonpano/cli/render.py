"""photonpano render."""

from pathlib import Path
from typing import Annotated

import typer

from photonpano.cli.options import Overwrite


def render(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder.", show_default=False)],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="The new run folder.", show_default=False)],
    scale: Annotated[
        float | None, typer.Option("--scale", help="Pixels of the panorama per pixel of a frame.", show_default=False)
    ] = None,
    projection: Annotated[
        str | None,
        typer.Option(
            "--projection",
            help="planar, cylindrical, spherical, or auto; other than planar for a camera that only turns.",
            show_default=False,
        ),
    ] = None,
    extent: Annotated[
        str | None,
        typer.Option(
            "--extent",
            help="panorama, reference (a stabilised image), or a box x0,y0,x1,y1: in pixels of the reference frame, but in "
            "degrees on a cylinder or a sphere.",
            show_default=False,
        ),
    ] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Change a value of the sections render, output, run or source, such as render.tone=local, "
            "'output.formats=[exr]' or source.with.path=moved.npy. Repeatable.",
            show_default=False,
        ),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Render a finished run again, with other settings.

    Opens the capture that run.json names, and locates nothing again: the new folder holds the panorama that a whole run with
    these settings makes. It has no report.

    Example: photonpano render runs/first --scale 2 --output runs/large
    """
    from photonpano.api.rendering import render as render_again
    from photonpano.cli.progress import progress_for_stderr

    changes = list(overrides or ())
    if scale is not None:
        changes.append(f"render.scale={scale:g}")
    if projection is not None:
        changes.append(f"render.projection={projection}")
    if extent is not None:
        changes.append(
            f"render.extent=[{extent}]" if "," in extent and not extent.startswith("[") else f"render.extent={extent}"
        )
    result = render_again(run, output, changes, overwrite=overwrite, progress=progress_for_stderr())
    typer.echo(f"panorama  {result.directory.resolve() / 'panorama.png'}")
