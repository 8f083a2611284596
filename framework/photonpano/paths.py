"""Paths that users give: what cannot be one, and what must not be opened."""

from __future__ import annotations

import os
import stat
from pathlib import Path

_KINDS = (
    (stat.S_ISFIFO, "a named pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def given_path(path: Path) -> Path:
    """Return a path that a user has written, with its home folder filled in.

    Raises:
        ValueError: it begins with the home folder of nobody.
    """
    try:
        return path.expanduser()
    except RuntimeError as error:
        raise ValueError(f"{path} begins with the home folder of an unknown user; write the whole path") from error


def refusal(path: Path) -> str | None:
    """Return why a path must not be opened, None for a regular file, a folder, and nothing at all.

    Reading a named pipe or a device may wait for ever, or never end. Nothing is opened to find out.
    """
    try:
        mode = os.stat(path).st_mode  # noqa: PTH116 - as cheap as possible: readers ask before each piece
    except OSError:  # whoever opens it says more
        return None
    except ValueError:
        return f"{str(path)!r} contains the character NUL, which no path can; correct the path"
    if stat.S_ISREG(mode) or stat.S_ISDIR(mode):
        return None
    kind = next((name for is_kind, name in _KINDS if is_kind(mode)), "something else")
    return f"{path} is {kind}, not a regular file; copy what it holds to a file, and name that"
