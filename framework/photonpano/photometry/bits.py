"""Compiled loops over packed bits: sums, and reordering.

Bits are summed by carry-save adders (Harley and Seal; Warren, Hacker's Delight, section 5-1), eight frames at a time. An adder
takes three bits of one weight and leaves a bit of that weight and one of twice the weight, for 64 pixels in five operations on
words. Counters are columns of bits: word k of a pixel holds the bit of weight 2^k of its count.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photonpano.compiling import compiled

_BYTES = 2048  # bytes of a frame that are summed at a time, so that all rows of the sum fit into the level 1 cache
_WORDS = _BYTES // 8
_ROWS = 12  # rows of a stage: eight of input, three of counter, and the carry, of eight times the weight
_STAGES = 3  # stages, which count ones, eights and sixty-fours


@compiled
def sum_bits(packed: NDArray[np.uint8], n_frames: int, little: bool, counts: NDArray[np.uint8]) -> None:
    """Count in how many packed frames each pixel is lit, at most 255, so that a count fits into a byte.

    `packed`, (n B,), are the bytes of n frames, one after the other; the counts, (8 B,), are output. `little` says whether the
    first pixel of a byte is its lowest bit, and not its highest.
    """
    frame_bytes = len(packed) // n_frames
    stages = np.empty((_STAGES, _ROWS * _WORDS), np.uint64)
    low = np.empty(_WORDS, np.uint64)
    n_bits = 0
    while (1 << n_bits) <= n_frames:
        n_bits += 1
    for start in range(0, frame_bytes, _BYTES):
        size = min(_BYTES, frame_bytes - start)
        _sum_bits(packed, n_frames, frame_bytes, start, size, stages)
        for part in range(_BYTES // _WORDS):
            first = part * _WORDS
            if first < size:
                _transpose(stages, n_bits, first, low)
                if little:
                    _reverse_bytes(low)
                pixels = counts[8 * (start + first) : 8 * (start + min(first + _WORDS, size))]
                _copy(low.view(np.uint8)[: len(pixels)], pixels)


@compiled
def _sum_bits(  # noqa: PLR0917
    packed: NDArray[np.uint8], n_frames: int, frame_bytes: int, start: int, size: int, stages: NDArray[np.uint64]
) -> None:
    """Sum some bytes of all frames; the counters are rows 8 to 10 of each stage."""
    filled = np.zeros(_STAGES, np.int64)
    for stage in range(_STAGES):
        _clear(stages[stage][8 * _WORDS : 11 * _WORDS])
    incoming = stages[0].view(np.uint8)
    for frame in range(0, n_frames, 8):
        for k in range(8):
            row = incoming[k * _BYTES : k * _BYTES + size]
            if frame + k < n_frames:
                first = (frame + k) * frame_bytes + start
                _copy(packed[first : first + size], row)
            else:
                _clear(row)
        _add_eight(stages[0])
        last = frame + 8 >= n_frames
        for stage in range(1, _STAGES):
            rows, k = stages[stage], filled[stage]
            _copy(stages[stage - 1][11 * _WORDS :], rows[k * _WORDS : (k + 1) * _WORDS])
            filled[stage] = k + 1
            if k < 7 and not last:
                break
            _clear(rows[(k + 1) * _WORDS : 8 * _WORDS])
            filled[stage] = 0
            _add_eight(rows)


@compiled
def _add_eight(rows: NDArray[np.uint64]) -> None:
    # All rows lie in one array, at distances known at compile time, so that the loop is vectorised.
    for word in range(_WORDS):
        one, two, four = rows[8 * _WORDS + word], rows[9 * _WORDS + word], rows[10 * _WORDS + word]
        a, one = _add(one, rows[word], rows[_WORDS + word])
        b, one = _add(one, rows[2 * _WORDS + word], rows[3 * _WORDS + word])
        c, two = _add(two, a, b)
        a, one = _add(one, rows[4 * _WORDS + word], rows[5 * _WORDS + word])
        b, one = _add(one, rows[6 * _WORDS + word], rows[7 * _WORDS + word])
        d, two = _add(two, a, b)
        carry, four = _add(four, c, d)
        rows[8 * _WORDS + word], rows[9 * _WORDS + word], rows[10 * _WORDS + word] = one, two, four
        rows[11 * _WORDS + word] = carry


@compiled
def _copy(source: NDArray[np.generic], target: NDArray[np.generic]) -> None:
    for j in range(len(source)):
        target[j] = source[j]


@compiled
def _clear(target: NDArray[np.generic]) -> None:
    for j in range(len(target)):
        target[j] = 0


@compiled
def _add(a: np.uint64, b: np.uint64, c: np.uint64) -> tuple[np.uint64, np.uint64]:
    """Add three bits of one weight, for 64 pixels: (carry, sum)."""
    difference = a ^ b
    return (a & b) | (difference & c), difference ^ c


@compiled
def _reverse_bytes(words: NDArray[np.uint64]) -> None:
    """Put the last of the eight bytes of each word first."""
    for j in range(_WORDS):
        x = words[j]
        x = ((x >> np.uint64(8)) & np.uint64(0x00FF00FF00FF00FF)) | ((x & np.uint64(0x00FF00FF00FF00FF)) << np.uint64(8))
        x = ((x >> np.uint64(16)) & np.uint64(0x0000FFFF0000FFFF)) | ((x & np.uint64(0x0000FFFF0000FFFF)) << np.uint64(16))
        words[j] = (x >> np.uint64(32)) | (x << np.uint64(32))


@compiled
def _transpose(stages: NDArray[np.uint64], n_bits: int, first: int, counts: NDArray[np.uint64]) -> None:
    """Turn rows of bits into counts: byte i of word j becomes the count of pixel i of byte `first + j` of a frame.

    The bits of eight pixels are an 8 x 8 matrix, whose transpose (Hacker's Delight, section 7-3) has a row for each pixel.
    """
    # Byte 7 - k of a word holds the bits of weight 2^k.
    for k in range(8):
        shift = np.uint64(8 * (7 - k))
        if k >= n_bits:
            break
        bits = stages[k // 3].view(np.uint8)[(8 + k % 3) * _BYTES + first : (8 + k % 3) * _BYTES + first + _WORDS]
        if k == 0:
            for j in range(_WORDS):
                counts[j] = np.uint64(bits[j]) << shift
        else:
            for j in range(_WORDS):
                counts[j] |= np.uint64(bits[j]) << shift
    for j in range(_WORDS):
        x = counts[j]
        t = x ^ (x << np.uint64(36))
        x ^= np.uint64(0xF0F0F0F00F0F0F0F) & (t ^ (x >> np.uint64(36)))
        t = np.uint64(0xCCCC0000CCCC0000) & (x ^ (x << np.uint64(18)))
        x ^= t ^ (t >> np.uint64(18))
        t = np.uint64(0xAA00AA00AA00AA00) & (x ^ (x << np.uint64(9)))
        x ^= t ^ (t >> np.uint64(9))
        counts[j] = x


@compiled
def reverse_bits(source: NDArray[np.uint8], target: NDArray[np.uint8]) -> None:
    """Write bytes (n,) to a target (n,), the bits of each in reverse (Hacker's Delight, section 7-1)."""
    for j in range(len(source)):
        x = np.uint32(source[j])
        x = ((x >> np.uint32(1)) & np.uint32(0x55)) | ((x & np.uint32(0x55)) << np.uint32(1))
        x = ((x >> np.uint32(2)) & np.uint32(0x33)) | ((x & np.uint32(0x33)) << np.uint32(2))
        target[j] = (x >> np.uint32(4)) | (x << np.uint32(4))


@compiled
def transpose_bits(source: NDArray[np.uint8], target: NDArray[np.uint8]) -> None:
    """Pack along the rows of an image what is packed along its columns (Hacker's Delight, section 7-3).

    The bits of a byte of the source (rows, columns) are eight pixels of a column, the first the highest; the target is
    (8 rows, ceil(columns / 8)).
    """
    rows, columns = source.shape
    for row in range(rows):
        for byte in range(target.shape[1]):
            x = np.uint64(0)
            for k in range(min(8, columns - 8 * byte)):
                x |= np.uint64(source[row, 8 * byte + k]) << np.uint64(8 * (7 - k))
            t = (x ^ (x >> np.uint64(7))) & np.uint64(0x00AA00AA00AA00AA)
            x ^= t ^ (t << np.uint64(7))
            t = (x ^ (x >> np.uint64(14))) & np.uint64(0x0000CCCC0000CCCC)
            x ^= t ^ (t << np.uint64(14))
            t = (x ^ (x >> np.uint64(28))) & np.uint64(0x00000000F0F0F0F0)
            x ^= t ^ (t << np.uint64(28))
            for k in range(8):
                target[8 * row + k, byte] = np.uint8((x >> np.uint64(8 * (7 - k))) & np.uint64(255))
