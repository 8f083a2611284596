"""photonpano clean."""

from pathlib import Path
from typing import Annotated

import typer


def clean(
    directory: Annotated[
        Path, typer.Argument(metavar="DIR", help="A folder with captures or run folders.", show_default=False)
    ],
    dry_run: Annotated[bool, typer.Option("--dry-run", "-n", help="List what would be removed, and remove nothing.")] = False,
) -> None:
    """Remove what killed processes have left.

    That is unfinished files, locks and unpacked archives. Looks into all folders in DIR, and prints what it removes. Nothing
    is removed that a process uses, nor the unfinished files of 'convert', which it continues.

    Example: photonpano clean . --dry-run
    """
    from photonpano.api.verification import clean as clean_folder
    from photonpano.text import counted

    found = clean_folder(directory, dry_run)
    for path in found:
        typer.echo(path)
    typer.echo(f"{counted(len(found), 'leftover')} {'found' if dry_run else 'removed'}")
