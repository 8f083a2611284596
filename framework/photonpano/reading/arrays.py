"""Read arrays of frames in .npy.gz, .npz, HDF5 and MATLAB files, and unpack one to a .npy file, once."""

from __future__ import annotations

import gzip
import logging
import math
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Literal, NamedTuple, TypeAlias, TypeGuard
from zipfile import ZipFile

import numpy as np
from numpy.typing import NDArray

from photonpano.errors import InputError, OutputError
from photonpano.files.folders import atomic_path, require_space
from photonpano.files.paths import Location, Url
from photonpano.reading.files import library, read_start, reading
from photonpano.reading.npy import frames_are_last, read_npy_header, require_frames, sampled_spans
from photonpano.text import listed

FrameAxis: TypeAlias = Literal["first", "last"]

_GZIP, _ZIP, _HDF, _MATLAB = b"\x1f\x8b", b"PK\x03\x04", b"\x89HDF", b"MATLAB "
_DAMAGED = "cannot be read as a file of arrays: it is damaged or something else; copy it again"
_BLOCK_BYTES = 16 * 1024**2  # read at once
_MOST = 65535  # the largest sum of binary frames

logger = logging.getLogger(__name__)


def is_array_file(path: Location) -> TypeGuard[Path]:
    """Return whether a path is a .npy.gz, .npz, HDF5 or MATLAB file, by its first bytes."""
    return not isinstance(path, Url) and path.is_file() and read_start(path, 7).startswith((_GZIP, _ZIP, _HDF, _MATLAB))


def is_matlab_file(path: Path) -> bool:
    """Return whether MATLAB wrote a file, by its first bytes."""
    return read_start(path, len(_MATLAB)) == _MATLAB


