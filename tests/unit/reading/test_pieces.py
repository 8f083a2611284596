from __future__ import annotations

import time
from threading import Lock

import numpy as np
import pytest

from photonpano import FrameSpan, InputError
from photonpano.reading import Pieces

FRAMES = np.arange(1000, dtype=np.uint16).reshape(1000, 1)
STARTS = [*range(0, 1000, 10), 1000]


class Fetched:
    """Fetches frames, and remembers which."""

    def __init__(self) -> None:
        self.spans: list[FrameSpan] = []
        self.lock = Lock()

    def __call__(self, span: FrameSpan) -> np.ndarray:
        with self.lock:
            self.spans.append(span)
        return FRAMES[span.start : span.stop]

    def settled(self) -> set[int]:
        """Return the frames that were fetched once nothing more comes."""
        seen = -1
        while seen != len(self.spans):
            seen = len(self.spans)
            time.sleep(0.05)
        return {frame for span in self.spans for frame in range(span.start, span.stop)}


def read(pieces: Pieces, start: int, stop: int) -> None:
    places, parts = zip(*pieces.of(FrameSpan(start, stop)), strict=True)
    np.testing.assert_array_equal(np.concatenate(parts), FRAMES[start:stop])
    assert [place.start for place in places] == [0, *(place.stop for place in places[:-1])]


def test_frames_of_any_span_are_yielded_in_order() -> None:
    pieces = Pieces(STARTS, Fetched())
    for start, stop in ((0, 1000), (3, 8), (5, 25), (995, 1000), (10, 20)):
        read(pieces, start, stop)
    pieces.close()


def test_a_short_span_fetches_no_more_than_itself() -> None:
    fetched = Fetched()
    pieces = Pieces(STARTS, fetched)
    read(pieces, 503, 505)
    assert fetched.settled() == {503, 504}
    read(pieces, 100, 140)
    assert fetched.settled() == {503, 504, *range(100, 140)}


def test_spans_that_go_on_from_another_are_fetched_ahead_once() -> None:
    fetched = Fetched()
    pieces = Pieces(STARTS, fetched)
    for start in range(0, 30, 2):
        read(pieces, start, start + 2)
    assert len(fetched.settled()) > 30
    assert len(fetched.spans) == len(set(fetched.spans))


def test_a_bounded_number_of_pieces_is_kept() -> None:
    fetched = Fetched()
    pieces = Pieces(STARTS, fetched)
    read(pieces, 0, 1000)
    read(pieces, 0, 10)
    assert fetched.spans.count(FrameSpan(0, 10)) == 2
    read(pieces, 990, 1000)
    assert fetched.spans.count(FrameSpan(990, 1000)) == 1


def test_whole_pieces_are_fetched_where_parts_cannot_be() -> None:
    fetched = Fetched()
    read(Pieces(STARTS, fetched, in_parts=False), 503, 505)
    assert fetched.settled() == set(range(500, 510))


def test_a_piece_that_failed_is_fetched_again() -> None:
    failures = [InputError("no answer")]

    def fetch(span: FrameSpan) -> np.ndarray:
        if failures:
            raise failures.pop()
        return FRAMES[span.start : span.stop]

    pieces = Pieces(STARTS, fetch)
    with pytest.raises(InputError, match="no answer"):
        read(pieces, 0, 10)
    read(pieces, 0, 10)
