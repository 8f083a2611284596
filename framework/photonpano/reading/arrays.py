"""Read arrays, pictures and colour filter arrays from files, without pickle, and refuse others with a sentence."""

from __future__ import annotations

from collections.abc import Container
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonpano.errors import InputError
from photonpano.reading.files import reading
from photonpano.values import Bayer

COLOURS = {"red": (255, 0, 0), "green": (0, 255, 0), "blue": (0, 0, 255), "clear": (255, 255, 255)}
_LETTERS = "rgb"
_WHAT = "the pattern of a colour filter"


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
        arrays = {}
        with content:
            for name in content.files:
                if names is None or name in names:
                    with reading(path, f"is damaged: {name} cannot be read as an array of plain numbers; write it again"):
                        arrays[name] = np.asarray(content[name])
        return arrays


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


def bayer_array(order: Bayer, shape: tuple[int, int]) -> NDArray[np.int8]:
    """Return the place in `COLOURS` of the colour that each pixel behind a Bayer array sees: (H, W)."""
    tile = np.array([_LETTERS.index(letter) for letter in order], np.int8).reshape(2, 2)
    return np.tile(tile, (-(-shape[0] // 2), -(-shape[1] // 2)))[: shape[0], : shape[1]]


def read_filter_array(path: Path) -> NDArray[np.int8]:
    """Read the place in `COLOURS` of the colour that each pixel sees: (H, W).

    Args:
        path: a .png picture, or a .npy file (height, width, 3) of uint8 in the order red, green, blue; clear pixels are white,
            the others pure red, green or blue.

    Raises:
        InputError: the file is missing, holds something else, or has other colours.
    """
    if path.suffix.lower() == ".png":
        import cv2

        picture = read_picture(path, f"is not {_WHAT}: it is no picture that can be read", cv2.IMREAD_COLOR)
        pattern = np.ascontiguousarray(picture[..., ::-1], dtype=np.uint8)
    else:
        pattern = read_array(path, _WHAT)
        if pattern.dtype != np.uint8 or pattern.ndim != 3 or pattern.shape[2] != 3:
            found = f"{pattern.dtype} values of shape {pattern.shape}"
            raise InputError(f"{path} holds {found}; a pattern is a .npy file of uint8 (height, width, 3)")
    places = np.full(pattern.shape[:2], -1, np.int8)
    for place, colour in enumerate(COLOURS.values()):
        places[np.all(pattern == colour, axis=-1)] = place
    if (places < 0).any():
        row, column = np.argwhere(places < 0)[0].tolist()
        raise InputError(
            f"{path} has the colour {tuple(pattern[row, column].tolist())} at row {row}, column {column}; a "
            "pattern has white for clear pixels, and pure red, green and blue"
        )
    return places
