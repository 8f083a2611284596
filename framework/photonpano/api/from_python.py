"""Make a panorama from Python without a spec: of frames in memory, or of a capture."""

from __future__ import annotations

import shutil
import tempfile
import weakref
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photonpano.errors import InputError
from photonpano.execution.context import Progress
from photonpano.files.folders import atomic_path, require_new
from photonpano.pipeline.run import RunResult, run
from photonpano.reading import frames_are_last
from photonpano.specs import parse_spec
from photonpano.values import FrameSpan

_BLOCK_BYTES = 2**26  # of frames that are packed at a time


def panorama(
    frames: ArrayLike | Path,
    frame_rate_hz: float | None = None,
    output: str | Path | None = None,
    progress: Progress | None = None,
    *,
    overwrite: bool = False,
    **keys: Any,
) -> RunResult:
    """Make the panorama of binary frames, or of a capture, with the defaults of a spec.

    Args:
        frames: (T, H, W) array of 0 and 1, or False and True; or the path of a capture, whose source is recognised.
        frame_rate_hz: frames per second; without it, times are in frames.
        output: the run folder. Frames in memory are written beside it, as `OUTPUT.npy`, so that it can be rendered again. By
            default a temporary folder, which goes with the result.
        progress: receives stages and messages; by default, bars in a notebook and nothing elsewhere.
        overwrite: whether files of `output` may be replaced: see `run`.
        keys: other keys of a spec, such as `motion={"model": "rotation"}` or `levels=2`.

    Raises:
        InputError: the array holds no binary frames.
        SpecError: no source recognises the capture, or a key is wrong.
        PhotonpanoError: what else `run` raises.
    """
    temporary = Path(tempfile.mkdtemp(prefix="photonpano-")) if output is None else None
    directory, written = Path(output or f"{temporary}/run"), temporary
    try:
        known = {} if frame_rate_hz is None else {"frame_rate_hz": frame_rate_hz}
        if isinstance(frames, str | Path):
            source = {"use": "auto", "with": {"path": str(frames), **known}}
        else:
            path, array = directory.with_name(f"{directory.name}.npy"), np.asarray(frames)
            _require_frames(array)
            require_new(path, overwrite)
            with atomic_path(path) as partial:
                _pack(array, partial)
            written = temporary or path
            source = {"use": "packed-npy", "with": {"path": str(path.absolute()), "width": array.shape[2], **known}}
        plan = parse_spec({"version": 1, "source": source, **keys}, output=directory)
        result = run(plan, progress, overwrite=overwrite)
    except BaseException:  # a second try finds its place free
        if written is not None:
            shutil.rmtree(written, ignore_errors=True) if written.is_dir() else written.unlink()
        raise
    if temporary is not None:
        weakref.finalize(result, shutil.rmtree, temporary, ignore_errors=True)
    return result


def _require_frames(array: NDArray[Any]) -> None:
    if array.ndim != 3 or not array.size:
        raise InputError(f"frames: expected an array of shape (frames, height, width), got {array.shape}")
    if array.shape[2] > 4 * max(array.shape[:2]) or frames_are_last([array[:128]], array.shape):
        raise InputError(
            f"frames: expected an array of shape (frames, height, width), and {array.shape} seems to have the frames last; "
            "pass np.moveaxis(frames, -1, 0)"
        )


def _pack(array: NDArray[Any], path: Path) -> None:
    """Write binary frames as a .npy file, 8 pixels to a byte."""
    n_frames, height, width = array.shape
    packed = np.lib.format.open_memmap(path, "w+", np.uint8, (n_frames, height, -(-width // 8)))
    for span in FrameSpan(0, n_frames).blocks(max(1, _BLOCK_BYTES // (height * width))):
        part = array[span.start : span.stop]
        wrong = np.argwhere((part != 0) & (part != 1))
        if len(wrong):
            frame, row, column = wrong[0].tolist()
            raise InputError(
                f"frames: expected 0 and 1, got {part[frame, row, column]} in frame {span.start + frame} at row {row}, column "
                f"{column}; sums of frames and grey levels are read from files, by the sources npy and image-folder"
            )
        packed[span.start : span.stop] = np.packbits(part != 0, axis=2)
    packed.flush()
