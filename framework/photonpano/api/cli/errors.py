"""Report errors of commands, and signals that end them: a message on stderr, and an exit code."""

from __future__ import annotations

import errno
import logging
import os
import signal
import sys
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

import typer

from photonpano.api.cli.verbosity import SHOWN, log_shown
from photonpano.api.command import WrongArgumentError
from photonpano.errors import OutputError, PhotonpanoError, PluginError, SpecError

FAILED = 1
WRONG_SPEC = 2
SIGNALLED = 128  # plus the number of the signal: 130 for Ctrl-C
INTERRUPTED = "\ninterrupted; no file is left half-written under its final name"


_CALLBACKS = "llvmlite.binding.executionengine"  # what is raised in them is lost
_LATER_S = 0.01


class Signalled(KeyboardInterrupt):
    """SIGINT, SIGTERM or SIGHUP: they end a command, with exit codes of their own."""


def end_on_signals() -> None:
    """Have SIGTERM and SIGHUP end the program as Ctrl-C does, unless the caller ignores them, as `nohup` does SIGHUP."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _end)


def _end(number: int, frame: FrameType | None) -> None:
    """Raise `Signalled`; a moment later if LLVM, which loads compiled code, has called Python just now."""
    while frame is not None:
        if frame.f_globals.get("__name__") == _CALLBACKS:
            threading.Timer(_LATER_S, os.kill, (os.getpid(), number)).start()
            return
        frame = frame.f_back
    raise Signalled(number)


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
        if debug:
            traceback.print_exc()
        called = PluginError(f"a plugin or a library called sys.exit({error.code!r}) in the middle of the command")
        called.__cause__ = error
        raise typer.Exit(print_error(called, debug)) from error
    except KeyboardInterrupt as error:
        message = "; ".join([INTERRUPTED, *getattr(error, "__notes__", ())])
        typer.echo(message, err=True)
        log_shown(logging.ERROR, message.strip())
        number = error.args[0] if isinstance(error, Signalled) else signal.SIGINT
        raise typer.Exit(SIGNALLED + number) from error
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EFBIG) or error.filename is not None:
            raise
        # Files that cannot be written have errors of their own: this is standard output.
        # What is left in the buffer is dropped: it would fail once more when the interpreter ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        full = OutputError(f"cannot write to standard output: {error.strerror}")
        raise typer.Exit(print_error(full, debug)) from error
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


def prepare_streams() -> None:
    """Open nothing in place of standard streams that are closed, and silence libraries.

    A file that is opened later would take the number of a closed stream, and receive what is printed.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            nothing = os.open(os.devnull, os.O_RDWR)
            if nothing != number:
                os.dup2(nothing, number)
            setattr(sys, name, open(number, "w" if number else "r", encoding="utf-8"))  # noqa: PTH123, SIM115
    # Readers of pictures print what they find in damaged ones; our own error says it in a sentence.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    logging.getLogger("tifffile").addHandler(logging.NullHandler())
