"""Standard output and standard error that are closed or full: no reason for a traceback."""

from __future__ import annotations

import errno
import io
import logging
import os
import sys
from typing import NoReturn

from photonpano.errors import OutputError


def prepare_streams() -> None:
    """Open nothing in place of standard streams that are closed, make a full disk an `OutputError`, and silence libraries.

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
    if isinstance(sys.stdout, io.TextIOWrapper):
        encoding, errors, by_line = sys.stdout.encoding, sys.stdout.errors, sys.stdout.line_buffering
        sys.stdout = _Output(sys.stdout.detach(), encoding, errors, line_buffering=by_line)


class _Output(io.TextIOWrapper):
    """Standard output, whose errors have a sentence. A closed pipe stays one: it ends a command without a message."""

    def write(self, text: str) -> int:
        try:
            return super().write(text)
        except OSError as error:
            self._refuse(error)

    def flush(self) -> None:
        try:
            super().flush()
        except OSError as error:
            self._refuse(error)

    def _refuse(self, error: OSError) -> NoReturn:
        # What is left in buffers is dropped: it would fail once more when the interpreter ends.
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, 1)
        os.close(nothing)
        if error.errno == errno.EPIPE:
            raise error
        raise OutputError(f"cannot write to standard output: {error.strerror}") from error
