"""photonpano verify."""

from pathlib import Path
from typing import Annotated

import typer


def verify(run: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder.", show_default=False)]) -> None:
    """Verify that a run folder is as its run wrote it.

    Compares the size and SHA-256 of each file with run.json, and the capture with its fingerprint there. The exit code is 1 if
    anything differs.

    Example: photonpano verify runs/first
    """
    from photonpano.api.verification import verify as verify_run
    from photonpano.errors import InputError
    from photonpano.text import byte_size, counted

    found = verify_run(run)
    if found.problems:
        raise InputError(f"{run} is not as its run wrote it: {'; '.join(found.problems)}")
    typer.echo(f"files     {counted(found.n_files, 'file')}, {byte_size(found.n_bytes)}, as the run wrote them")
    typer.echo(f"capture   {found.capture}")
