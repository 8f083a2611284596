"""How commands end: what goes wrong becomes a message on stderr and an exit code."""

import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager

import typer

from photonpano.errors import PhotonpanoError, SpecError

FAILED = 1
WRONG_SPEC = 2
INTERRUPTED = 130


@contextmanager
def reported(*, debug: bool = False) -> Iterator[None]:
    """Report the errors of a command that are made for users; others are defects and keep their traceback.

    Args:
        debug: whether errors made for users show their traceback as well.

    Raises:
        typer.Exit: with the exit code of what went wrong.
    """
    try:
        yield
        sys.stdout.flush()  # a closed pipe shows here at the latest, and typer ends in silence
    except PhotonpanoError as error:
        if debug:
            traceback.print_exc()
        raise typer.Exit(_told(error)) from error
    except KeyboardInterrupt as error:
        typer.echo("\ninterrupted; nothing half-written is left under a final name", err=True)
        raise typer.Exit(INTERRUPTED) from error


def _told(error: PhotonpanoError) -> int:
    """Print an error, every problem of a spec on a line of its own, and return its exit code."""
    if not isinstance(error, SpecError):
        typer.echo(f"error: {error}", err=True)
        return FAILED
    for problem in error.problems:
        typer.echo(problem, err=True)
    count = len(error.problems)
    typer.echo(f"error: the spec has {count} problem{'' if count == 1 else 's'}", err=True)
    return WRONG_SPEC


def warn(message: str) -> None:
    """Print a warning."""
    typer.echo(f"warning: {message}", err=True)
