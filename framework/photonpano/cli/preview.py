"""photonpano preview."""

from pathlib import Path
from typing import Annotated

import typer

from photonpano.cli.options import CapturePath, Corrections, Keys, SourceName


def preview(
    path: CapturePath,
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", metavar="OUT", help="A new folder for PNGs, or an .mp4, .webp or .gif file.", show_default=False
        ),
    ],
    source: SourceName = None,
    keys: Keys = None,
    corrections: Corrections = None,
    group_size: Annotated[int, typer.Option(min=1, metavar="N", help="Frames of a picture.")] = 256,
    step: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="N",
            help="Frames from the start of one picture to the next; by default --group-size.",
            show_default=False,
        ),
    ] = None,
    quantile: Annotated[
        float, typer.Option(min=0, max=1, metavar="Q", help="The share of the pixels that are darker than white.")
    ] = 0.995,
    white: Annotated[
        float | None,
        typer.Option(
            min=1e-9,
            metavar="FLUX",
            help="The flux that is white, in photons per pixel per frame; replaces --quantile.",
            show_default=False,
        ),
    ] = None,
    srgb: Annotated[
        bool, typer.Option("--srgb/--linear", help="sRGB levels for screens, or levels proportional to the flux.")
    ] = True,
    label: Annotated[
        bool, typer.Option("--label/--no-label", help="Write the frame numbers and the time below each picture.")
    ] = True,
    fps: Annotated[float, typer.Option(min=0.1, max=240, metavar="HZ", help="Pictures per second of a film.")] = 24,
) -> None:
    """Merge frames into pictures, to look at a capture.

    The motion is not known yet, so frames are summed as they are. White is the same flux in all pictures, so that their
    brightness can be compared.

    Example: photonpano preview cube.npy --output look.mp4 --group-size 500
    """
    from photonpano.api.pictures import preview as preview_capture
    from photonpano.cli.options import capture_plan
    from photonpano.cli.progress import progress_for_stderr

    with capture_plan(path, source, keys, corrections) as plan:
        made = preview_capture(
            plan,
            output,
            group_size,
            step,
            quantile=quantile,
            white=white,
            srgb=srgb,
            label=label,
            fps=fps,
            progress=progress_for_stderr(),
        )
    typer.echo(f"{output}: {made.n_pictures:,} pictures of {made.info}, {made.group_size} frames each")
    typer.echo(f"white is {made.white_flux:.4g} photons per pixel per frame")
