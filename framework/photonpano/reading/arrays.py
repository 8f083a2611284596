"""Read arrays and pictures from files, without pickle, and refuse others with a sentence."""

from __future__ import annotations

from collections.abc import Container
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonpano.errors import InputError
from photonpano.reading.files import reading


def read_arrays(path: Path, expected: str, names: Container[str] | None = None) -> dict[str, NDArray[Any]]:
    """Read the arrays of an .npz archive by their names, or the array of a .npy file under the name "".

    Args:
        path: the file.
        expected: what it should be, for the message, such as "a file of dark counts".
        names: of an archive, only arrays of these names are read; by default all.

    Raises:
        InputError: the file is missing, is damaged, or holds something else.
    """
    with reading(path, f"is not {expected}: it is no .npy or .npz file of plain numbers"), path.open("rb") as file:
        content = np.load(file, allow_pickle=False)
        if isinstance(content, np.ndarray):
            return {"": content}
        with content:
            return {name: _array_in(content, name, path) for name in content.files if names is None or name in names}


def read_array(path: Path, expected: str, name: str = "") -> NDArray[Any]:
    """Read the array of a .npy file or, where `name` is given, this array of an .npz archive.

    Raises:
        InputError: see `read_arrays`; or the file is an archive without such an array.
    """
    arrays = read_arrays(path, expected, (name,))
    if not arrays:
        raise InputError(f"{path} is an archive" + (f" without an array {name!r}" if name else "; name a .npy file"))
    (array,) = arrays.values()
    return array


def read_picture(path: Path, otherwise: str, flags: int) -> NDArray[Any]:
    """Decode a picture with OpenCV: (H, W) or, with blue first, (H, W, 3).

    Args:
        path: the file.
        otherwise: follows the path in the message for a file that cannot be decoded.
        flags: of `cv2.imdecode`.

    Raises:
        InputError: the file is missing, or is no picture.
    """
    import cv2

    with reading(path, otherwise):
        picture = cv2.imdecode(np.fromfile(path, np.uint8), flags)
    if picture is None:
        raise InputError(f"{path} {otherwise}")
    return picture


def _array_in(archive: Any, name: str, path: Path) -> NDArray[Any]:
    with reading(path, f"is damaged: {name} cannot be read as an array of plain numbers; write it again"):
        return np.asarray(archive[name])
