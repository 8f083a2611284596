"""photonpano simulate."""

from pathlib import Path
from typing import Annotated

import typer

from photonpano.cli.options import Overrides, SpecPath


def simulate(
    spec: SpecPath,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="CUBE.npy", help="The file to write.", show_default=False)],
    overrides: Overrides = None,
    sharp_every: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="N",
            help="Write each N-th frame without noise as well, to the folder CUBE.sharp: PNGs of 8 bits, sRGB.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Write a simulated capture to a packed .npy file, with its truth.

    The truth (motion and scene) is written beside it, for 'evaluate'. The spec needs only 'version' and 'source'. The source
    may be any that gives binary frames; a recording has no truth, and no sharp frames.

    Example: photonpano simulate capture.yaml --output cube.npy
    """
    from photonpano.api.captures import simulate as write_simulated
    from photonpano.cli.progress import progress_for_stderr
    from photonpano.cli.tables import print_written
    from photonpano.specs import load_spec

    print_written(write_simulated(load_spec(spec, overrides or ()), output, progress_for_stderr(), sharp_every))
