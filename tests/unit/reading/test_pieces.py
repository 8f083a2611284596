"""Frames in pieces, pixels in another order, and samples of them."""

import time
from collections.abc import Callable
from pathlib import Path
from threading import Lock

import numpy as np
import pytest

from photonpano import FrameSpan, InputError
from photonpano.reading import Pieces, PixelOrder, npy_header, other_order, sampled_frames, sampled_spans
from photonpano.testing.captures import detected

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


def test_a_short_span_fetches_no_more_than_itself_or_its_piece_where_parts_cannot_be() -> None:
    fetched = Fetched()
    pieces = Pieces(STARTS, fetched)
    read(pieces, 503, 505)
    assert fetched.settled() == {503, 504}
    read(pieces, 100, 140)
    assert fetched.settled() == {503, 504, *range(100, 140)}
    whole = Fetched()
    read(Pieces(STARTS, whole, in_parts=False), 503, 505)
    assert whole.settled() == set(range(500, 510))


def test_spans_that_go_on_from_another_are_fetched_ahead_once() -> None:
    fetched = Fetched()
    pieces = Pieces(STARTS, fetched)
    for start in range(0, 30, 2):
        read(pieces, start, start + 2)
    assert len(fetched.settled()) > 30
    assert len(fetched.spans) == len(set(fetched.spans))


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


ORDERS = {
    PixelOrder(along, order): (axis, order) for along, axis in (("width", 2), ("height", 1)) for order in ("big", "little")
}


USUAL = PixelOrder("width", "big")


def samples_of(frames: np.ndarray, order: PixelOrder = USUAL) -> list[np.ndarray]:
    axis, bit_order = ORDERS[order]
    packed = np.packbits(frames, axis=axis, bitorder=bit_order)
    return [packed[span.start : span.stop] for span in sampled_spans(len(packed), packed[0].size)]


@pytest.mark.parametrize("expected", ORDERS)
@pytest.mark.parametrize("stored", ORDERS)
@pytest.mark.parametrize("flux", [1.0, 0.03])
def test_stored_order_is_found_whichever_was_expected(
    clouds: Callable[..., np.ndarray], stored: PixelOrder, expected: PixelOrder, flux: float
) -> None:
    found = other_order(samples_of(clouds(flux), stored), expected)
    assert (found and found.order) == (None if stored == expected else stored)


def test_figures_are_correlations_within_and_across_bytes(clouds: Callable[..., np.ndarray]) -> None:
    found = other_order(samples_of(clouds(), PixelOrder("width", "little")))
    assert found is not None
    assert found.found == pytest.approx(found.within, abs=0.05)
    assert found.expected < found.within / 2
    assert str(found) == (
        f"pixels correlate by {found.within:.2f} within bytes, by {found.expected:.2f} across their borders, and by "
        f"{found.found:.2f} across their borders if the first pixel is the lowest bit"
    )


Y, X = np.mgrid[:64, :96]
PLAIN = {
    "uniform": 1 + 0 * X,
    "gradient": X / 48,
    "vignette": np.exp(-((X - 48) ** 2 + (Y - 32) ** 2) / 1000),
    "columns": np.random.default_rng(0).gamma(4, 0.25, (1, 96)) + 0 * X,
    "rows": np.random.default_rng(0).gamma(4, 0.25, (64, 1)) + 0 * X,
    "pixels": np.random.default_rng(0).gamma(4, 0.25, (64, 96)),
    "hot pixels": np.where(np.random.default_rng(0).random((64, 96)) < 0.05, 1000, 1),
    "a gap every eight columns": np.where(X % 8, 1, 0.2),
    **{f"vertical stripes of {period} px": 1 + 0.8 * (X % period < period / 2) for period in (2, 3, 5, 8, 15, 16)},
    **{f"horizontal stripes of {period} px": 1 + 0.8 * (Y % period < period / 2) for period in (2, 5, 8)},
    **{f"tilted stripes of {period} px": 1 + 0.8 * np.sin((X + 0.4 * Y) * 2 * np.pi / period) for period in (3, 5, 7, 15)},
    **{f"chequers of {side} px": 1 + 0.8 * ((X // side + Y // side) % 2) for side in (1, 4, 5, 8)},
}


@pytest.mark.parametrize("flux", [1.0, 0.1, 0.003])
@pytest.mark.parametrize("scene", PLAIN)
def test_no_order_is_found_in_noise_plain_light_and_regular_patterns(scene: str, flux: float) -> None:
    assert other_order(samples_of(detected(np.broadcast_to(flux * PLAIN[scene], (256, 64, 96)), 1))) is None


def test_file_that_is_cut_short_is_not_sampled(tmp_path: Path) -> None:
    np.save(tmp_path / "cube.npy", np.zeros((50, 8, 40), np.uint8))
    header = npy_header(tmp_path / "cube.npy")
    (tmp_path / "cube.npy").write_bytes((tmp_path / "cube.npy").read_bytes()[:-1])
    assert sampled_frames(tmp_path / "cube.npy", header) == []
