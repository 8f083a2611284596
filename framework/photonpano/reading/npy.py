"""Read and check headers of .npy files, count the frames that are there, and tell from frames how they are stored."""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from gzip import GzipFile
from io import BytesIO
from typing import IO, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from photonpano.errors import InputError
from photonpano.files.paths import Location, Url
from photonpano.photometry import BitOrder
from photonpano.reading.files import OpenFiles, read_range, read_start, reading, size_of
from photonpano.values import FrameSpan

_HEADER_BYTES = 4096  # bytes of a URL that are read for the header; that of a capture has 128
_SHORTEST_HEADER = 128  # bytes of the shortest header that numpy writes
_CHANNELS = 3
# Minimum score of a difference that is not chance. Scores of noise scatter by 1.2: one in 60,000 exceeds 5.
_MIN_SCORE = 5.0
_ROWS = 8  # rows of a unit
_MIN_UNITS = 30  # fewest units whose scatter can be trusted
# Frames of a sum; both are tried: short sums are sharp, long ones less noisy.
_LENGTHS = (16, 128)
_CLIP_QUANTILE = 0.95  # sums are clipped at this quantile: hot pixels must not outweigh the scene
# Minimum score of the best order against each other one, and of pixels within bytes against the expected order.
_MIN_LEAD_OF_ORDER = 3.0
_FLOOR = 0.2  # units are weighted by their variance, plus this fraction of the mean variance


class NpyHeader(NamedTuple):
    """The header of a .npy file."""

    shape: tuple[int, ...]  # the shape of the array
    dtype: np.dtype[np.generic]  # the type of its values
    fortran_order: bool  # whether the first index varies fastest
    offset: int  # start of the data, in bytes

    @property
    def file_bytes(self) -> int:
        """The size of a complete file."""
        return self.offset + math.prod(self.shape) * self.dtype.itemsize


def npy_header(path: Location) -> NpyHeader:
    """Read the header of a .npy file; an `InputError` if it cannot be read, or is something else."""
    if isinstance(path, Url):
        start = read_range(path, 0, _HEADER_BYTES)
        header = read_npy_header(BytesIO(start))
    elif path.is_dir():
        raise InputError(f"{path} is a folder; name the .npy file in it")
    else:
        with reading(path), path.open("rb") as file:
            header = read_npy_header(file)
    if header is None:
        raise InputError(f"{path} is not a .npy file{_guess(read_start(path, 4))}")
    return header


def read_npy_header(file: IO[bytes] | GzipFile) -> NpyHeader | None:
    """Return the header at the beginning of an open file; None if it is damaged or missing. An `OSError` passes."""
    try:
        version = np.lib.format.read_magic(file)
        # Version 3 differs only for structured types, which no capture has.
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran_order, dtype = read(file)
        return NpyHeader(tuple(map(operator.index, shape)), dtype, fortran_order, file.tell())
    except OSError:
        raise
    except Exception:  # a damaged header makes numpy's parser raise nearly anything
        return None


def require_whole(path: Location, header: NpyHeader) -> None:
    """Raise an `InputError` for a .npy file that is shorter than its header promises."""
    size = size_of(path)
    if size < header.file_bytes:
        raise InputError(
            f"{path} is cut short: its header {header.shape} promises {header.file_bytes} bytes, the file has {size}; "
            "copy or record it again"
        )


def require_frames(path: Location, header: NpyHeader, axes: str) -> None:
    """Raise an `InputError` for an array without values, or not in C order; `axes` is such as "frames, height, width"."""
    if min(header.shape) < 1:
        raise InputError(f"{path} is empty: its shape is {header.shape} ({axes})")
    if header.fortran_order:
        raise InputError(f"{path} is stored in Fortran order; save it again with numpy.ascontiguousarray(cube)")


