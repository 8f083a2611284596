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

    from numpy.typing import NDArray

    from photonpano.corrections.pixels import Decide, Pixels
    from photonpano.protocols import Source
    from photonpano.values import BoolArray


class Mask(Correction):
    """Masks the pixels that a file marks as bad; the motion fills them."""

    name: ClassVar[str] = "mask"
    file: SpecPath = Field(
        description="a bool .npy file, true for bad pixels, or a .png picture in which bad pixels are not black; of "
        "the size of the frames at this place of the list"
    )

    def applied(self, pixels: Pixels, source: Source, decide: Decide | None) -> Pixels:
        """Mask the bad pixels; see `Correction`."""
        del source, decide
        bad = _read_mask(self.file)
        pixels.require(bad.shape, self.file)
        return pixels.without(bad)


def _read_mask(path: Path) -> BoolArray:
    expected = "a mask of bad pixels"
    if _is_picture(path):
        return np.asarray(_read_picture(path, expected).any(axis=-1))
    mask = read_array(path, expected)
    if mask.dtype != np.bool_:
        raise InputError(
            f"{path} holds {mask.dtype} values; a mask is a .npy file of bool, true for pixels that must not be used"
        )
    return mask


def _is_picture(path: Path) -> bool:
    return path.suffix.lower() == ".png"


def _read_picture(path: Path, expected: str) -> NDArray[np.uint8]:
    """Read a picture: (H, W, 3) uint8, red first."""
    import cv2

    look_first(path, "cv2:imread")
    picture = read_picture(path, f"is not {expected}: it is no picture that can be read", cv2.IMREAD_COLOR)
    return np.ascontiguousarray(picture[..., ::-1], dtype=np.uint8)
