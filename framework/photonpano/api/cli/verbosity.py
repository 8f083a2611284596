"""How much commands say beside their results: -v, -q and --log, before the name of a command or after it."""

from __future__ import annotations

import logging
import os
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from photonpano import __version__

logger = logging.getLogger("photonpano")
SHOWN = f"{__name__}.shown"  # logger of messages that are on the screen already, for the log file alone
_VERBOSE, _QUIET, _LOG = "verbose", "quiet", "log"
_chosen: set[str] = set()


def is_quiet() -> bool:
    """Return whether progress is not wanted."""
    return _QUIET in _chosen


def is_verbose() -> bool:
    """Return whether details are wanted."""
    return _VERBOSE in _chosen


def is_logged() -> bool:
    """Return whether anything below a warning is written anywhere."""
    return logger.isEnabledFor(logging.INFO)


def log_shown(level: int, message: str, error: BaseException | None = None) -> None:
    """Write what was printed to the log file, with the traceback of an error."""
    if is_logged():
        logging.getLogger(SHOWN).log(level, "%s", message, exc_info=error)


def with_verbosity(parameters: list[Any]) -> list[Any]:
    """Return the parameters of a command, with those of this module before `--help`."""
    return [*parameters[:-1], *PARAMETERS, *parameters[-1:]]


@contextmanager
def verbosity_of(ctx: Any) -> Iterator[None]:
    """Say as much as the options want, until the command ends; `typer.BadParameter` if they are wrong."""
    wanted: dict[str, Any] = ctx.meta.get(__name__, {})
    if {_VERBOSE, _QUIET} <= wanted.keys():
        raise typer.BadParameter("give one of them", param_hint="'-v' and '-q'")
    handlers: list[logging.Handler] = [_Details(logging.INFO)] if _VERBOSE in wanted else []
    if path := wanted.get(_LOG):
        try:
            handlers.append(_LogFile(path))
        except OSError as error:
            raise typer.BadParameter(f"cannot write {path}: {error.strerror}", param_hint="'--log'") from error
    level = logger.level
    if handlers:
        logger.setLevel(min(each.level for each in handlers))
    for each in handlers:
        logger.addHandler(each)
    _chosen.update(wanted)
    try:
        log_shown(logging.INFO, f"photonpano {__version__}, process {os.getpid()}, in {Path.cwd()}")
        yield
    finally:
        _chosen.difference_update(wanted)
        logger.setLevel(level)
        for each in handlers:
            logger.removeHandler(each)
            each.close()


def _keep(ctx: typer.Context, parameter: typer.CallbackParam, value: bool | Path | None) -> None:
    """Keep the value of an option for `verbosity_of`; a group and its commands share `meta`."""
    if value:
        ctx.meta.setdefault(__name__, {})[parameter.name] = value


class _Details(logging.Handler):
    """Prints what is less than a warning on standard error."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print a line."""
        if record.levelno < logging.WARNING and record.name != SHOWN:
            sys.stderr.write(f"{record.getMessage()}\n")


class _LogFile(logging.FileHandler):
    """Appends lines to a file, each with its time. A disk that is full ends the file, not the command."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, encoding="utf-8", errors="backslashreplace")
        self.setLevel(logging.DEBUG)
        self.setFormatter(logging.Formatter("%(asctime)s %(levelname)-7s %(message)s"))
        self._failed = False

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record, unless one could not be written before."""
        if not self._failed:
            super().emit(record)

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802
        """Say once that the log has ended."""
        del record
        self._failed = True
        reason = traceback.format_exception_only(sys.exc_info()[1])[-1].strip()
        sys.stderr.write(f"warning: the log {self.baseFilename} ends here: {reason}\n")

    def close(self) -> None:
        """Close the file; what a full disk did not take is lost."""
        try:
            super().close()
        except OSError:
            self._failed = True


_MORE = (
    "Say more on standard error: each decision with its reason; without a terminal, each stage with its time; and at the end a "
    "table of what the stages took."
)
_TO_FILE = "Append stages, decisions, warnings and errors to a file, each with its time."
_option = partial(typer.Option, callback=_keep, expose_value=False)


def _options(
    verbose: Annotated[bool, _option("--verbose", "-v", help=_MORE)] = False,
    quiet: Annotated[bool, _option("--quiet", "-q", help="Say only results, warnings and errors.")] = False,
    log: Annotated[Path | None, _option("--log", metavar="FILE", help=_TO_FILE, show_default=False)] = None,
) -> None:
    """Carry the options."""


_carrier = typer.Typer(add_completion=False)
_carrier.command()(_options)
PARAMETERS: list[Any] = typer.main.get_command(_carrier).params
