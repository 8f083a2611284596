"""Arrays and pictures that corrections name: read without pickle, refused with a sentence."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from photonpano.errors import InputError

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray


def read_arrays(path: Path, expected: str) -> dict[str, NDArray[Any]]:
    """Read the arrays of an .npz archive by their names, or that of a .npy file under the name "".

    Args:
        path: the file.
        expected: what it should be, for the message.

    Raises:
        InputError: it is missing, or something else.
    """
    try:
        content = np.load(path, allow_pickle=False)
        if isinstance(content, np.ndarray):
            return {"": content}
        with content:
            return dict(content)
    except OSError as error:
        raise _unread(path, error) from error
    except Exception as error:  # a damaged file makes numpy's and zipfile's parsers raise nearly anything
        raise InputError(f"{path} is not {expected}: it is no .npy or .npz file of plain numbers") from error


def read_picture(path: Path, expected: str) -> NDArray[np.uint8]:
    """Read a picture: (H, W, 3) uint8, red first.

    Args:
        path: the file.
        expected: what it should be, for the message.

    Raises:
        InputError: it is missing, or no picture of 8 bits.
    """
    import cv2

    try:
        data = np.fromfile(path, np.uint8)
    except OSError as error:
        raise _unread(path, error) from error
    try:
        picture = cv2.imdecode(data, cv2.IMREAD_COLOR)
    except cv2.error:  # an empty file
        picture = None
    if picture is None:
        raise InputError(f"{path} is not {expected}: it is no picture that can be read")
    return np.ascontiguousarray(picture[..., ::-1], dtype=np.uint8)


def is_picture(path: Path) -> bool:
    """Tell by its name whether a file is a picture."""
    return path.suffix.lower() == ".png"


def _unread(path: Path, error: OSError) -> InputError:
    if isinstance(error, FileNotFoundError):
        return InputError(f"there is no file {path}; check the path")
    return InputError(f"cannot read {path}: {error.strerror}")