class FrameArray(NamedTuple):
    """An array (frames, height, width) of a file, whose values are read in blocks; in MATLAB, frames are the last axis."""

    name: str  # empty for the only array of a .npy.gz file
    stored: Any  # an array of numpy, h5py, or in a compressed .npy file, in the order of the bytes
    of_matlab: bool  # whether MATLAB wrote it, which counts axes from the last one in the order of the bytes

    def frame_axis(self, others: int = 0) -> FrameAxis | None:
        """Return "first" if likeness shows that the first axis of an array of MATLAB is that of the frames.

        `others` is the number of frames of the capture in other files.
        """
        shape = self.stored.shape
        if not self.of_matlab or len(shape) != 3:
            return None
        spans = sampled_spans(shape[0], shape[1] * shape[2])
        samples = [np.asarray(self.stored[span.start : span.stop]) for span in spans]
        return "first" if frames_are_last(samples, (*shape[:2], shape[2] + others)) else None

    def shape(self, axis: FrameAxis | None) -> tuple[int, ...]:
        """Return the shape with the frames first; `axis` is where they lie in MATLAB, None for the last."""
        shape = self.stored.shape
        if not self.of_matlab:
            return tuple(shape)
        return (shape[-1], *shape[-2::-1]) if axis == "first" else (shape[0], *shape[:0:-1])

    def blocks(self, axis: FrameAxis | None) -> Iterator[tuple[slice, NDArray[Any]]]:
        """Yield some frames at a time, (n, H, W), in order, and their place; see `shape`."""
        n_frames, *of_frame = self.shape(axis)
        step = max(1, _BLOCK_BYTES // max(1, math.prod(of_frame) * self.stored.dtype.itemsize))
        for start in range(0, n_frames, step):
            place = slice(start, min(start + step, n_frames))
            if not self.of_matlab:
                yield place, np.asarray(self.stored[place])
                continue
            values = np.moveaxis(self.stored[..., place], -1, 0) if axis == "first" else np.asarray(self.stored[place])
            yield place, values.transpose(0, *range(values.ndim - 1, 0, -1))


class _Compressed:
    """The array of a compressed .npy file, whose values are read once, in order."""

    def __init__(self, path: Path, file: IO[bytes] | gzip.GzipFile) -> None:
        if (header := read_npy_header(file)) is None:
            raise InputError(f"{path} holds no .npy file; compress one that numpy.save has written")
        require_frames(path, header, "frames, height, width")
        self.shape, self.dtype, self._path, self._file = header.shape, header.dtype, path, file

    def __getitem__(self, place: slice) -> NDArray[Any]:
        shape = (place.stop - place.start, *self.shape[1:])
        wanted = math.prod(shape) * self.dtype.itemsize
        with reading(self._path, "is cut short or damaged: it cannot be unpacked; copy it again"):
            data = self._file.read(wanted)
            more = self._file.read(1) if place.stop == self.shape[0] else b""  # at its end, the checksum is compared
        if more or len(data) < wanted:
            raise InputError(
                f"{self._path} is damaged: the header of its array promises {'fewer' if more else 'more'} bytes than there "
                "are; copy or record it again"
            )
        return np.frombuffer(data, self.dtype).reshape(shape)


@contextmanager
def frame_array(path: Path, name: str | None) -> Iterator[FrameArray]:
    """Open the array of a name in a file, or the only one that may hold frames.

    Raises:
        InputError: there is none, or several and no name, or the file cannot be read.
    """
    with reading(path, _DAMAGED):
        start = read_start(path, 10)
        if start.startswith(_GZIP):
            with gzip.open(path) as unzipped:
                yield FrameArray("", _Compressed(path, unzipped), False)
        elif start.startswith(_ZIP):
            with ZipFile(path) as archive:
                members = {member.removesuffix(".npy"): member for member in archive.namelist() if member.endswith(".npy")}
                found = _chosen(path, name, {key: _shape(archive.open(member)) for key, member in members.items()})
                with archive.open(members[found]) as file:
                    yield FrameArray(found, _Compressed(path, file), False)
        elif start.startswith(_HDF) or start == b"MATLAB 7.3":
            step = -1 if (of_matlab := is_matlab_file(path)) else 1
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


def unpacked(path: Path, name: str | None = None, axis: FrameAxis | None = None) -> Path:
    """Return the path of a .npy file with an array of a file.

    For `capture.h5` with the array `frames` it is `capture.h5.unpacked.frames.npy`. It is written, and a warning logged, unless
    it was unpacked from the same file before. Whole numbers that are stored as fractions, as MATLAB does, become uint16.

    Args:
        path: the file.
        name: that of the array; None for the only one.
        axis: where frames lie in a file of MATLAB, and are then moved from; None for where they show to lie, or the last axis.

    Raises:
        InputError: there is no such array, it does not hold whole numbers, the file is damaged, or the .npy file cannot be
            written, or does not fit on its disk.
    """
    with frame_array(path, name) as array:
        dtype = array.stored.dtype
        if dtype.kind not in "buif":
            raise InputError(f"{path} has an array {array.name} of {dtype} values; frames are bool or whole numbers")
        names = [path.name, "unpacked", *array.name.split("/"), axis, "npy"]
        target = path.with_name(".".join(filter(None, names)))
        if target.is_file() and not target.is_symlink() and target.stat().st_mtime_ns == path.stat().st_mtime_ns:
            return target
        axis = axis or array.frame_axis()
        moved = f" (its frames lie along the {axis} axis)" if axis else ""
        shape, stored = array.shape(axis), np.dtype(np.uint16) if dtype.kind == "f" else dtype
        try:
            require_space(target, int(np.prod(shape)) * stored.itemsize)
            with atomic_path(target) as temporary:
                frames = np.lib.format.open_memmap(temporary, "w+", stored, shape)
                for place, values in array.blocks(axis):
                    _require_whole(path, array, values)
                    if not place.start:
                        logger.warning("%s is unpacked to %s, once%s", path, target.name, moved)
                    frames[place] = values
                frames.flush()
                shutil.copystat(path, temporary)
        except OutputError as error:
            remedy = "link or copy it to a folder that you may write to, with room for it"
            raise InputError(f"{path} is unpacked to a file beside it: {error}; or {remedy}") from error
    return target


def _require_whole(path: Path, array: FrameArray, values: NDArray[Any]) -> None:
    if values.dtype.kind == "f" and not np.all((values == np.floor(values)) & (values >= 0) & (values <= _MOST)):
        raise InputError(
            f"{path} has an array {array.name} of fractions, or of numbers outside of 0 to {_MOST:,}; frames are bool or whole "
            "numbers of photons"
        )
