"""Captures in .bin files, packed frames without a header: sources `swissspad-half`, `swissspad-full` and `spad512`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from photonpano import Arrived, Config, InputError, Location, Recognised, SourceContribution, SpecLocation, Url
from photonpano.reading import FrameFile, FrameLayout, PackedFileSource, files_in, objections, size_of

Pixels = TypeVar("Pixels", bound=np.generic)

_ZONES = 4
_FILE_BYTES = 512 * 256 * 64  # of 512 frames of the half array, or 256 of the full one
_COMPARED = 64  # frames of the full array, or pairs of frames of the half array, compared to tell them apart
_CLIP_QUANTILE = 0.9  # brightness is clipped at this quantile: hot pixels must not outweigh the scene
_STANDARD_ERRORS = 5.0  # minimum difference of the two correlations
_SPAD512 = FrameLayout((512, 512), (512, 64))
_FOOTER_BYTES = 4
# Sizes by which a file is recognised. 256 frames without a footer have the size of files of SwissSPAD2.
_SPAD512_FILES = {
    1000 * _SPAD512.stored_bytes: "1000 frames",
    256 * _SPAD512.stored_bytes + _FOOTER_BYTES: "256 frames and a footer",
}


class BinConfig(Config):
    """A capture in .bin files."""

    path: SpecLocation = Field(
        description="a .bin file, or a folder of them, or the URL of either; nested or not, in natural order (0, 2, 10)"
    )
    frame_rate_hz: float | None = Field(None, gt=0, description="frames a second, in Hz; leave it out if unknown")


def bin_source(
    name: str,
    summary: str,
    config: type[BinConfig],
    layout: FrameLayout,
    recognise: Callable[[Path], Recognised | None],
    footer_bytes: int = 0,
) -> SourceContribution:
    """Return the contribution of a source of .bin files; `footer_bytes` may follow the frames of a file."""

    def opened(config: BinConfig) -> PackedFileSource:
        return PackedFileSource(frame_files(config.path, layout, footer_bytes), layout, config.frame_rate_hz)

    def arrived(config: BinConfig) -> Arrived:
        """Open the frames that are there of a capture that is still being written: files appear, and the last one grows."""
        path = config.path
        if isinstance(path, Url):
            raise InputError(f"{path} is a URL, which cannot be followed: follow a folder, or a pipe")
        if not path.exists() or (path.is_dir() and not sizes_of(path)):
            return Arrived(None)
        files = frame_files(path, layout, footer_bytes, growing=True)
        return Arrived(PackedFileSource(files, layout, config.frame_rate_hz) if files else None)

    return SourceContribution(
        name=name,
        summary=summary,
        config=config,
        build=lambda config, _: opened(config),
        check=lambda config: objections(frame_files, config.path, layout, footer_bytes),
        recognise=recognise,
        arrived=arrived,
        suffixes=(".bin",),
    )


def frame_files(path: Location, layout: FrameLayout, footer_bytes: int = 0, *, growing: bool = False) -> list[FrameFile]:
    """Return the files of a capture with the number of frames that follows from their sizes.

    If it is `growing`, the last file counts with its whole frames. Raises an `InputError` if there is no file, a size is not a
    whole number of frames, or a file is larger than the first, or smaller and not the last: frames are missing, or the order is
    wrong.
    """
    files = files_in(path, ".bin")
    sizes = [size_of(file) for file in files]
    found = []
    for file, size in zip(files, sizes, strict=True):
        n_frames, rest = divmod(size, layout.stored_bytes)
        if growing and file is files[-1]:
            found += [FrameFile(file, n_frames)] if n_frames else []
            continue
        if not n_frames or rest not in (0, footer_bytes):
            allowed = f", with or without {footer_bytes} more" if footer_bytes else ""
            raise InputError(
                f"{file} has {size:,} bytes, which is not a whole number of frames of {layout.stored_bytes:,} bytes{allowed}; "
                "it is cut short, or of another camera: copy it again, or choose another source"
            )
        found.append(FrameFile(file, n_frames))
    for each in found[1:]:
        if each.n_frames > found[0].n_frames or (each.n_frames < found[0].n_frames and each is not found[-1]):
            raise InputError(
                f"{each.path} holds {each.n_frames:,} frames and {found[0].path.name}, the first, {found[0].n_frames:,}; only "
                "the last file of a capture may hold fewer: copy it again, or take out the files of other captures"
            )
    return found


def sizes_of(path: Location) -> list[int]:
    """Return the sizes in bytes of the .bin files at a path, in order; an empty list if there are none."""
    try:
        files = files_in(path, ".bin")
        return [size_of(file) for file in files if file.suffix.lower() == ".bin"]
    except (InputError, OSError):
        return []


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


def _recognise_swissspad(path: Path, array: Literal["half", "full"]) -> Recognised | None:
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
        correlation(first, second),
        correlation(np.stack([first[:-2], second[:-2]]), np.stack([first[2:], second[2:]])),
    )
    numbers = f"correlations of {np.tanh(halves):.2f} between the halves of their frames, {np.tanh(rows):.2f} between rows"
    if abs(halves - rows) < _STANDARD_ERRORS * np.sqrt(2 / first.size):
        return None, f"which the half and the full array have; {numbers} do not decide it"
    return ("half", numbers) if halves > rows else ("full", numbers)


def correlation(first: NDArray[Any], second: NDArray[Any]) -> float:
    """Return the Fisher transform of the correlation, whose standard error is 1 / sqrt(pixels); 0 if one does not vary."""
    if not first.size or not first.std() or not second.std():
        return 0.0
    return float(np.arctanh(min(np.corrcoef(first.ravel(), second.ravel())[0, 1], 0.999999)))


SWISSSPAD_HALF = bin_source(
    "swissspad-half",
    "Binary frames of half of SwissSPAD2, 256 x 512 px, in .bin files of 512",
    SwissSpadHalfConfig,
    HALF,
    lambda path: _recognise_swissspad(path, "half"),
)
SWISSSPAD_FULL = bin_source(
    "swissspad-full",
    "Binary frames of all of SwissSPAD2, 512 x 512 px, in .bin files of 256",
    SwissSpadFullConfig,
    FULL,
    lambda path: _recognise_swissspad(path, "full"),
)


class Spad512Config(BinConfig):
    """A capture of the SPAD512, 512 x 512 px."""


def _recognise_spad512(path: Path) -> Recognised | None:
    sizes = sizes_of(path)
    if not sizes or sizes[0] not in _SPAD512_FILES or objections(frame_files, path, _SPAD512, _FOOTER_BYTES):
        return None
    return Recognised({"path": str(path)}, f"{sizes[0]:,} bytes a file, which are {_SPAD512_FILES[sizes[0]]} of 512 x 512 px")


SPAD512 = bin_source(
    "spad512",
    "Binary frames of the SPAD512, 512 x 512 px, in .bin files of 1000, or of 256 with a footer",
    Spad512Config,
    _SPAD512,
    _recognise_spad512,
    _FOOTER_BYTES,
)
