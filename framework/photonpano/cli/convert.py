"""photonpano convert."""

from pathlib import Path
from typing import Annotated

import typer

from photonpano.cli.capture import CapturePath, Corrections, Keys, SourceName


def convert(
    path: CapturePath,
    output: Annotated[Path, typer.Argument(metavar="CUBE.npy", help="The capture to write.", show_default=False)],
    source: SourceName = None,
    keys: Keys = None,
    corrections: Corrections = None,
) -> None:
    """Write a capture of binary frames to a packed .npy file.

    Eight pixels are packed to a byte. The bits are those of the source, uncorrected unless corrections are asked for. If it
    is interrupted, what is written so far stays beside the output with '.part' behind its name, and the same command goes on
    from there.

    Example: photonpano convert recording/ cube.npy --with frame_rate_hz=96800
    """
    from photonpano.atomic import part_path
    from photonpano.captures.writing import write_packed
    from photonpano.cli.capture import opened
    from photonpano.cli.progress import progress_for_stderr
    from photonpano.cli.written import tell_written
    from photonpano.threads import thread_count

    part = part_path(output)

    def resumed(there: int) -> None:
        found = f"holds {there:,} of its frames, and is continued" if there else "is of another capture, and is written anew"
        typer.echo(f"{part} {found}", err=True)

    with opened(path, source, keys, corrections) as (plan, capture):
        info, unused = capture.info, int((~capture.valid).sum())
        try:
            with progress_for_stderr().stage(f"writing {output.name}", info.n_frames, "frames") as advance:
                files = write_packed(capture, output, advance, thread_count(plan.run.threads), resumed)
        finally:
            if part.exists():
                typer.echo(f"what is written so far is in {part}; the same command goes on from there", err=True)
    tell_written(files, info, unused)
