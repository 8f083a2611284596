"""Report errors of commands: a message on stderr, and an exit code."""

import logging
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager

import typer

from photonpano.api.cli.verbosity import SHOWN, log_shown
from photonpano.api.command import WrongArgumentError
from photonpano.errors import PhotonpanoError, PluginError, SpecError
from photonpano.execution.interrupts import interrupted_by

FAILED = 1
WRONG_SPEC = 2
SIGNALLED = 128  # plus the number of the signal: 130 for Ctrl-C
INTERRUPTED = "\ninterrupted; no file is left half-written under its final name"


@contextmanager
def reported(*, debug: bool = False) -> Iterator[None]:
    """Report the errors of a command as `typer.Exit`; others than `PhotonpanoError` are defects and keep their traceback.

    Logged warnings, such as the exception of a plugin that watches runs, are printed. With `debug`, reported errors and
    warnings show their traceback as well.
    """
    logger, handler = logging.getLogger("photonpano"), _Warnings(debug)
    logger.addHandler(handler)
    try:
        yield
        sys.stdout.flush()  # raises on a closed pipe, which typer ends without a message
    except PhotonpanoError as error:
        if debug:
            traceback.print_exc()
        raise typer.Exit(print_error(error, debug)) from error
    except SystemExit as error:  # a command ends with typer.Exit
        what = f"a plugin or a library called sys.exit({error.code!r}) in the middle of the command"
        raise typer.Exit(print_error(PluginError(what), debug)) from error
    except KeyboardInterrupt as error:
        typer.echo(INTERRUPTED, err=True)
        log_shown(logging.ERROR, INTERRUPTED.strip())
        raise typer.Exit(SIGNALLED + interrupted_by()) from error
    except Exception as error:
        if not isinstance(error, typer.Exit | typer.BadParameter):
            log_shown(logging.ERROR, "a defect of photonpano or of a plugin", error)
        raise
    finally:
        logger.removeHandler(handler)


class _Warnings(logging.Handler):
    """Prints logged warnings."""

    def __init__(self, debug: bool) -> None:
        super().__init__(logging.WARNING)
        self._debug = debug

    def emit(self, record: logging.LogRecord) -> None:
        if record.name == SHOWN:
            return
        if self._debug and record.exc_info:
            traceback.print_exception(record.exc_info[1])
        # Not with typer.echo, which bypasses the progress bars.
        sys.stderr.write(f"warning: {record.getMessage()}\n")


def print_error(error: PhotonpanoError, debug: bool = False) -> int:
    """Print an error, each problem of a spec on its own line, and return the exit code."""
    log_shown(logging.ERROR, str(error), error if isinstance(error, PluginError) else None)
    if not isinstance(error, SpecError):
        typer.echo(f"error: {error}", err=True)
        if error.report is not None:
            typer.echo(f"report    {error.report}", err=True)
        if isinstance(error, PluginError) and error.__cause__ and not debug:
            typer.echo("for the traceback: photonpano --debug ...", err=True)
        return WRONG_SPEC if isinstance(error, WrongArgumentError) else FAILED
    for problem in error.problems:
        typer.echo(problem, err=True)
    count = len(error.problems)
    typer.echo(f"error: the spec has {count} problem{'' if count == 1 else 's'}", err=True)
    return WRONG_SPEC
