"""Write a binary source as a packed .npy file, or as a folder, with its truth beside it."""

from __future__ import annotations

import io
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from photonpano.capture import capture_of
from photonpano.contracts.protocols import Source
from photonpano.errors import InputError, OutputError, PluginError
from photonpano.execution.threads import in_order
from photonpano.files.folders import atomic_folder, atomic_path, require_space, resumable_path
from photonpano.values import FrameSpan, StreamInfo

FolderWriter = Callable[[Path, StreamInfo, Iterable[NDArray[np.uint8]]], None]

_BLOCK_BYTES = 8 * 1024**2  # bytes of the frames that are read at once, packed if the source is


def truth_path(path: Path) -> Path:
    """Return where the truth of a capture lies: `cube.truth.npz` for `cube.npy`."""
    return path.with_name(f"{path.stem}.truth.npz")


def write_folder(
    source: Source,
    path: Path,
    write: FolderWriter,
    progress: Callable[[int], object] | None = None,
    threads: int = 2,
) -> tuple[Path, ...]:
    """Write a binary source as a folder by `write`, whole or not at all, in constant memory; otherwise as `write_packed`.

    Raises:
        OutputError: there is a file under that name, or the folder cannot be written, or does not fit on the disk.
    """
    _require_bits(source, path)
    packed, truth = PackedFrames(source), capture_of(source).truth() or {}
    with atomic_folder(path) as folder:
        require_space(path, packed.n_bytes + sum(array.nbytes for array in truth.values()))
        write(folder, source.info, _counted(in_order(packed.of, packed.blocks(0), threads), progress))
        return (path, *_write_truth(path, truth))


def _counted(blocks: Iterator[NDArray[np.uint8]], progress: Callable[[int], object] | None) -> Iterator[NDArray[np.uint8]]:
    for frames in blocks:
        yield frames
        if progress is not None:
            progress(len(frames))


def _write_truth(path: Path, truth: Mapping[str, NDArray[Any]]) -> tuple[Path, ...]:
    if not truth:
        return ()
    with atomic_path(truth_path(path)) as temporary:
        np.savez(temporary, allow_pickle=False, **truth)
    return (truth_path(path),)


def _require_bits(source: Source, path: Path) -> None:
    if source.info.kind != "binary":
        raise InputError(f"cannot write {path}: packed captures hold binary frames, and this source gives intensities")
    if capture_of(source).colour is not None and not capture_of(source).corrects_sums:
        raise InputError(
            f"cannot write {path}: a packed capture holds one channel, and this capture has three; write channel: 0, 1 or 2"
        )
    if capture_of(source).corrects_sums:
        raise InputError(
            f"cannot write {path}: some corrections change sums of frames, and not the frames; "
            "leave them to the specs that read the file"
        )


def write_packed(
    source: Source,
    path: Path,
    progress: Callable[[int], object] | None = None,
    threads: int = 2,
    resumed: Callable[[int], object] | None = None,
) -> tuple[Path, ...]:
    """Write a binary source as uint8 (frames, height, ceil(width / 8)), packed along the width, in constant memory.

    Packed frames are never unpacked. The truth of the source, if it is known, is written beside it, see `truth_path`; all
    paths are returned, the capture first. `progress` is called with numbers of frames, and `threads` threads read the source.

    With `resumed`, an interrupted file stays as `part_path(path)`, and the next call compares its frames with the source and
    continues it; then `resumed` is called with the number of frames that it holds.

    Raises:
        InputError: the source is not binary, or corrects its sums, which bits cannot hold.
        OutputError: the files cannot be written, do not fit on the disk, or `part_path(path)` is something else. Nothing is
            left under the final names then, nor when the source fails.
        PluginError: the source returns frames of another shape than it promises.
    """
    _require_bits(source, path)
    if path.suffix != ".npy":
        raise OutputError(f"cannot write {path}: a packed capture is a .npy file; name it {path.name}.npy")
    packed, truth = PackedFrames(source), capture_of(source).truth() or {}
    with (atomic_path if resumed is None else resumable_path)(path) as temporary, temporary.open("r+b") as file:
        there = temporary.stat().st_size
        require_space(path, packed.n_bytes + sum(array.nbytes for array in truth.values()) - there)
        done = packed.found_in(file, threads)
        if done is None:
            raise OutputError(
                f"cannot write {path}: {temporary} is there, and holds something else than the first frames of this capture; "
                "remove it, or choose another name"
            )
        if done:
            for notify in (resumed, progress):
                if notify is not None:
                    notify(done)
        else:
            file.seek(0)
            file.write(packed.header)
        file.seek(packed.position(done))
        file.truncate()
        for frames in _counted(in_order(packed.of, packed.blocks(done), threads), progress):
            file.write(frames.data)
        # A full disk must be noticed before the truth gets its final name.
        file.flush()
        os.fsync(file.fileno())
        return (path, *_write_truth(path, truth))


class PackedFrames:
    """A binary source as the content of a packed .npy file."""

    def __init__(self, source: Source) -> None:
        self._capture = capture_of(source)
        info = source.info
        self._frame = (info.height, -(-info.width // 8))
        self._read_bytes = math.prod(self._frame if self._capture.is_packed else info.frame_shape)
        header = io.BytesIO()
        shape = (info.n_frames, *self._frame)
        np.lib.format.write_array_header_1_0(header, {"descr": "|u1", "fortran_order": False, "shape": shape})
        self.header = header.getvalue()

    @property
    def n_bytes(self) -> int:
        """The size of the whole file."""
        return self.position(self._capture.info.n_frames)

    def position(self, frame: int) -> int:
        """Return where a frame begins in the file."""
        return len(self.header) + frame * math.prod(self._frame)

    def blocks(self, first: int, stop: int | None = None) -> Iterator[FrameSpan]:
        """Yield the spans in which the frames are read, from the first on, all by default."""
        last, step = self._capture.info.n_frames if stop is None else stop, max(1, _BLOCK_BYTES // self._read_bytes)
        for start in range(first, last, step):
            yield FrameSpan(start, min(start + step, last))

    def of(self, span: FrameSpan) -> NDArray[np.uint8]:
        """Return the frames of a span, (n, H, ceil(W / 8)) uint8, contiguous; a `PluginError` if the source returns others."""
        packed = self._capture.packed(span)
        expected = (len(span), *self._frame)
        if packed.shape != expected or packed.dtype != np.uint8:
            raise PluginError(
                f"the source broke its contract at {span}: expected packed frames of uint8 {expected}, "
                f"got {packed.dtype} {packed.shape}"
            )
        return np.ascontiguousarray(packed)

    def found_in(self, file: BinaryIO, threads: int) -> int | None:
        """Return how many frames of this source a file begins with; None if it is another file.

        Every frame is compared. The first that differs, damaged or half written, ends what is found.
        """
        file.seek(0)
        start = file.read(len(self.header))
        if start != self.header:
            return 0 if self.header.startswith(start) else None
        size = file.seek(0, io.SEEK_END)
        there = min((size - len(self.header)) // math.prod(self._frame), self._capture.info.n_frames)
        file.seek(len(self.header))
        done = 0
        for frames in in_order(self.of, self.blocks(0, there), threads):
            found = np.frombuffer(file.read(frames.nbytes), np.uint8).reshape(frames.shape)
            differs = (found != frames).any(axis=(1, 2))
            if differs.any():
                done += int(differs.argmax())
                return done or None
            done += len(frames)
        return done
