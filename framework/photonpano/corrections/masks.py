"""Mask pixels that a file marks as bad."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np
from pydantic import Field

from photonpano.contributions import SpecPath
from photonpano.corrections.pixels import Correction
from photonpano.errors import InputError
from photonpano.reading import look_first, read_array, read_picture

if TYPE_CHECKING:
    from pathlib import Path

    from photonpano.capture import Capture
    from photonpano.corrections.pixels import Decide, Pixels
    from photonpano.values import BoolArray


class Mask(Correction):
    """Masks the pixels that a file marks as bad; the motion fills them."""

    name: ClassVar[str] = "mask"
    file: SpecPath = Field(
        description="a bool .npy file, true for bad pixels, or a .png picture in which bad pixels are not black; of "
        "the size of the frames at this place of the list"
    )

    def applied(self, pixels: Pixels, capture: Capture, decide: Decide | None) -> Pixels:
        """Mask the bad pixels; see `Correction`."""
        del capture, decide
        bad = _read_mask(self.file)
        pixels.require(bad.shape, self.file)
        return pixels.without(bad)


def _read_mask(path: Path) -> BoolArray:
    expected = "a mask of bad pixels"
    if path.suffix.lower() == ".png":
        return _read_picture(path, f"is not {expected}: it is no picture that can be read")
    mask = read_array(path, expected)
    if mask.dtype != np.bool_:
        raise InputError(
            f"{path} holds {mask.dtype} values; a mask is a .npy file of bool, true for pixels that must not be used"
        )
    return mask


def _read_picture(path: Path, otherwise: str) -> BoolArray:
    """Return which pixels of a picture of 8 or 16 bits are not black: (H, W)."""
    import cv2

    look_first(path, "cv2:imread")
    return np.asarray(read_picture(path, otherwise, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH).any(axis=-1))
