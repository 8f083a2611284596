"""Captures on disk: any binary source as a packed .npy file, with its truth beside it."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

import numpy as np

from photonpano.atomic import atomic_path, require_space, resumable_path
from photonpano.captures.packed_frames import PackedFrames
from photonpano.errors import InputError, OutputError
from photonpano.protocols import KnowsTruth, LinearlyCorrectedSource, Source
from photonpano.threads import in_order


def truth_path(path: Path) -> Path:
    """Return where the truth of a capture lies: `cube.truth.npz` for `cube.npy`."""
    return path.with_name(f"{path.stem}.truth.npz")


def write_packed(
    source: Source,
    path: Path,
    progress: Callable[[int], object] | None = None,
    threads: int = 2,
    resumed: Callable[[int], object] | None = None,
) -> tuple[Path, ...]:
    """Write a binary source as uint8 (frames, height, ceil(width / 8)), packed along the width, in constant memory.

    Args:
        source: the capture; if it is a `KnowsTruth`, its truth is written beside it, see `truth_path`. The frames of a
            `PackedSource` are never unpacked.
        path: the .npy file.
        progress: called with the number of frames written since the last call.
        threads: how many threads ask the source for frames.
        resumed: makes the writing one that can be continued: what is written before it is interrupted stays in
            `part_path(path)`, and if such a file is there already, this is called with the number of frames of the source
            that it holds; 0 if it is of another capture, and written anew.

    Returns:
        The files written, the capture first.

    Raises:
        InputError: the source is not binary, or it takes something out of sums, which bits cannot hold.
        OutputError: the files cannot be written, or will not fit on the disk. Nothing is left under the final names then, or
            when the source fails.
        PluginError: the source gives frames of another shape than it promises.
    """
    if source.info.kind != "binary":
        raise InputError(f"cannot write {path}: packed .npy files hold binary frames, and this source gives intensities")
    if isinstance(source, LinearlyCorrectedSource):
        raise InputError(
            f"cannot write {path}: some corrections change sums of frames, and not the frames; "
            "leave them to the specs that read the file"
        )
    if path.suffix != ".npy":
        raise OutputError(f"cannot write {path}: a packed capture is a .npy file; name it {path.name}.npy")
    truth = source.truth() if isinstance(source, KnowsTruth) else {}
    truth_bytes = sum(array.nbytes for array in truth.values())
    with (atomic_path if resumed is None else resumable_path)(path) as temporary:
        _write_capture(source, path, temporary, truth_bytes, progress, threads, resumed)
        if not truth:
            return (path,)
        with atomic_path(truth_path(path)) as temporary_truth:
            np.savez(temporary_truth, **truth)  # type: ignore[arg-type]  # the stubs take the names for other parameters
    return path, truth_path(path)


def _write_capture(
    source: Source,
    final: Path,
    temporary: Path,
    truth_bytes: int,
    progress: Callable[[int], object] | None,
    threads: int,
    resumed: Callable[[int], object] | None,
) -> None:
    packed = PackedFrames(source)
    there = temporary.stat().st_size if temporary.exists() else 0
    require_space(final, packed.n_bytes + truth_bytes - there)
    # Made before it is known what is in it: another process that writes to it must not be disturbed.
    with temporary.open("r+b" if temporary.exists() else "x+b") as file:
        _lock(file, final)
        done = packed.found_in(file) if there else 0
        if resumed is not None and there:
            resumed(done)
        if done and progress is not None:
            progress(done)
        if not done:
            file.seek(0)
            file.write(packed.header)
        file.seek(packed.position(done))
        file.truncate()
        for frames in in_order(packed.of, packed.blocks(done), threads):
            file.write(frames.data)
            if progress is not None:
                progress(len(frames))
        # A disk that is full must show before the truth gets its final name.
        file.flush()
        os.fsync(file.fileno())


def _lock(file: BinaryIO, final: Path) -> None:
    """Refuse to write what another process is writing; the system forgets the lock with the process."""
    with suppress(OSError):  # a file system without locks
        try:
            fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            remedy = "wait for it, or choose another name"
            raise OutputError(f"cannot write {final}: another process is writing it; {remedy}") from error
