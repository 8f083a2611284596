"""photonpano simulate."""

from pathlib import Path
from typing import Annotated

import typer

from photonpano.cli.arguments import Overrides, Spec


def simulate(
    spec: Spec,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="CUBE.npy", help="The capture to write.", show_default=False)
    ],
    overrides: Overrides = None,
) -> None:
    """Write a simulated capture to a .npy file, with its truth.

    The frames are packed, eight pixels to a byte; the truth, motion and scene, is stored beside them for 'evaluate'.

    The spec needs no more than 'version' and 'source'. Any source of binary frames can be written, a simulated one or a
    recording; only those that know their truth have one.

    Example: photonpano simulate capture.yaml --output cube.npy
    """
    from photonpano.captures.writing import write_packed
    from photonpano.cli.progress import progress_for_stderr
    from photonpano.cli.written import tell_written
    from photonpano.pipeline.components import build_source
    from photonpano.specs import load_spec
    from photonpano.threads import thread_count

    plan = load_spec(spec, overrides or ())
    with build_source(plan) as source:
        info = source.info
        with progress_for_stderr().stage(f"writing {output.name}", info.n_frames, "frames") as advance:
            files = write_packed(source, output, advance, thread_count(plan.run.threads))
        unused = int((~source.valid).sum())
    tell_written(files, info, unused)
