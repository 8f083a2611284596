"""Sources `swissspad-half` and `swissspad-full`: the .bin files of SwissSPAD2."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from photonpano import Recognised
from photonpano.reading import FrameLayout, files_in
from photonpano_sensors.bin_files import BinConfig, bin_source, sizes_of

Pixels = TypeVar("Pixels", bound=np.generic)

_ZONES = 4
_FILE_BYTES = 512 * 256 * 64  # of 512 frames of the half array, or 256 of the full one
_COMPARED = 64  # frames of the full array, or pairs of frames of the half array, compared to tell them apart
_CLIP_QUANTILE = 0.9  # brightness is clipped at this quantile: hot pixels must not outweigh the scene
_STANDARD_ERRORS = 5.0  # minimum difference of the two correlations


class SwissSpadHalfConfig(BinConfig):
    """A capture of half of SwissSPAD2, 256 x 512 px."""


class SwissSpadFullConfig(BinConfig):
    """A capture of all of SwissSPAD2, 512 x 512 px."""


def _joined(images: NDArray[Pixels]) -> NDArray[Pixels]:
    """Join the zones of the full array: each holds a quarter of the columns of the top half, then of the bottom half.

    The bottom half is read out from the outside to the inside, as the top half is.
    """
    *lead, rows, columns = images.shape
    zones = images.reshape(*lead, rows, _ZONES, 2, columns // (2 * _ZONES))
    joined = np.empty((*lead, 2 * rows, columns // 2), images.dtype)
    halves = joined.reshape(*lead, 2, rows, _ZONES, columns // (2 * _ZONES))
    halves[..., 0, :, :, :] = zones[..., 0, :]
    halves[..., 1, :, :, :] = zones[..., ::-1, :, 1, :]
    return joined


HALF = FrameLayout((256, 512), (256, 64), "little")
FULL = FrameLayout((512, 512), (256, 128), "little", arranged=_joined)


def _recognise(path: Path, array: Literal["half", "full"]) -> Recognised | None:
    sizes = sizes_of(path)
    if not sizes or {*sizes[:-1], max(sizes)} != {_FILE_BYTES}:  # the last may be shorter
        return None
    try:
        found, because = _array_of(files_in(path, ".bin")[0])
    except OSError:
        return None
    if found is not None and found != array:
        return None
    return Recognised({"path": str(path)}, f"files of {_FILE_BYTES:,} bytes, {because}")


def _array_of(path: Path) -> tuple[Literal["half", "full"] | None, str]:
    """Decide which array a file is of, by the correlation of pixels, and give the reason.

    A frame of the full array has the size of two frames of the half array. In a file of the half array, the two halves of these
    bytes are the same pixels at nearly the same time, which correlate most. In a file of the full array they are 128 rows
    apart, and pixels two rows apart correlate more. (Not one row, because odd and even rows may differ systematically.)
    """
    frames = np.memmap(path, np.uint8, "r").reshape(-1, *FULL.stored_shape)[:: _FILE_BYTES // FULL.stored_bytes // _COMPARED]
    sums = np.unpackbits(frames, axis=-1, bitorder="little").sum(axis=0, dtype=np.float64)
    first, second = np.split(np.minimum(sums, np.quantile(sums, _CLIP_QUANTILE)), 2)
    halves, rows = (
        _correlation(first, second),
        _correlation(np.stack([first[:-2], second[:-2]]), np.stack([first[2:], second[2:]])),
    )
    numbers = f"correlations of {np.tanh(halves):.2f} between the halves of their frames, {np.tanh(rows):.2f} between rows"
    if abs(halves - rows) < _STANDARD_ERRORS * np.sqrt(2 / first.size):
        return None, f"which the half and the full array have; {numbers} do not decide it"
    return ("half", numbers) if halves > rows else ("full", numbers)


def _correlation(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Return the Fisher transform of the correlation, whose standard error is 1 / sqrt(pixels)."""
    if not first.std() or not second.std():
        return 0.0
    return float(np.arctanh(min(np.corrcoef(first.ravel(), second.ravel())[0, 1], 0.999999)))


SWISSSPAD_HALF = bin_source(
    "swissspad-half",
    "Binary frames of half of SwissSPAD2, 256 x 512 px, in .bin files of 512",
    SwissSpadHalfConfig,
    HALF,
    lambda path: _recognise(path, "half"),
)
SWISSSPAD_FULL = bin_source(
    "swissspad-full",
    "Binary frames of all of SwissSPAD2, 512 x 512 px, in .bin files of 256",
    SwissSpadFullConfig,
    FULL,
    lambda path: _recognise(path, "full"),
)
