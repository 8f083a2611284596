"""Sources of HDF5 and MATLAB files: `ubicept-h5`, with one dataset a frame, and `mat-parts`, with many frames in each file."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from functools import lru_cache, partial
from itertools import accumulate, pairwise
from pathlib import Path
from threading import Lock
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from photonpano import Bayer, Config, FrameSpan, InputError, Recognised, Requirement, SourceContribution, SpecPath, StreamInfo
from photonpano.photometry import BinarySumResponse
from photonpano.reading import (
    BinarySource,
    FrameAxis,
    FrameLayout,
    SingleFrameSource,
    frame_array,
    missing_file,
    objections,
    read_json,
    read_start,
    reading,
    require_readable,
)

_SUFFIX = ".ubi.h5"
_HDF = b"\x89HDF\r\n\x1a\n"
_DAMAGED_UBI = "cannot be read as a .ubi.h5 file: it is damaged or something else; copy it again"
_VARIABLE = "OUTPUT"


class UbiceptConfig(Config):
    """A capture in one file, whose frames are sums of binary frames."""

    path: SpecPath = Field(description="the .ubi.h5 file")
    binary_frames: int | None = Field(
        None, ge=1, le=65535, description="number of binary frames in each sum; by default from the file"
    )
    frame_rate_hz: float | None = Field(
        None, gt=0, description="frames (sums) a second, in Hz; by default from the file, if known"
    )


class UbiceptSource(SingleFrameSource):
    """Sums of binary frames. The HDF5 library reads one at a time, whatever the number of threads."""

    def __init__(self, config: UbiceptConfig) -> None:
        import h5py

        self._path = config.path
        with reading(self._path, _DAMAGED_UBI):
            self._file = h5py.File(self._path)
        try:
            with reading(self._path, _DAMAGED_UBI):
                self._describe(config)
        except BaseException:
            self._file.close()
            raise

    def _describe(self, config: UbiceptConfig) -> None:
        # That of the first dataset whose name is a number.
        self._group: Any = self._file.visititems(lambda name, item: item.parent if _is_frame(name, item) else None)
        if self._group is None:
            raise InputError(
                f"{self._path} has no group of frames, that is, datasets with numbers as names; choose another source"
            )
        self._names = sorted((name for name in self._group if _is_number(name)), key=int)
        first = self._group[self._names[0]]
        if first.ndim < 2 or min(first.shape[:2]) < 1 or any(size != 1 for size in first.shape[2:]):
            raise InputError(
                f"{self._path} holds frames of shape {first.shape}; they are (height, width) or (height, width, 1, 1)"
            )
        if first.dtype not in (np.uint8, np.uint16):
            raise InputError(f"{self._path} holds {first.dtype} values; sums of binary frames are uint8 or uint16")
        metadata = json.loads(first.attrs.get("metadata", "{}"))
        binary_frames = config.binary_frames or _binary_frames(metadata)
        if binary_frames is None:
            raise InputError(f"{self._path} does not contain the number of binary frames of each sum; set binary_frames")
        height, width = first.shape[:2]
        self._dtype = first.dtype
        self.info = StreamInfo(
            n_frames=len(self._names),
            height=int(height),
            width=int(width),
            frame_rate_hz=config.frame_rate_hz or _frame_rate_hz(metadata, binary_frames),
            kind="intensity",
            bit_depth=binary_frames.bit_length(),
            bayer=_bayer(metadata),
        )
        self.response = BinarySumResponse(binary_frames)
        self.valid = np.ones(self.info.frame_shape, np.bool_)

    def frame(self, index: int) -> NDArray[Any]:
        """Return a frame: (H, W), the sum of binary frames."""
        name = self._names[index]
        with reading(self._path, _DAMAGED_UBI):
            values: NDArray[Any] = self._group[name][()].reshape(self.info.frame_shape)
        if values.dtype != self._dtype or values.max() > self.response.n:
            raise InputError(
                f"{self._path} holds {values.dtype} values up to {values.max()} in frame {name}, which cannot be the sum of "
                f"{self.response.n} binary frames, as {self._dtype}; correct binary_frames, or copy the file again"
            )
        return values

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _is_number(name: str) -> bool:
    return name.isascii() and name.isdigit()


def _is_frame(name: str, item: object) -> bool:
    import h5py

    return isinstance(item, h5py.Dataset) and _is_number(name.rpartition("/")[2])


def _binary_frames(metadata: dict[str, Any]) -> int | None:
    """Return the number of binary frames of a sum, from the metadata of a frame; None if unknown."""
    key = "num_integrated_binary_frames"
    number = metadata.get("polycam_metadata", {}).get(key, metadata.get(key))
    return int(number) if number is not None and 1 <= int(number) <= 65535 else None


def _frame_rate_hz(metadata: dict[str, Any], binary_frames: int) -> float | None:
    """Return the rate of the sums, from the rate of the binary frames in the metadata; None if unknown."""
    for node in metadata.get("node_history", [])[:1]:
        rate = node.get("schedule", {}).get("base_schedule", {}).get("binary_frame_rate_fps")
        if rate is not None and 0 < float(rate) < float("inf"):
            return float(rate) / binary_frames
    return None


def _bayer(metadata: dict[str, Any]) -> Bayer | None:
    """Return the Bayer array before the pixels, from the metadata of a frame; None for a grey sensor and for other arrays."""
    key = "cfa_pattern"
    written = str(metadata.get("polycam_metadata", {}).get(key, metadata.get(key))).lower()
    known: tuple[Bayer, ...] = get_args(Bayer)
    return next((order for order in known if order == written), None)


def _check(config: UbiceptConfig) -> Sequence[str]:
    """Check for HDF5 by the first bytes; the content needs a library that may be missing."""
    if not config.path.is_file():
        return (missing_file(config.path),)
    if read_start(config.path, len(_HDF)) != _HDF:
        return (f"{config.path} is not an HDF5 file, by its first bytes; copy it again, or choose another source",)
    return ()


def _recognise(path: Path) -> Recognised | None:
    if not path.name.lower().endswith(_SUFFIX) or _check(UbiceptConfig(path=path)):
        return None
    return Recognised({"path": str(path)}, f"an HDF5 file whose name ends in {_SUFFIX}")


UBICEPT_H5 = SourceContribution(
    name="ubicept-h5",
    summary="Sums of binary frames in the .ubi.h5 files of Ubicept",
    config=UbiceptConfig,
    build=lambda config, _: UbiceptSource(config),
    check=_check,
    recognise=_recognise,
    suffixes=(".h5",),
    requires=(Requirement("h5py", "photonpano[hdf5]"),),
)


def _shape_of_frames(path: Path, frame_axis: FrameAxis) -> tuple[int, int, int]:
    """Return (frames, height, width) of a part, whose values are not read; raises an `InputError` if it has no frames."""
    with frame_array(path, _VARIABLE) as array:
        if len(array.stored.shape) != 3 or min(array.stored.shape) < 1:
            raise InputError(f"{path} has {_VARIABLE} of shape {array.stored.shape[::-1]}; frames are (height, width, frames)")
        n_frames, height, width = array.shape(frame_axis)
        return n_frames, height, width


def _packed_frames(path: Path, frame_axis: FrameAxis) -> NDArray[np.uint8]:
    """Return all frames, (n, H, ceil(W / 8)), packed along the width; raises an `InputError` if they are not binary."""
    with frame_array(path, _VARIABLE) as array:
        if array.stored.dtype.kind not in "biuf":
            raise InputError(f"{path} has {_VARIABLE} that is no array of real numbers; frames are (height, width, frames)")
        packed = []
        for _, values in array.blocks(frame_axis):
            lit = values == 1
            if not np.all(lit | (values == 0)):
                raise InputError(f"{path} holds values other than 0 and 1: its frames are not binary")
            packed.append(np.packbits(lit, axis=-1))
    return np.concatenate(packed)


_NAME = re.compile(r"part_([1-9][0-9]*)\.mat")
_INFO = "info.json"
_MOST_PARTS = 4  # packed parts kept in memory: compressed files can only be read from the beginning


class MatPartsConfig(Config):
    """A capture in a folder of MATLAB files."""

    path: SpecPath = Field(
        description=f"the folder of part_1.mat, part_2.mat and so on, each with frames of zeros and ones as OUTPUT (height, "
        f"width, frames); an optional {_INFO} with no_parts and no_frames must agree with them"
    )
    frame_axis: FrameAxis | None = Field(
        None,
        description="axis of the frames: last for (height, width, frames), first for (frames, height, width); by default last, "
        "and parts that show that it is the first are refused",
    )
    frame_rate_hz: float | None = Field(None, gt=0, description="frames a second, in Hz; leave it out if unknown")


class _Info(BaseModel):
    no_parts: int
    no_frames: int


class MatPartsSource(BinarySource):
    """Frames of MATLAB files. A part is read whole when one of its frames is read, and the last four parts are kept."""

    def __init__(self, config: MatPartsConfig) -> None:
        self._paths = _parts(config.path)
        axis = config.frame_axis or "last"
        shapes = [_shape_of_frames(path, axis) for path in self._paths]
        with frame_array(self._paths[0], _VARIABLE) as array:
            if config.frame_axis is None and array.frame_axis(sum(height for _, height, _ in shapes[1:])) == "first":
                raise InputError(
                    f"{self._paths[0]} has its frames along the first axis of {array.stored.shape[::-1]}, where values are "
                    "most alike; write frame_axis: first, or frame_axis: last if it is right"
                )
        for path, shape in zip(self._paths, shapes, strict=True):
            if shape[1:] != shapes[0][1:]:
                raise InputError(
                    f"{path} holds frames of {_size(shape)} px, and {self._paths[0].name} of {_size(shapes[0])}; parts of one "
                    "capture have the same size"
                )
        self._starts = list(accumulate((shape[0] for shape in shapes), initial=0))
        info, n_frames = _info(config.path), [shape[0] for shape in shapes]
        # Its no_frames is that of the capture, or that of each part but the last.
        if info and info.no_frames != sum(n_frames) and {*n_frames[:-1], max(n_frames)} != {info.no_frames}:
            raise InputError(
                f"{config.path / _INFO} speaks of {info.no_frames} frames, and the parts hold {sum(n_frames)}; correct it, or "
                "copy the parts again"
            )
        _, height, width = shapes[0]
        super().__init__(self._starts[-1], FrameLayout((height, width), (height, -(-width // 8))), config.frame_rate_hz)
        self._lock = Lock()
        self._packed = lru_cache(_MOST_PARTS)(partial(_packed_frames, frame_axis=axis))

    def pieces(self, span: FrameSpan) -> Iterator[tuple[slice, NDArray[np.uint8]]]:
        """Yield the frames of a span, one part after the other: see `BinarySource`."""
        for path, (first, last) in zip(self._paths, pairwise(self._starts), strict=True):
            start, stop = max(span.start, first), min(span.stop, last)
            if start < stop:
                with self._lock:  # otherwise several threads would read the same part
                    packed = self._packed(path)
                yield slice(start - span.start, stop - span.start), packed[start - first : stop - first]

    def close(self) -> None:
        """Release the parts that were read."""
        self._packed.cache_clear()


def _parts(folder: Path) -> list[Path]:
    """Return the parts in order; raise if one is missing."""
    if not folder.is_dir():
        raise InputError(f"there is no folder {folder}; name the folder of part_1.mat and so on")
    require_readable(folder)
    numbers = {int(match[1]) for path in folder.iterdir() if (match := _NAME.fullmatch(path.name))}
    info = _info(folder)
    expected = max(numbers, default=0) if info is None else info.no_parts
    if not numbers:
        raise InputError(f"there is no part_1.mat in the folder {folder}; check the path")
    for number in range(1, expected + 1):
        if number not in numbers:
            raise InputError(f"there is no part_{number}.mat in the folder {folder}, which has {expected} parts; copy it again")
    if max(numbers) > expected:
        raise InputError(f"{folder / _INFO} speaks of {expected} parts, and there is a part_{max(numbers)}.mat; correct it")
    return [folder / f"part_{number}.mat" for number in sorted(numbers)]


def _info(folder: Path) -> _Info | None:
    path = folder / _INFO
    return read_json(path, _Info) if path.exists() else None


def _size(shape: tuple[int, int, int]) -> str:
    return f"{shape[1]}x{shape[2]}"


MAT_PARTS = SourceContribution(
    name="mat-parts",
    summary="Binary frames in a folder of MATLAB files, part_1.mat and so on",
    config=MatPartsConfig,
    build=lambda config, _: MatPartsSource(config),
    check=lambda config: objections(_parts, config.path),  # the names alone: reading a part takes seconds
    recognise=lambda path: None if objections(_parts, path) else Recognised({"path": str(path)}, "a folder with part_1.mat"),
    suffixes=(".mat",),
)