def has_channels(path: Location, header: NpyHeader) -> bool:
    """Return whether an array has a fourth axis, of three channels; an `InputError` if they lie along another axis."""
    if len(header.shape) == 4 and header.shape[3] != _CHANNELS and _CHANNELS in header.shape:
        axis = header.shape.index(_CHANNELS)
        raise InputError(
            f"{path} has three channels along axis {axis} of its shape {header.shape}; they belong last: save "
            f"numpy.moveaxis(numpy.load(path), {axis}, -1) to another file"
        )
    return len(header.shape) == 4 and header.shape[3] == _CHANNELS


def arrived_frames(path: Location) -> int | None:
    """Return how many whole frames of a .npy file are there that is still being written: None if not even its header is.

    Raises:
        InputError: the file cannot be read, is something else, or cannot be read before it is whole.
    """
    if isinstance(path, Url):
        raise InputError(f"{path} is a URL, which cannot be followed: follow a file, or a pipe")
    if not path.exists() or size_of(path) < _SHORTEST_HEADER:
        return None
    header = npy_header(path)
    n_frames, *of_frame = header.shape or (0,)
    frame_bytes = math.prod(of_frame) * header.dtype.itemsize
    return min(n_frames, (size_of(path) - header.offset) // frame_bytes) if frame_bytes else 0


def _guess(start: bytes) -> str:
    if not start:
        return ": it is empty"
    if start.startswith(b"\x1f\x8b"):
        return ": it is compressed with gzip; unpack it with gunzip"
    if start.startswith(b"\x93NUM"):
        return " that can be read: its header is damaged; write it again"
    return ", by its first bytes; write it with numpy.save"


class PixelOrder(NamedTuple):
    """The order of the pixels in packed frames."""

    packed_along: Literal["width", "height"] = "width"  # the direction of the eight pixels of a byte
    bit_order: BitOrder = "big"  # "big" if the first of them is the highest bit, "little" if it is the lowest


class OtherOrder(NamedTuple):
    """An order of the pixels that the frames show instead of another."""

    order: PixelOrder
    within: float  # correlation of adjacent bits of a byte, photon noise included
    expected: float  # correlation across the borders of bytes in the order that was expected
    found: float  # correlation across them in the order that was found

    def __str__(self) -> str:
        return (
            f"pixels correlate by {self.within:.2f} within bytes, by {self.expected:.2f} across their borders, and by "
            f"{self.found:.2f} across their borders if {_WORDS[self.order]}"
        )


_WORDS = {
    PixelOrder("width", "big"): "the first pixel is the highest bit",
    PixelOrder("width", "little"): "the first pixel is the lowest bit",
    PixelOrder("height", "big"): "bytes are packed along the height",
    PixelOrder("height", "little"): "bytes are packed along the height, with the first pixel in the lowest bit",
}
ORDERS = tuple(_WORDS)


def other_order(samples: Sequence[NDArray[np.uint8]], expected: PixelOrder = ORDERS[0]) -> OtherOrder | None:
    """Return the order of the pixels that runs of frames (n, rows, bytes of a row) show instead of the expected one.

    None where that fits, or where the frames are too dark or too plain. Noise, uniform light and static columns have no order;
    stripes and other regular patterns agree with the expected one.
    """
    found = [_other(products, ORDERS.index(expected)) for products in _products_of(samples)]
    scored = [each for each in found if each is not None]
    return max(scored, key=lambda each: each[0])[1] if scored else None


def _other(products: NDArray[np.float32], expected: int) -> tuple[float, OtherOrder] | None:
    """Return the order that fits if the expected one does not, and the score of their difference."""
    *sums, variance = _units_of(products)
    seen = variance > 0
    if not seen.any():
        return None
    likeness = np.array(sums)[:, seen] / (variance[seen] + _FLOOR * variance[seen].mean())
    smooth, across, within = likeness[:4], likeness[4:8], likeness[8]
    best = int(np.argmax(smooth.mean(axis=1)))
    lead = _score(smooth[best] - smooth[expected])
    if best == expected or min(lead, _score(smooth[best])) < _MIN_SCORE:
        return None
    leads = [_score(smooth[best] - smooth[other]) for other in range(len(ORDERS)) if other != best]
    if min(*leads, _score(within - across[expected])) < _MIN_LEAD_OF_ORDER:
        return None
    correlation, expected_correlation, found = (float(each.mean()) for each in (within, across[expected], across[best]))
    if abs(correlation - found) > (correlation - expected_correlation) / 2:
        return None
    return lead, OtherOrder(ORDERS[best], correlation, expected_correlation, found)


def _products_of(samples: Sequence[NDArray[np.uint8]]) -> list[NDArray[np.float32]]:
    """Return the sums of the products of neighbours in sums of 16 and 128 frames, as far as samples are that long."""
    found: dict[int, NDArray[np.float32]] = {}
    for frames in samples:
        n_sums = len(frames) // _LENGTHS[0]
        bits = np.unpackbits(frames[: n_sums * _LENGTHS[0]], axis=2)
        pixels = (
            bits.reshape(n_sums, _LENGTHS[0], 4 * frames[0].size, 2).sum(axis=1, dtype=np.uint8).sum(axis=2, dtype=np.float32)
        )
        sums = pixels.reshape(n_sums, *frames.shape[1:], 4)  # four pairs of pixels in a byte
        for length in _LENGTHS:
            step = length // _LENGTHS[0]
            if step > len(sums):
                break
            longer = sums[: len(sums) // step * step].reshape(-1, step, *sums.shape[1:]).sum(axis=1)
            for image in longer:
                products = _products(image)
                found[length] = found[length] + products if length in found else products
    return list(found.values())


def _products(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return products of neighbours in an image of pairs (rows, bytes, 4): (10, rows - 1, bytes - 1).

    Across borders in each order, of an image that is smoothed at right angles to its bytes, which lowers the noise; the same of
    the image as it is; within bytes; and the variance.
    """
    image = np.minimum(image, max(1.0, float(np.quantile(image, _CLIP_QUANTILE))))
    image = image - image.mean(axis=0)  # static columns are no scene
    over_rows, over_columns = _smoothed(image, 0), _smoothed(image, 1)
    a, b, c, d = np.moveaxis(image[:-1, :-1], -1, 0)
    within = (a * b + b * c + c * d) / 3
    variance = (a * a + b * b + c * c + d * d) / 4
    smooth = *_across(over_rows, over_rows[:-1, 1:]), *_across(over_columns, over_columns[1:, :-1])
    sharp = *_across(image, image[:-1, 1:]), *_across(image, image[1:, :-1])
    return np.stack([*smooth, *sharp, within, variance])


def _across(image: NDArray[np.float32], next_byte: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the products across the borders of a byte and the next, if the first pixel is the highest bit, and the lowest."""
    byte = image[:-1, :-1]
    return byte[..., 3] * next_byte[..., 0], byte[..., 0] * next_byte[..., 3]


def _smoothed(image: NDArray[np.float32], axis: int) -> NDArray[np.float32]:
    """Add to each value its neighbours along an axis."""
    values = np.moveaxis(image, axis, 0)
    summed = values.copy()
    summed[1:] += values[:-1]
    summed[:-1] += values[1:]
    return np.moveaxis(summed, 0, axis)


def _units_of(images: NDArray[np.floating]) -> NDArray[np.floating]:
    """Sum images over units of eight rows and one column, which are nearly independent: (k, H, W) becomes (k, units)."""
    bands = images.shape[1] // _ROWS
    if bands >= 2:
        images = images[:, : bands * _ROWS].reshape(len(images), bands, _ROWS, -1).sum(axis=2)
    return images.reshape(len(images), -1)


def _score(values: NDArray[np.floating]) -> float:
    """Return the mean of the values of units in its standard errors; 0 if there are fewer than 30 units, or no scatter."""
    if len(values) < _MIN_UNITS:
        return 0.0
    scatter = float(values.std(ddof=1))
    return float(values.mean()) / scatter * float(np.sqrt(len(values))) if scatter > 0 else 0.0


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

_MIN_LEAD = 4.0  # standard errors by which the correlation along the axis of the frames exceeds the others


class Content(NamedTuple):
    """What the values of an array are."""

    holds: Literal["bits", "sums"]  # "bits" for a pixel to a value, of 0 and 1, or of 0 and 255; "sums" for counts
    highest: int  # the largest value of the sample
    n_values: int  # values of the sample


def sampled_frames(path: Location, header: NpyHeader) -> list[NDArray[Any]]:
    """Read runs of consecutive frames from all over a .npy file, whose array has three dimensions or more, in C order.

    Returns arrays (n, rows, columns, ...), 3 million values together. Of large frames, only the first columns are read. An
    empty list where the file is cut short.
    """
    n_frames, n_rows, n_columns, *_ = header.shape
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
        return Content("bits" if (lowest, highest) in ((0, 1), (0, 0), (1, 1)) else "sums", highest, n_values)
    if highest == 1:
        return Content("bits", 1, n_values) if n_lit >= _MIN_BITS else None
    if highest == 255 and not any(((each + np.uint8(1)) > 1).any() for each in samples):
        n_varied = int(np.count_nonzero((peak > 0) & (np.min([each.min(axis=0) for each in samples], axis=0) == 0)))
        return Content("bits", 255, n_values) if n_varied >= _MIN_BITS else None
    if (highest < 128 and n_lit >= _MIN_SUMS) or (highest >= 128 and _are_numbers(samples, peak)):
        return Content("sums", highest, n_values)
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
    return _score(_units_of((excess * pairs)[None])[0]) > _MIN_SCORE


def frames_are_last(samples: Sequence[NDArray[Any]], shape: Sequence[int], packed_axis: int | None = None) -> bool:
    """Return whether the last axis of an array is that of the frames, and the first two are those of the image.

    Eight frames later a pixel is more like itself than the pixel eight rows or columns further, unless the image moves by more
    than a pixel a frame. So the axis along which blocks of values correlate most is that of the frames, if it is the longest.

    Args:
        samples: runs of consecutive frames as they would lie along the first axis, each (n, rows, columns).
        shape: that of the array: (rows, columns, frames).
        packed_axis: the axis of which a byte would hold eight values; None for a pixel to a value.
    """
    lengths, block = list(shape), [_BLOCK] * 3
    values = list(samples)
    if packed_axis is not None:
        lengths[packed_axis], block[packed_axis] = 8 * shape[packed_axis], 1
        values = [np.bitwise_count(each) for each in samples]
    if lengths[2] <= _TIMES_LONGER * max(lengths[:2]):
        return False
    blocks = [_blocks(each, block) for each in values]
    (first, _), (second, _), (last, number) = (_correlation(blocks, axis) for axis in range(3))
    is_alike = bool(first and second and last) and last - max(first, second) > _MIN_LEAD * math.sqrt(2 / number)
    if packed_axis is None or packed_axis == 2:
        return is_alike
    # Bytes of eight pixels are less alike along the axis where they are packed, as they are 8 px apart there.
    pixels = [_blocks(each, (1, 1, _BLOCK)) for each in values]
    if is_alike and _correlation(pixels, packed_axis) < _correlation(pixels, 1 - packed_axis):
        return True
    # The frames may move too fast for that. Then the axis where bytes are packed is still an axis of the image.
    other = other_order(samples if packed_axis == 1 else [each.swapaxes(0, 1) for each in samples])
    return other is not None and other.order.packed_along == "height"


def eight_frames_are_first(samples: Sequence[NDArray[Any]]) -> bool:
    """Return whether the frames of bytes that hold eight of them lie along the first axis, or else along the last.

    Neighbours along both axes of the image are about equally alike, those along the axis of the frames more or less than that.
    """
    first, second, last = (_correlation([np.bitwise_count(each) for each in samples], axis)[0] for axis in range(3))
    return abs(second - last) < abs(first - second)


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
