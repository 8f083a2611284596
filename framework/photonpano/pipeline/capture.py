"""Captures on disk: any binary source as a packed .npy file, with its truth beside it."""

from __future__ import annotations

import math
import os
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, BinaryIO, Protocol, runtime_checkable

import numpy as np

from photonpano.atomic import atomic_path, require_space
from photonpano.errors import InputError, OutputError
from photonpano.values import FrameSpan

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from concurrent.futures import Future
    from pathlib import Path

    from numpy.typing import NDArray

    from photonpano.protocols import Source
    from photonpano.values import StreamInfo

_BLOCK_BYTES = 8 * 1024**2
"""Unpacked bytes of the frames that are asked for at once."""


@runtime_checkable
class KnowsTruth(Protocol):
    """A source that knows what it shows, as simulators do: a `Source` with one method more.

    `write_packed` stores the truth as an .npz archive, for `photonpano evaluate`.
    """

    def truth(self) -> Mapping[str, NDArray[np.generic]]:
        """Return named arrays; others than these may be among them.

        Convention:
            Homographies map pixels of a frame to pixels of the scene; points are (x, y), integers are pixel centres.

        Returns:
            `homographies` (T, 3, 3) float64, one for each frame, h33 = 1; `scene` (Hs, Ws) float32, the flux that is detected,
            in photons per pixel per frame period, without dark counts; `frame_shape` (2,), height and width of a frame.
        """
        ...


def truth_path(path: Path) -> Path:
    """Return where the truth of a capture lies: `cube.truth.npz` for `cube.npy`."""
    return path.with_name(f"{path.stem}.truth.npz")


def write_packed(
    source: Source, path: Path, progress: Callable[[int], object] | None = None, threads: int = 2
) -> tuple[Path, ...]:
    """Write a binary source as uint8 (frames, height, ceil(width / 8)), packed along the width, in constant memory.

    Args:
        source: the capture; if it is a `KnowsTruth`, its truth is written beside it, see `truth_path`.
        path: the .npy file.
        progress: called with the number of frames written since the last call.
        threads: how many threads ask the source for frames.

    Returns:
        The files written, the capture first.

    Raises:
        InputError: the source is not binary.
        OutputError: the files cannot be written, or will not fit on the disk. Nothing is left under the final names then, or
            when the source fails.
    """
    if source.info.kind != "binary":
        raise InputError(f"cannot write {path}: packed .npy files hold binary frames, and this source gives intensities")
    if path.suffix != ".npy":
        raise OutputError(f"cannot write {path}: a packed capture is a .npy file; name it {path.name}.npy")
    truth = source.truth() if isinstance(source, KnowsTruth) else {}
    with atomic_path(path) as temporary:
        _write_capture(source, path, temporary, sum(array.nbytes for array in truth.values()), progress, threads)
        if not truth:
            return (path,)
        with atomic_path(truth_path(path)) as temporary_truth:
            np.savez(temporary_truth, **truth)  # type: ignore[arg-type]  # the stubs take the names for other parameters
    return path, truth_path(path)


def _write_capture(
    source: Source, final: Path, temporary: Path, truth_bytes: int, progress: Callable[[int], object] | None, threads: int
) -> None:
    info = source.info
    shape = (info.n_frames, info.height, -(-info.width // 8))
    require_space(final, math.prod(shape) + truth_bytes)
    with temporary.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "|u1", "fortran_order": False, "shape": shape})
        _write_frames(source, file, progress, threads)
        # A disk that is full must show before the truth gets its final name.
        file.flush()
        os.fsync(file.fileno())


def _write_frames(source: Source, file: BinaryIO, progress: Callable[[int], object] | None, threads: int) -> None:
    """Write the frames in order, while `threads` blocks are being made."""

    def packed(span: FrameSpan) -> NDArray[np.uint8]:
        return np.packbits(source.frames(span), axis=-1)

    def write(block: Future[NDArray[np.uint8]]) -> None:
        frames = block.result()
        file.write(frames.data)
        if progress is not None:
            progress(len(frames))

    due: deque[Future[NDArray[np.uint8]]] = deque()
    with ThreadPoolExecutor(threads, thread_name_prefix="capture") as pool:
        for span in _blocks(source.info):
            due.append(pool.submit(packed, span))
            if len(due) > threads:
                write(due.popleft())
        while due:
            write(due.popleft())


def _blocks(info: StreamInfo) -> Iterator[FrameSpan]:
    step = max(1, _BLOCK_BYTES // (info.height * info.width))
    for start in range(0, info.n_frames, step):
        yield FrameSpan(start, min(start + step, info.n_frames))
