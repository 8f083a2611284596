"""Read some frames from all over a .npy file, to judge what it holds."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonpano.paths import Location, Url
from photonpano.reading.files import OpenFiles, size_of
from photonpano.reading.gzipped import is_gzip, local, unpacked_start
from photonpano.reading.npy import NpyHeader
from photonpano.values import FrameSpan

_VALUES = 3 * 1024**2  # values read, about
_RUN = 128  # most frames of a run of consecutive frames
_SHORTEST_RUN = 16  # frames of a run, even if only some of their columns can be read


def sampled_frames(path: Location, header: NpyHeader) -> list[NDArray[Any]]:
    """Read runs of consecutive frames from all over a .npy file, or from the beginning of a .npy.gz file.

    Args:
        path: the file.
        header: its header; the array has three dimensions or more, in C order.

    Returns:
        Arrays (n, rows, columns, ...), 3 million values together. Of large frames, only the first columns are read. An empty
        list where the file is cut short, or the beginning of a .npy.gz file holds no whole frame.
    """
    n_frames, n_rows, n_columns, *_ = header.shape
    values_of_frame = int(np.prod(header.shape[1:]))
    if is_gzip(path):
        start = unpacked_start(local(path), header.offset + _VALUES * header.dtype.itemsize)[header.offset :]
        whole = min(n_frames, len(start) // (values_of_frame * header.dtype.itemsize))
        frames = np.frombuffer(start, header.dtype, whole * values_of_frame)
        return [frames.reshape(whole, *header.shape[1:])] if whole else []
    if size_of(path) < header.file_bytes:
        return []
    columns = min(n_columns, max(1, _VALUES // (_SHORTEST_RUN * n_rows)))
    spans = sampled_spans(n_frames, n_rows * columns)
    if isinstance(path, Url):
        files = OpenFiles()
        samples = [np.empty((len(span), *header.shape[1:]), header.dtype) for span in spans]
        for span, sample in zip(spans, samples, strict=True):
            files.read(path, header.offset + span.start * sample[0].nbytes, sample.view(np.uint8))
        return [sample[:, :, :columns] for sample in samples]
    stored = np.memmap(path, header.dtype, "r", header.offset, header.shape)
    return [np.array(stored[each.start : each.stop, :, :columns]) for each in spans]


def sampled_spans(n_frames: int, frame_values: int) -> list[FrameSpan]:
    """Return spans of up to 128 frames, evenly spaced over a capture, that hold about 3 million values together."""
    most = max(1, _VALUES // frame_values)
    length = min(_RUN, n_frames, most)
    n_spans = max(1, min(most // length, n_frames // length))
    starts = np.linspace(0, n_frames - length, n_spans).astype(int).tolist()
    return [FrameSpan(start, start + length) for start in starts]
