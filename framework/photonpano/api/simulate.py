"""Write a simulated capture with its truth to a packed .npy file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import typer

from photonpano.api.command import command
from photonpano.api.convert import WrittenCapture, lines_of_capture, require_new_capture, write_capture, writer_of
from photonpano.execution.context import Progress, usual
from photonpano.execution.threads import one_thread_inside, thread_count
from photonpano.files.folders import atomic_folder, require_new
from photonpano.pipeline.components import build_source
from photonpano.plugins.registry import discover
from photonpano.record.picture_files import advancing, write_pngs
from photonpano.report.preview import require_sharp_views, sharp_pictures
from photonpano.specs import Plan


@command(
    "capture.yaml --output cube.npy",
    lines_of_capture,
    plan="spec",
    output=typer.Option("--output", "-o", metavar="CUBE.npy"),
    sharp_every=typer.Option(min=1, metavar="N"),
)
def simulate(
    plan: Plan,
    output: Path | str,
    progress: Progress | None = None,
    sharp_every: int | None = None,
    *,
    overwrite: bool = False,
) -> WrittenCapture:
    """Write a capture as `convert` does, whole or not at all; a simulated one with its truth beside it.

    The truth (motion and scene) is for `evaluate`. The spec needs only `version` and `source`. A recording has no truth, and no
    frames without noise.

    Args:
        plan: of the capture; its source may be any that gives binary frames.
        output: the .npy file, or the folder.
        progress: receives the stage; by default, bars in a notebook and nothing elsewhere.
        sharp_every: write each frame of this distance without noise as well, to the folder CAPTURE.sharp, such as
            cube.sharp/frame_000050.png for cube.npy: 8 bits, sRGB, the same white in all. By default, none.
        overwrite: replace the files that are there under these names.

    Raises:
        InputError: as `convert`; or the source cannot show frames without noise.
        OutputError: as `convert`, also for the folder of the pictures.
    """
    output = Path(output)
    writer = writer_of(output, discover())
    with build_source(plan) as source:
        require_new_capture(source, plan, output, overwrite)
        if sharp_every is None:
            return write_capture(source, plan, output, progress, None, writer)
        sharp, views = output.with_suffix(".sharp"), require_sharp_views(source)
        require_new(sharp, overwrite)
        frames = range(0, source.info.n_frames, sharp_every)
        with atomic_folder(sharp) as folder:
            with one_thread_inside(), usual(progress).stage(f"writing {sharp.name}", len(frames), "pictures") as advance:
                pictures = sharp_pictures(views, frames, thread_count(plan.run.threads))
                write_pngs(folder, advancing(pictures, advance), [f"frame_{frame:06}" for frame in frames])
            return replace(write_capture(source, plan, output, progress, None, writer), sharp=sharp)
