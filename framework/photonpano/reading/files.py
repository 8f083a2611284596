"""Files of a capture: which there are, and pieces of them read by any number of threads."""

from __future__ import annotations

import os
import re
from functools import lru_cache
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError

from photonpano.errors import InputError

Model = TypeVar("Model", bound=BaseModel)

_MOST_OPEN = 16
"""Files that are kept open; a capture may consist of hundreds, and a process is often allowed 1024."""

_TEXT_AND_NUMBER = re.compile("([^0-9]*)([0-9]*)")


def files_in(path: Path, suffix: str) -> list[Path]:
    """Return the files of a capture: the file itself, or those of a folder, nested ones too, in natural order (0, 2, 10).

    Hidden files are left out.

    Args:
        path: a file, whatever its name, or a folder.
        suffix: how the names of files in a folder end, such as ".bin"; capital letters do as well.

    Raises:
        InputError: there is no such file or folder, or no such file in the folder.
    """
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise InputError(f"there is no file or folder {path}; check the path")
    found = [
        file.relative_to(path)
        for file in path.rglob("*")
        if file.suffix.lower() == suffix and not file.name.startswith(".") and file.is_file()
    ]
    if not found:
        raise InputError(f"there is no {suffix} file in the folder {path}; check the path")
    return [path / file for file in sorted(found, key=_natural)]


def _natural(path: Path) -> list[tuple[list[tuple[str, int]], str]]:
    """Compare numbers as numbers, so that 10 comes after 2."""
    return [([(text, int(digits or 0)) for text, digits in _TEXT_AND_NUMBER.findall(part)], part) for part in path.parts]


def read_json(path: Path, model: type[Model]) -> Model:
    """Return what a JSON file says.

    Raises:
        InputError: it is missing, or does not fit the model.
    """
    try:
        return model.model_validate_json(path.read_bytes())
    except FileNotFoundError as error:
        raise InputError(f"there is no file {path}; check the path") from error
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from error
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise InputError(f"{path} is wrong{where and f' at {where}'}: {first['msg']}; write it again") from error


def read_start(path: Path, n_bytes: int) -> bytes:
    """Return the first bytes of a file; none where it cannot be read."""
    try:
        with path.open("rb") as file:
            return file.read(n_bytes)
    except OSError:
        return b""


class OpenFiles:
    """Reads pieces of files from any thread. A file is opened when it is first read, and few are kept open."""

    def __init__(self) -> None:
        self._opened = lru_cache(_MOST_OPEN)(_OpenFile)

    def read(self, path: Path, position: int, target: NDArray[np.uint8]) -> None:
        """Fill a contiguous array with what a file holds from a position on.

        Raises:
            InputError: it cannot be read, or has become shorter.
        """
        try:
            file = self._opened(path)
            left = target.reshape(-1).data
            while left:
                done = os.preadv(file.descriptor, [left], position)
                if not done:
                    raise InputError(f"{path} has become shorter while it was read; copy or record it again")
                left, position = left[done:], position + done
        except OSError as error:
            raise InputError(f"cannot read {path}: {error.strerror}") from error

    def close(self) -> None:
        """Let go of the files."""
        self._opened.cache_clear()


class _OpenFile:
    """A file that is closed when nobody holds it: neither the few that are kept, nor a thread that reads it."""

    def __init__(self, path: Path) -> None:
        self.descriptor = os.open(path, os.O_RDONLY)

    def __del__(self) -> None:
        if hasattr(self, "descriptor"):
            os.close(self.descriptor)
