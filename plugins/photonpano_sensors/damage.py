"""What libraries raise for damaged files, as errors for users."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from photonpano import InputError


@contextmanager
def reading(path: Path, what: str) -> Iterator[None]:
    """Turn whatever a library raises within the block into an `InputError`: for a damaged file, it may be nearly anything.

    Args:
        path: the file that is read.
        what: what it should be, such as "a MATLAB file".
    """
    try:
        yield
    except (InputError, MemoryError):
        raise
    except FileNotFoundError as error:
        raise InputError(f"there is no file {path}; check the path") from error
    except Exception as error:
        raise InputError(f"{path} cannot be read as {what}: it is damaged or something else; copy it again") from error
