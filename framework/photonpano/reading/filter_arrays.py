"""Colour filter arrays: which colour each pixel sees, by the name of a Bayer array or by a file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photonpano.errors import InputError
from photonpano.reading.arrays import read_array, read_picture
from photonpano.reading.first_look import look_first
from photonpano.values import Bayer

# red, green and blue of each colour in a pattern
COLOURS = {"red": (255, 0, 0), "green": (0, 255, 0), "blue": (0, 0, 255), "clear": (255, 255, 255)}
_LETTERS = "rgb"
_WHAT = "the pattern of a colour filter"


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
    pattern = _read_picture(path) if path.suffix.lower() == ".png" else _read_colours(path)
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


def _read_colours(path: Path) -> NDArray[np.uint8]:
    pattern = read_array(path, _WHAT)
    if pattern.dtype != np.uint8 or pattern.ndim != 3 or pattern.shape[2] != 3:
        found = f"{pattern.dtype} values of shape {pattern.shape}"
        raise InputError(f"{path} holds {found}; a pattern is a .npy file of uint8 (height, width, 3)")
    return pattern


def _read_picture(path: Path) -> NDArray[np.uint8]:
    """Read a picture: (H, W, 3) uint8, red first."""
    import cv2

    look_first(path, "cv2:imread")
    picture = read_picture(path, f"is not {_WHAT}: it is no picture that can be read", cv2.IMREAD_COLOR)
    return np.ascontiguousarray(picture[..., ::-1], dtype=np.uint8)
