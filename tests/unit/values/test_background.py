"""Which parts of frames show the background, between the instants at which it is known."""

import numpy as np

from photonpano.values import Background, FrameSpan

SHAPE = (20, 30)


def hidden_at(*places: tuple[int, int, int]) -> Background:
    """At the instants 10, 20, 30 and 40, cells (instant, row, column) are hidden; the panorama shows all of them."""
    shown = np.ones((4, 3, 4), bool)
    for place in places:
        shown[place] = False
    return Background(np.array([10.0, 20.0, 30.0, 40.0]), shown, np.ones_like(shown), SHAPE)


def test_spans_are_hidden_where_any_instant_in_them_is() -> None:
    assert not hidden_at((1, 0, 2), (2, 1, 1)).cells(FrameSpan(0, 50))[[0, 1], [2, 1]].any()


def test_pixels_are_those_of_cells_of_8_px_and_the_last_ones_are_cut_off() -> None:
    background = hidden_at((0, 2, 3))
    pixels = background.pixels(FrameSpan(0, 1))
    assert pixels is not None
    np.testing.assert_array_equal(np.argwhere(pixels == 0), [(y, x) for y in range(16, 20) for x in range(24, 30)])
    assert background.pixels(FrameSpan(40, 50)) is None
