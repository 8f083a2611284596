"""Guess the layout of an array of frames from samples: packed bits, bits or sums, the axis of the frames."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from photonpano.files.paths import Location, Url
from photonpano.reading.files import OpenFiles, is_gzip, size_of
from photonpano.reading.npy import NpyHeader, local, unpacked_start
from photonpano.reading.pixel_order import MIN_SCORE, other_order, score, units_of
from photonpano.values import FrameSpan

_VALUES = 3 * 1024**2  # values read, about
_RUN = 128  # most frames of a run of consecutive frames
_SHORTEST_RUN = 16  # frames of a run, even if only some of their columns can be read
_MIN_BITS = 20  # fewest lit pixels by which an array of zeros and ones is recognised
_MIN_SUMS = 200  # fewest nonzero pixels by which an array without values of 128 and more is recognised
_BRIGHT = 0.9  # pixels above this quantile are left out: hot pixels must not outweigh the scene
_COMPARED = 16  # frames whose bytes are compared as numbers
# sum of the squares of the bits of each byte
_WEIGHTS = np.unpackbits(np.arange(256, dtype=np.uint8)).reshape(256, 8) @ 4.0 ** np.arange(7, -1, -1)
# Neighbouring numbers differ by less than their bits: 127 and 128 by 1. If a byte is eight pixels, the squared difference of
# two is at least a third of the sum of the squares of their bits, even in a checkerboard.
_CARRIES = 0.25
_BLOCK = 8  # side of the blocks of frames, rows and columns that are correlated with their neighbours
_TIMES_LONGER = 2  # the axis of the frames is more than twice as long as both of the image

Eight: TypeAlias = Literal["pixels of a column", "pixels of a row", "frames"]
_PACKED_AXES: tuple[Eight, ...] = get_args(Eight)  # the axis of an array whose last is that of the frames

_MIN_LEAD = 4.0  # standard errors by which the correlation along the axis of the frames exceeds the others


class Content(NamedTuple):
    """What the values of an array are."""

    holds: Literal["bits", "sums"]  # "bits" for a pixel to a value, of 0 and 1, or of 0 and 255; "sums" for counts
    lowest: int  # the smallest value of the sample
    highest: int  # the largest value of the sample
    n_values: int  # values of the sample


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


def unpacked_content(samples: Sequence[NDArray[Any]]) -> Content | None:
    """Return what the values of runs of frames (n, rows, columns), integers or bool, are.

    None if they are bytes of eight pixels each, and where too few pixels are lit.
    """
    lowest, highest = (int(edge) for edge in (min(each.min() for each in samples), max(each.max() for each in samples)))
    n_values = sum(each.size for each in samples)
    peak = np.max([each.max(axis=0) for each in samples], axis=0)
    n_lit = int(np.count_nonzero(peak))
    if samples[0].dtype != np.uint8:
        return Content("bits" if (lowest, highest) in ((0, 1), (0, 0), (1, 1)) else "sums", lowest, highest, n_values)
    if highest == 1:
        return Content("bits", 0, 1, n_values) if n_lit >= _MIN_BITS else None
    if highest == 255 and not any(((each + np.uint8(1)) > 1).any() for each in samples):
        n_varied = int(np.count_nonzero((peak > 0) & (np.min([each.min(axis=0) for each in samples], axis=0) == 0)))
        return Content("bits", 0, 255, n_values) if n_varied >= _MIN_BITS else None
    if (highest < 128 and n_lit >= _MIN_SUMS) or (highest >= 128 and _are_numbers(samples, peak)):
        return Content("sums", lowest, highest, n_values)
    return None


def _are_numbers(samples: Sequence[NDArray[np.uint8]], peak: NDArray[np.uint8]) -> bool:
    """Return whether neighbouring bytes are alike as numbers, and not bit by bit."""
    usual = peak <= np.quantile(peak, _BRIGHT)
    pairs = usual[1:] & usual[:-1]
    excess = np.zeros(pairs.shape)
    frames = [frame for run in samples for frame in run]
    for frame in frames[:: -(-len(frames) // _COMPARED)]:
        difference = np.diff(frame.astype(np.int16), axis=0)
        flipped = _WEIGHTS[frame[1:] ^ frame[:-1]]
        excess += _CARRIES * flipped - difference.astype(np.float64) ** 2
    return score(units_of((excess * pairs)[None])[0]) > MIN_SCORE


def frames_are_last(samples: Sequence[NDArray[Any]], shape: Sequence[int]) -> bool:
    """Return whether the last axis of an array is that of the frames, and the first two are those of the image.

    Eight frames later a pixel is more like itself than the pixel eight rows or columns further, unless the image moves by more
    than a pixel a frame. So the axis along which blocks of values correlate most is that of the frames, if it is the longest.

    Args:
        samples: runs of consecutive frames as they would lie along the first axis, each (n, rows, columns), a pixel to a value.
        shape: that of the array.
    """
    return _last_is_longest(*shape) and _last_is_alike(samples, (_BLOCK, _BLOCK, _BLOCK))


def packed_frames_are_last(samples: Sequence[NDArray[np.uint8]], shape: Sequence[int], a_byte_holds: Eight) -> bool:
    """Return whether the last axis of an array of bytes is that of the frames: see `frames_are_last`.

    Args:
        samples: runs of consecutive frames as they would lie along the first axis, each (n, rows, bytes of a row).
        shape: that of the array: (rows, bytes of a row, frames), (bytes of a column, columns, frames), or (rows, columns, bytes
            of eight frames).
        a_byte_holds: what the eight bits of a byte would be.
    """
    axis = _PACKED_AXES.index(a_byte_holds)
    lengths, block = list(shape), [_BLOCK] * 3
    lengths[axis], block[axis] = 8 * shape[axis], 1
    if not _last_is_longest(*lengths):
        return False
    lit = [np.bitwise_count(each) for each in samples]
    if a_byte_holds == "frames":
        return _last_is_alike(lit, block)
    # Bytes of eight pixels are less alike along the axis where they are packed, as they are 8 px apart there.
    pixels = [_blocks(each, (1, 1, _BLOCK)) for each in lit]
    if _correlation(pixels, axis) < _correlation(pixels, 1 - axis) and _last_is_alike(lit, block):
        return True
    # The frames may move too fast for that. Then the axis where bytes are packed is still an axis of the image.
    other = other_order(samples if axis == 1 else [each.swapaxes(0, 1) for each in samples])
    return other is not None and other.order.packed_along == "height"


def _last_is_longest(first: int, second: int, last: int) -> bool:
    return last > _TIMES_LONGER * max(first, second)


def _last_is_alike(samples: Sequence[NDArray[Any]], block: Sequence[int]) -> bool:
    """Return whether neighbouring blocks of values correlate most along the last axis."""
    blocks = [_blocks(each, block) for each in samples]
    (first, _), (second, _), (last, number) = (_correlation(blocks, axis) for axis in range(3))
    return bool(first and second and last) and last - max(first, second) > _MIN_LEAD * math.sqrt(2 / number)


def _blocks(frames: NDArray[Any], block: Sequence[int]) -> NDArray[np.float64]:
    """Return the means of blocks of values: (n, rows, columns) becomes smaller by the sides of a block."""
    shape = [length // side for length, side in zip(frames.shape, block, strict=True)]
    cut = frames[tuple(slice(n * side) for n, side in zip(shape, block, strict=True))]
    in_blocks = cut.reshape(shape[0], block[0], shape[1], block[1], shape[2], block[2])
    return np.asarray(in_blocks.mean(axis=(1, 3, 5)))


def _correlation(blocks: Sequence[NDArray[np.float64]], axis: int) -> tuple[float, int]:
    """Return the correlation of neighbours along an axis, 0 if there are none, or no scatter; and how many there are."""
    along = [np.moveaxis(each, axis, 0) for each in blocks]
    x, y = (np.concatenate([each[part].ravel() for each in along]) for part in (slice(None, -1), slice(1, None)))
    scatter = float(x.std() * y.std()) if x.size else 0.0
    return (float(((x - x.mean()) * (y - y.mean())).mean()) / scatter if scatter > 0 else 0.0), x.size
