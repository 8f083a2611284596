"""Merge frames into pictures, to look at a capture."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import typer

from photonpano.api.command import command
from photonpano.execution.context import Progress, usual
from photonpano.execution.threads import one_thread_inside, thread_count
from photonpano.files.folders import require_new
from photonpano.pipeline.components import build_source
from photonpano.record.contents import capture_files
from photonpano.record.picture_files import advancing, require_writable, write_pictures
from photonpano.report.preview import Style, pictures, preview_spans, white_flux
from photonpano.specs import Plan
from photonpano.text import counted
from photonpano.values import StreamInfo


@dataclass(frozen=True, slots=True)
class Preview:
    """Pictures of a capture, written by `preview`.

    Attributes:
        path: the folder or film.
        n_pictures: how many pictures it holds.
        group_size: frames of each picture.
        white_flux: the flux that is white, photons per pixel per frame.
        info: the size and rate of the capture.
    """

    path: Path
    n_pictures: int
    group_size: int
    white_flux: float
    info: StreamInfo


def _lines(made: Preview) -> Iterator[str]:
    yield f"{made.path}: {counted(made.n_pictures, 'picture')} of {made.info}, {made.group_size} frames each"
    yield f"white is {made.white_flux:.4g} photons per pixel per frame"


@command(
    "cube.npy --output look.mp4 --group-size 500",
    _lines,
    plan="capture",
    output=typer.Option("--output", "-o", metavar="OUT"),
    group_size=typer.Option(min=1, metavar="N"),
    step=typer.Option(min=1, metavar="N"),
    quantile=typer.Option(min=0, max=1, metavar="Q"),
    white=typer.Option(min=1e-9, metavar="FLUX"),
    srgb=typer.Option("--srgb/--linear"),
    label=typer.Option("--label/--no-label"),
    fps=typer.Option(min=0.1, max=240, metavar="HZ"),
)
def preview(
    plan: Plan,
    output: Path | str,
    group_size: int = 256,
    step: int | None = None,
    *,
    quantile: float = 0.995,
    white: float | None = None,
    srgb: bool = True,
    label: bool = True,
    fps: float = 24,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Preview:
    """Merge frames into pictures without motion, to look at a capture.

    White is the same flux in all pictures, so that their brightness can be compared.

    Args:
        plan: of the capture; its corrections are applied.
        output: a folder for PNGs, or an .mp4, .webp or .gif file.
        group_size: frames of a picture.
        step: frames from the start of one picture to the next; by default `group_size`.
        quantile: the share of the pixels that are darker than white.
        white: the flux that is white, in photons per pixel per frame; in place of `quantile`.
        srgb: sRGB levels for screens, or levels proportional to the flux.
        label: write the frame numbers and the time below each picture.
        fps: pictures per second of a film.
        overwrite: replace the pictures that are there under this name.
        progress: receives the stage; by default, bars in a notebook and nothing elsewhere.

    Raises:
        OutputError: the pictures are there already, or cannot be written, or a library that writes them is missing.
    """
    output = Path(output)
    require_new(output, overwrite, capture_files(plan))
    with build_source(plan) as source, one_thread_inside():
        threads = thread_count(plan.run.threads)
        spans = preview_spans(source.info, group_size, step or group_size)
        require_writable(output, len(spans))
        style = Style(white_flux(source, spans, quantile, threads) if white is None else white, srgb, label)
        digits = len(str(source.info.n_frames))
        names = [f"frame_{span.start:0{digits}}" for span in spans]
        with usual(progress).stage(f"writing {output.name}", len(spans), "pictures") as advance:
            write_pictures(output, advancing(pictures(source, spans, style, threads), advance), names, fps)
        return Preview(output, len(spans), len(spans[0]), style.white_flux, source.info)
