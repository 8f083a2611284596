"""Read arrays of frames in .npz, HDF5 and MATLAB files, and unpack one to a .npy file, once."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Literal, NamedTuple, TypeAlias, TypeGuard
from zipfile import ZipFile

import numpy as np
from numpy.typing import NDArray

from photonpano.errors import InputError
from photonpano.files.folders import atomic_path, require_space
from photonpano.files.paths import Location, Url
from photonpano.reading.files import library, read_start, reading
from photonpano.reading.npy import frames_are_last, is_unpacked_from, read_npy_header, sampled_spans
from photonpano.text import listed

FrameAxis: TypeAlias = Literal["first", "last"]

_ZIP, _HDF, _MATLAB = b"PK\x03\x04", b"\x89HDF", b"MATLAB "
_DAMAGED = "cannot be read as a file of arrays: it is damaged or something else; copy it again"
_BLOCK_BYTES = 16 * 1024**2  # read at once
_MOST = 65535  # the largest sum of binary frames

logger = logging.getLogger(__name__)


def is_array_file(path: Location) -> TypeGuard[Path]:
    """Return whether a path is an .npz, HDF5 or MATLAB file, by its first bytes."""
    return not isinstance(path, Url) and path.is_file() and read_start(path, 7).startswith((_ZIP, _HDF, _MATLAB))


class FrameArray(NamedTuple):
    """An array (frames, height, width) of a file, or (height, width, frames), whose values are read in blocks."""

    name: str
    stored: Any  # an array of numpy or h5py, in the order of the bytes
    of_matlab: bool  # whether MATLAB wrote it, which counts axes from the last one in the order of the bytes

    def frame_axis(self, others: int = 0) -> FrameAxis | None:
        """Return which axis is that of the frames if likeness shows that it is not the usual one.

        Args:
            others: number of frames of the capture in other files.
        """
        shape = self.stored.shape
        if len(shape) != 3:
            return None
        spans = sampled_spans(shape[0], shape[1] * shape[2])
        samples = [np.asarray(self.stored[span.start : span.stop]) for span in spans]
        if not frames_are_last(samples, (*shape[:2], shape[2] + others)):
            return None
        return "first" if self.of_matlab else "last"

    def shape(self, axis: FrameAxis | None) -> tuple[int, ...]:
        """Return the shape with the frames first; `axis` is where they lie in the file, None for the usual one."""
        of_frame = self.stored.shape[1:] if self._axis(axis) == 0 else self.stored.shape[:-1]
        return self.stored.shape[self._axis(axis)], *(of_frame[::-1] if self.of_matlab else of_frame)

    def blocks(self, axis: FrameAxis | None) -> Iterator[tuple[slice, NDArray[Any]]]:
        """Yield some frames at a time, (n, H, W), and their place; see `shape`."""
        last = self._axis(axis) == -1
        n_frames = self.stored.shape[self._axis(axis)]
        step = max(1, _BLOCK_BYTES * n_frames // max(1, self.stored.size * self.stored.dtype.itemsize))
        for start in range(0, n_frames, step):
            place = slice(start, min(start + step, n_frames))
            values = np.moveaxis(self.stored[..., place], -1, 0) if last else np.asarray(self.stored[place])
            yield place, values.transpose(0, *range(values.ndim - 1, 0, -1)) if self.of_matlab else values

    def _axis(self, axis: FrameAxis | None) -> Literal[0, -1]:
        usual = "last" if self.of_matlab else "first"
        return 0 if axis in (None, usual) else -1


@contextmanager
def frame_array(path: Path, name: str | None) -> Iterator[FrameArray]:
    """Open the array of a name in a file, or the only one that may hold frames.

    Raises:
        InputError: there is none, or several and no name, or the file cannot be read.
    """
    with reading(path, _DAMAGED):
        start = read_start(path, 10)
        if start.startswith(_ZIP):
            with ZipFile(path) as archive:
                members = {member.removesuffix(".npy"): member for member in archive.namelist() if member.endswith(".npy")}
                found = _chosen(path, name, {key: _shape(archive.open(member)) for key, member in members.items()})
                with archive.open(members[found]) as file:
                    yield FrameArray(found, np.lib.format.read_array(file, allow_pickle=False), False)
        elif start.startswith(_HDF) or start == b"MATLAB 7.3":
            step = -1 if (of_matlab := start.startswith(_MATLAB)) else 1
            with library("h5py", "photonpano[hdf5]", str(path)).File(path) as file:
                shapes: dict[str, tuple[int, ...]] = {}
                file.visititems(lambda key, each: shapes.update({key: each.shape[::step]}) if hasattr(each, "shape") else None)
                found = _chosen(path, name, shapes)
                yield _of_matlab(found, file[found]) if of_matlab else FrameArray(found, file[found], False)
        else:
            from scipy.io import loadmat, whosmat

            found = _chosen(path, name, {key: shape for key, shape, _ in whosmat(str(path))})
            yield _of_matlab(found, loadmat(str(path), variable_names=[found])[found].T)


def _of_matlab(name: str, stored: Any) -> FrameArray:
    """Return an array of MATLAB, which drops the last dimension if it is 1."""
    return FrameArray(name, np.asarray(stored)[None] if len(stored.shape) == 2 else stored, True)


def _shape(file: IO[bytes]) -> tuple[int, ...]:
    with file:
        header = read_npy_header(file)
    return header.shape if header else ()


def _chosen(path: Path, name: str | None, shapes: dict[str, tuple[int, ...]]) -> str:
    """Return the name of the array with frames."""
    if name is not None and name in shapes:
        return name
    able = {key: shape for key, shape in shapes.items() if len(shape) in (3, 4) and min(shape) > 0}
    if name is None and len(able) == 1:
        return next(iter(able))
    there = listed([f"{key} {shape}" for key, shape in (able or shapes).items()]) or "no arrays"
    if name is not None:
        raise InputError(f"{path} has no array {name}, where frames are looked for: it holds {there}; name the right one")
    what = f"write array: {next(iter(able))}, or another" if able else "frames are an array of three dimensions"
    raise InputError(f"{path} holds {there}; {what}")


def unpacked_array(path: Path, name: str | None, axis: FrameAxis | None) -> Path:
    """Return the path of a .npy file with an array of a file, frames first.

    For `capture.h5` with the array `frames` it is `capture.h5.unpacked.frames.npy`. It is written, and a warning logged, unless
    it is there from the same file. Whole numbers that are stored as fractions, as MATLAB does, become uint16.

    Args:
        path: the file.
        name: that of the array; None for the only one.
        axis: where its frames lie; None for the axis that the frames show, or else the usual one: the last in a file of MATLAB,
            the first in others.

    Raises:
        InputError: there is no such array, or it does not hold whole numbers.
        OutputError: the .npy file cannot be written, or does not fit on its disk.
    """
    with frame_array(path, name) as array:
        dtype = array.stored.dtype
        if dtype.kind not in "buif":
            raise InputError(f"{path} has an array {array.name} of {dtype} values; frames are bool or whole numbers")
        written, axis = axis, axis or array.frame_axis()
        target = path.with_name(
            ".".join([path.name, "unpacked", *array.name.split("/"), *([written] if written else []), "npy"])
        )
        if is_unpacked_from(target, path):
            return target
        axis = axis or array.frame_axis()
        shape, stored = array.shape(axis), np.dtype(np.uint16) if dtype.kind == "f" else dtype
        require_space(target, int(np.prod(shape)) * stored.itemsize)
        with atomic_path(target) as temporary:
            frames = np.lib.format.open_memmap(temporary, "w+", stored, shape)
            for place, values in array.blocks(axis):
                _require_whole(path, array, values)
                if not place.start:
                    found = f" (its frames lie along the {axis} axis)" if axis else ""
                    logger.warning("%s is unpacked to %s, once%s", path, target.name, found)
                frames[place] = values
            frames.flush()
            shutil.copystat(path, temporary)
    return target


def _require_whole(path: Path, array: FrameArray, values: NDArray[Any]) -> None:
    if values.dtype.kind == "f" and not np.all((values == np.floor(values)) & (values >= 0) & (values <= _MOST)):
        raise InputError(
            f"{path} has an array {array.name} of fractions, or of numbers outside of 0 to {_MOST:,}; frames are bool or whole "
            "numbers of photons"
        )
