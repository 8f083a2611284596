"""What the values of an array of frames are: packed bits, single bits, or sums; and which axis is that of the frames."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from photonpano.reading.pixel_order import other_order
from photonpano.reading.significance import MIN_SCORE, score, units_of

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

_MIN_LEAD = 4.0  # standard errors by which the correlation along the axis of the frames exceeds the others


class Content(NamedTuple):
    """What the values of an array are.

    Attributes:
        holds: "bits" for a pixel to a value, of 0 and 1, or of 0 and 255; "sums" for counts.
        lowest: the smallest value of the sample.
        highest: the largest value of the sample.
        n_values: values of the sample.
    """

    holds: Literal["bits", "sums"]
    lowest: int
    highest: int
    n_values: int


def unpacked_content(samples: Sequence[NDArray[Any]]) -> Content | None:
    """Return what the values of an array are if they are not bytes of eight pixels each.

    Args:
        samples: runs of consecutive frames, each (n, rows, columns), of integers or bool.

    Returns:
        None for packed pixels, and where too few pixels are lit to tell.
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


def packed_frames_are_last(
    samples: Sequence[NDArray[np.uint8]], shape: Sequence[int], a_byte_holds: Literal["pixels", "frames"]
) -> bool:
    """Return whether the last axis of an array of bytes is that of the frames: see `frames_are_last`.

    Args:
        samples: runs of consecutive frames as they would lie along the first axis, each (n, rows, bytes of a row).
        shape: that of the array.
        a_byte_holds: whether a byte would hold eight pixels of a frame, or a pixel of eight frames.
    """
    first, second, last = shape
    if a_byte_holds == "frames":
        return _last_is_longest(first, second, 8 * last) and _last_is_alike(_lit(samples), (_BLOCK, _BLOCK, 1))
    if not _last_is_longest(first, 8 * second, last):
        return False
    if _last_is_alike(_lit(samples), (_BLOCK, 1, _BLOCK)):
        return True
    # The frames may move too fast for that. Then the second axis, where bytes are packed, is still an axis of the image.
    other = other_order(samples)
    return other is not None and other.order.packed_along == "height"


def _lit(samples: Sequence[NDArray[np.uint8]]) -> list[NDArray[np.uint8]]:
    return [np.bitwise_count(each) for each in samples]


def _last_is_longest(first: int, second: int, last: int) -> bool:
    return last > _TIMES_LONGER * max(first, second)


def _last_is_alike(samples: Sequence[NDArray[Any]], block: tuple[int, int, int]) -> bool:
    """Return whether neighbouring blocks of values correlate most along the last axis."""
    first, second, last = np.sum([_moments(_blocks(each, block)) for each in samples], axis=0)
    correlations = [_correlation(moments) for moments in (first, second, last)]
    if not all(correlations):
        return False
    lead = correlations[2] - max(correlations[:2])
    return lead > _MIN_LEAD * math.sqrt(2 / float(last[0]))


def _blocks(frames: NDArray[Any], block: tuple[int, int, int]) -> NDArray[np.float64]:
    """Return the means of blocks of values: (n, rows, columns) becomes smaller by the sides of a block."""
    shape = [length // side for length, side in zip(frames.shape, block, strict=True)]
    cut = frames[tuple(slice(n * side) for n, side in zip(shape, block, strict=True))]
    in_blocks = cut.reshape(shape[0], block[0], shape[1], block[1], shape[2], block[2])
    return np.asarray(in_blocks.mean(axis=(1, 3, 5)))


def _moments(blocks: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (3, 6) sums over neighbours along the first, second and last axis: 1, x, y, x^2, y^2, x y."""
    rows = []
    for axis in range(3):
        along = np.moveaxis(blocks, axis, 0)
        x, y = along[:-1], along[1:]
        rows.append([x.size, *(each.sum() for each in (x, y, x * x, y * y, x * y))])
    return np.array(rows, np.float64)


def _correlation(moments: NDArray[np.float64]) -> float:
    """Return the correlation of neighbours; 0 if there are none, or no scatter."""
    if not moments[0]:
        return 0.0
    x, y, xx, yy, xy = moments[1:] / moments[0]
    scatter = float(np.sqrt(max(0.0, (xx - x * x) * (yy - y * y))))
    return float(xy - x * y) / scatter if scatter > 0 else 0.0
