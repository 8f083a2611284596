"""Standard streams that are closed, and libraries that print on them."""

from __future__ import annotations

import logging
import os
import sys


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
