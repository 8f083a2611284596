"""photonpano check-run."""

from pathlib import Path
from typing import Annotated

import typer

from photonpano.cli.verdict import Strict


def check_run(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder.", show_default=False)],
    strict: Strict = False,
) -> None:
    """Judge a finished run by its capture.

    Opens the capture that run.json names, renders the panorama along trajectory.npz, and compares each span of a few frames
    with what the panorama predicts. Writes nothing.

    Example: photonpano check-run runs/first --strict
    """
    from photonpano.api.run_check import check_run as check
    from photonpano.cli.errors import warn
    from photonpano.cli.progress import progress_for_stderr
    from photonpano.cli.verdict import print_verdict, require_trust

    found = check(run, progress_for_stderr())
    print_verdict(found.verdict)
    for sentence in found.unknown:
        warn(sentence)
    ratio = found.verdict.residual_ratio
    typer.echo(f"scatter   {'unknown: too few frames' if ratio is None else f'{ratio:.2f} times what noise explains'}")
    if strict:
        require_trust(found.verdict, "nothing was written")
