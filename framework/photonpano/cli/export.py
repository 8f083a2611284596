"""photonpano export."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer


class Format(StrEnum):
    """Formats of poses."""

    colmap = "colmap"
    nerfstudio = "nerfstudio"
    tum = "tum"


def export(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder.", show_default=False)],
    file_format: Annotated[
        Format,
        typer.Option(
            "--format",
            help="colmap: a text model. nerfstudio: transforms.json. tum: times and quaternions.",
            show_default=False,
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="A new folder.", show_default=False)],
    every: Annotated[int, typer.Option("--every", min=1, metavar="N", help="Only every Nth located frame.")] = 1,
) -> None:
    """Write where the camera looked in each frame, for other programs.

    Needs a run with the model rotation, or with pose. Frames that were not located are left out.

    Example: photonpano export runs/turn --format colmap --output poses
    """
    from photonpano.api.poses import export as export_poses

    exported = export_poses(run, file_format.value, output, every)
    typer.echo(f"{exported.n_frames:,} poses in {', '.join(str(path) for path in exported.files)}")
