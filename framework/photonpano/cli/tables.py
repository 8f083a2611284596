"""Print tables, and what was written."""

from __future__ import annotations

from shlex import quote
from typing import TYPE_CHECKING
from zipfile import ZipFile

import typer

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from photonpano.api.captures import WrittenCapture


def columns(rows: Sequence[Sequence[str]]) -> str:
    """Align rows of text in columns: two spaces apart, no line wrapped, no trailing spaces."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join("  ".join(map(str.ljust, row, widths)).rstrip() for row in rows)


def _size(path: Path) -> int:
    """Return the bytes of a file, or of the files in a folder."""
    return sum(file.stat().st_size for file in (path.iterdir() if path.is_dir() else [path]))


def print_written(written: WrittenCapture) -> None:
    """Print the files that were written, and the spec that reads them."""
    from rich.filesize import decimal

    from photonpano.cli.errors import warn
    from photonpano.registry.description import flow
    from photonpano.text import counted

    if written.n_masked:
        mask = "mask them with `corrections`"
        warn(f"{written.n_masked} pixels of the capture are masked, and {written.path} holds no mask; {mask}")
    files = [(written.path, str(written.info)), (written.truth, "the truth: motion and scene")]
    if written.sharp:
        files.append((written.sharp, f"{counted(len(list(written.sharp.iterdir())), 'frame')} without noise"))
    rows = [[str(file), decimal(_size(file)), text] for file, text in files if file]
    typer.echo(columns(rows))
    typer.echo(f"\nIn a spec in this folder:\n\nsource: {flow(dict(written.source))}")
    held = ZipFile(written.truth).namelist() if written.truth else ()
    for array, kind in (("homographies", "run"), ("camera_from_world", "run with `pose`")):
        if f"{array}.npy" in held:
            typer.echo(f"\nTo score a {kind} of it: photonpano evaluate RUN --truth {quote(str(written.truth))}")
