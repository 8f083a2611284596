"""The order of the pixels in the bytes of packed frames, as the frames themselves show it.

Neighbouring pixels are alike. Adjacent bits of a byte are neighbours whatever the order; the bits at the borders of two bytes
are neighbours in the right order only. So in the right order the covariance across borders is that within bytes. In the others,
where the bits are up to 15 px apart, it is less.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from photonpano.photometry import BitOrder

# Minimum score of a difference that is not chance. Scores of noise scatter by 1.2: one in 60,000 exceeds 5.
MIN_SCORE = 5.0
_ROWS = 8  # rows of a unit
_MIN_UNITS = 30  # fewest units whose scatter can be trusted
# Frames of a sum; both are tried: short sums are sharp, long ones less noisy.
_LENGTHS = (16, 128)
_CLIP_QUANTILE = 0.95  # sums are clipped at this quantile: hot pixels must not outweigh the scene
# Minimum score of the best order against each other one, and of pixels within bytes against the expected order.
_MIN_LEAD = 3.0
_FLOOR = 0.2  # units are weighted by their variance, plus this fraction of the mean variance


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


ORDERS = (
    PixelOrder("width", "big"),
    PixelOrder("width", "little"),
    PixelOrder("height", "big"),
    PixelOrder("height", "little"),
)
_WORDS = {
    PixelOrder("width", "big"): "the first pixel is the highest bit",
    PixelOrder("width", "little"): "the first pixel is the lowest bit",
    PixelOrder("height", "big"): "bytes are packed along the height",
    PixelOrder("height", "little"): "bytes are packed along the height, with the first pixel in the lowest bit",
}


def other_order(samples: Sequence[NDArray[np.uint8]], expected: PixelOrder = ORDERS[0]) -> OtherOrder | None:
    """Return the order of the pixels that runs of frames (n, rows, bytes of a row) show instead of the expected one.

    None where that fits, or where the frames are too dark or too plain. Noise, uniform light and static columns have no order;
    stripes and other regular patterns agree with the expected one.
    """
    found = [_other(_Likeness(products), ORDERS.index(expected)) for products in _products_of(samples)]
    scored = [each for each in found if each is not None]
    return max(scored, key=lambda each: each[0])[1] if scored else None


class _Likeness:
    """Products of neighbouring pixels in units of the image, over the variance there."""

    def __init__(self, products: NDArray[np.float32]) -> None:
        *sums, variance = units_of(products)
        seen = variance > 0
        units = np.array(sums)[:, seen] / (variance[seen] + _FLOOR * np.sum(variance) / max(1, seen.sum()))
        self.smooth, self.across, self.within = units[:4], units[4:8], units[8]


def _other(likeness: _Likeness, expected: int) -> tuple[float, OtherOrder] | None:
    """Return the order that fits if the expected one does not, and the score of their difference."""
    smooth, across, within = likeness.smooth, likeness.across, likeness.within
    if not len(within):
        return None
    best = int(np.argmax(smooth.mean(axis=1)))
    lead = score(smooth[best] - smooth[expected])
    if best == expected or min(lead, score(smooth[best])) < MIN_SCORE:
        return None
    leads = [score(smooth[best] - smooth[other]) for other in range(len(ORDERS)) if other != best]
    if min(*leads, score(within - across[expected])) < _MIN_LEAD:
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
        # The counts of the four pairs of pixels of a byte lie in the four bytes of a word.
        words = _PAIRS[frames[: n_sums * _LENGTHS[0]]].reshape(n_sums, _LENGTHS[0], *frames.shape[1:])
        summed: NDArray[np.uint32] = words.sum(axis=1, dtype=np.uint32)
        sums = summed[..., None].view(np.uint8).astype(np.float32)
        for length in _LENGTHS:
            step = length // _LENGTHS[0]
            if step > len(sums):
                break
            longer = sums[: len(sums) // step * step].reshape(-1, step, *sums.shape[1:]).sum(axis=1)
            for image in longer:
                products = _products(image)
                found[length] = found[length] + products if length in found else products
    return list(found.values())


_PAIRS = np.unpackbits(np.arange(256, dtype=np.uint8)).reshape(256, 4, 2).sum(axis=2, dtype=np.uint8).view(np.uint32)[:, 0]


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


def units_of(images: NDArray[np.floating]) -> NDArray[np.floating]:
    """Sum images over units of eight rows and one column, which are nearly independent: (k, H, W) becomes (k, units)."""
    bands = images.shape[1] // _ROWS
    if bands >= 2:
        images = images[:, : bands * _ROWS].reshape(len(images), bands, _ROWS, -1).sum(axis=2)
    return images.reshape(len(images), -1)


def score(values: NDArray[np.floating]) -> float:
    """Return the mean of the values of units in its standard errors; 0 if there are fewer than 30 units, or no scatter."""
    if len(values) < _MIN_UNITS:
        return 0.0
    scatter = float(values.std(ddof=1))
    return float(values.mean()) / scatter * float(np.sqrt(len(values))) if scatter > 0 else 0.0
