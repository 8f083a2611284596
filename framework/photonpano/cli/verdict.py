"""Print the verdict on a run: its status on stdout, the reasons of a doubtful one on stderr."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from photonpano.errors import PhotonpanoError

if TYPE_CHECKING:
    from photonpano.residuals.verdict import Verdict

Strict = Annotated[bool, typer.Option("--strict", help="Exit with 1 if the verdict is doubtful.")]


class DoubtfulError(PhotonpanoError):
    """A run is doubtful, and only a trusted one is a success."""


def print_verdict(verdict: Verdict) -> None:
    """Print the status, and each reason as a sentence."""
    typer.echo(f"verdict   {verdict.status}")
    for reason in verdict.reasons:
        typer.echo(f"doubtful: {reason}", err=True)


def require_trust(verdict: Verdict, files: str) -> None:
    """Fail with --strict.

    Args:
        verdict: of the run.
        files: what became of the files, as a clause.

    Raises:
        DoubtfulError: the verdict is doubtful.
    """
    if verdict.status != "trusted":
        raise DoubtfulError(f"the verdict is doubtful, and --strict accepts only a trusted one; {files}")
