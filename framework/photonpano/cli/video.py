"""photonpano video."""

from pathlib import Path
from typing import Annotated

import typer


def video(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder.", show_default=False)],
    output: Annotated[
        Path,
        typer.Argument(metavar="OUT", help="An .mp4, .webp or .gif file, or a new folder for 16-bit PNGs.", show_default=False),
    ],
    view: Annotated[
        str,
        typer.Option(
            "--view",
            metavar="VIEW",
            help="panorama: the canvas of the panorama, on which still things stand still. "
            "smooth: as large as a frame; it follows the camera without its tremor.",
        ),
    ] = "panorama",
    exposure: Annotated[
        str | None,
        typer.Option(
            "--exposure",
            metavar="N|TIME",
            help="Frames that a picture merges, or a time such as 5ms; by default as many as the groups of the last level.",
            show_default=False,
        ),
    ] = None,
    fps: Annotated[float, typer.Option(min=0.1, max=240, metavar="HZ", help="Pictures per second of the video.")] = 25,
    speed: Annotated[
        float | None,
        typer.Option(
            "--speed",
            metavar="X",
            help="Seconds of the capture that pass in a second of the video, such as 0.01. By default, each exposure begins "
            "where the one before ends.",
            show_default=False,
        ),
    ] = None,
    trail: Annotated[bool, typer.Option("--trail", help="Draw the outline of the frame, over the panorama.")] = False,
    scale: Annotated[
        float | None, typer.Option("--scale", help="Pixels of the video per pixel of a frame.", show_default=False)
    ] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Change a value of the sections render, run or source, such as render.extent=reference, "
            "render.exposure_stops=1 or source.with.path=moved.npy. Repeatable.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Make a video along the motion of a finished run.

    Each picture merges the frames of an exposure along the motion; nothing is located again. White is the flux that is white in
    the panorama of the run. MP4 needs av: pip install "photonpano[video]".

    Example: photonpano video runs/first first.mp4 --view smooth --exposure 2ms --speed 0.05
    """
    from photonpano.api.video import video as make_video
    from photonpano.cli.progress import progress_for_stderr

    changes = list(overrides or ())
    if scale is not None:
        changes.append(f"render.scale={scale:g}")
    made = make_video(
        run,
        output,
        view=view,  # type: ignore[arg-type]
        exposure=exposure,
        fps=fps,
        speed=speed,
        trail=trail,
        changes=changes,
        progress=progress_for_stderr(),
    )
    height, width = made.shape
    typer.echo(f"{made.path}: {made.n_pictures:,} pictures of {height}x{width}, {made.exposure:,} frames each")
    if made.speed is not None:
        typer.echo(f"a second of the video shows {made.speed:.4g} s of the capture")
