"""photonpano convert."""

from pathlib import Path
from typing import Annotated

import typer

from photonpano.cli.options import CapturePath, Corrections, Keys, SourceName


def convert(
    path: CapturePath,
    output: Annotated[
        Path,
        typer.Argument(metavar="OUTPUT", help="The file to write, such as cube.npy, or cube.zarr.", show_default=False),
    ],
    source: SourceName = None,
    keys: Keys = None,
    corrections: Corrections = None,
    compress: Annotated[bool, typer.Option("--compress", help="Compress the chunks of a zarr array.")] = False,
) -> None:
    """Convert binary frames to a packed .npy file or a zarr array.

    Eight pixels are packed into a byte. The only corrections are those of --correct, or of the spec. If the conversion to a
    .npy file is interrupted, the frames written so far stay in CUBE.npy.part, and the same command continues from there. A zarr
    array is written whole or not at all.

    Example: photonpano convert recording/ cube.npy --with frame_rate_hz=96800
    """
    from photonpano.api.captures import convert as convert_capture
    from photonpano.atomic import part_path
    from photonpano.cli.options import capture_plan
    from photonpano.cli.progress import progress_for_stderr
    from photonpano.cli.tables import print_written

    part = part_path(output)

    def resumed(n_frames: int) -> None:
        typer.echo(f"{part} holds {n_frames:,} frames of this capture: continuing from there", err=True)

    before = part.stat().st_mtime_ns if part.exists() else None
    with capture_plan(path, source, keys, corrections) as plan:
        try:
            written = convert_capture(plan, output, progress_for_stderr(), resumed, compress=compress)
        finally:
            if part.exists() and part.stat().st_mtime_ns != before:
                typer.echo(f"the frames written so far are in {part}; the same command continues from there", err=True)
    print_written(written)
