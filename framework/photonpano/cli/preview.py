"""photonpano preview."""

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from photonpano.cli.capture import CapturePath, Corrections, Keys, SourceName

if TYPE_CHECKING:
    from photonpano.captures.picture_files import Picture


def preview(
    path: CapturePath,
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", metavar="OUT", help="A new folder for PNGs, or a file: .mp4 or .webp.", show_default=False
        ),
    ],
    source: SourceName = None,
    keys: Keys = None,
    corrections: Corrections = None,
    group_size: Annotated[int, typer.Option(min=1, metavar="N", help="Frames of an exposure.")] = 256,
    step: Annotated[
        int | None,
        typer.Option(min=1, metavar="N", help="Frames from one exposure to the next; by default all.", show_default=False),
    ] = None,
    quantile: Annotated[
        float, typer.Option(min=0, max=1, metavar="Q", help="The share of the pixels that is darker than white.")
    ] = 0.995,
    white: Annotated[
        float | None,
        typer.Option(
            min=1e-9,
            metavar="FLUX",
            help="The flux that is white, in place of a quantile; in photons per frame.",
            show_default=False,
        ),
    ] = None,
    srgb: Annotated[
        bool, typer.Option("--srgb/--linear", help="Levels as screens expect them, or in proportion to the flux.")
    ] = True,
    label: Annotated[bool, typer.Option("--label/--no-label", help="Write frames and time below each picture.")] = True,
    fps: Annotated[float, typer.Option(min=0.1, max=240, metavar="HZ", help="Pictures a second of a film.")] = 24,
) -> None:
    """Merge frames into pictures, to look at a capture.

    Frames are summed where they lie, since no motion is known. White is the same flux in all pictures, so that brightness can
    be compared.

    Example: photonpano preview cube.npy --output look.mp4 --group-size 500
    """
    from photonpano.captures.picture_files import require_writable, write_pictures
    from photonpano.captures.preview import Look, pictures, preview_spans, white_flux
    from photonpano.cli.capture import opened
    from photonpano.cli.progress import progress_for_stderr
    from photonpano.cli.wording import capture_words
    from photonpano.threads import one_thread_inside, thread_count

    with opened(path, source, keys, corrections) as (plan, capture), one_thread_inside():
        threads = thread_count(plan.run.threads)
        spans = preview_spans(capture.info, group_size, step or group_size)
        require_writable(output, len(spans))
        look = Look(white_flux(capture, spans, quantile, threads) if white is None else white, srgb, label)
        digits = len(str(capture.info.n_frames))
        names = [f"frame_{span.start:0{digits}}" for span in spans]
        with progress_for_stderr().stage(f"writing {output.name}", len(spans), "pictures") as advance:
            write_pictures(output, _counted(pictures(capture, spans, look, threads), advance), names, fps)
    typer.echo(f"{output}: {len(spans):,} pictures of {capture_words(capture.info)}, {len(spans[0])} frames each")
    typer.echo(f"white is {look.white_flux:.4g} photons per pixel per frame")


def _counted(pictures: "Iterable[Picture]", advance: Callable[[int], None]) -> "Iterator[Picture]":
    for picture in pictures:
        yield picture
        advance(1)
