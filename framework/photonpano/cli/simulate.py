"""photonpano simulate."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from photonpano.cli.arguments import Overrides, Spec

if TYPE_CHECKING:
    from photonpano.values import StreamInfo


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
    from rich.filesize import decimal

    from photonpano.cli.outcome import warn
    from photonpano.cli.progress import progress_for_stderr
    from photonpano.cli.wording import capture_words, columns
    from photonpano.pipeline.capture import truth_path, write_packed
    from photonpano.pipeline.components import build_source
    from photonpano.pipeline.threads import thread_count
    from photonpano.registry.description import flow
    from photonpano.spec import load_spec

    plan = load_spec(spec, overrides or ())
    with build_source(plan) as source:
        info = source.info
        with progress_for_stderr().stage(f"writing {output.name}", info.n_frames, "frames") as advance:
            files = write_packed(source, output, advance, thread_count(plan.run))
        unused = int((~source.valid).sum())
    if unused:
        warn(f"{unused} pixels are not to be used, which {output} does not say; mask them with `corrections`")
    words = [capture_words(info), "the truth: motion and scene"]
    typer.echo(columns([[str(file), decimal(file.stat().st_size), text] for file, text in zip(files, words, strict=False)]))
    typer.echo("\nIn a spec that lies here:\n")
    typer.echo(f"source: {flow({'use': 'packed-npy', 'with': _keys(output, info)})}")
    if truth_path(output) in files:
        typer.echo(f"\nTo score a run of it: photonpano evaluate RUN --truth {truth_path(output)}")


def _keys(path: Path, info: "StreamInfo") -> dict[str, Any]:
    keys: dict[str, Any] = {"path": str(path)}
    if info.frame_rate_hz is not None:
        keys["frame_rate_hz"] = info.frame_rate_hz
    if info.width % 8:
        keys["width"] = info.width
    return keys
