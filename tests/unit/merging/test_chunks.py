from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from photonpano import FrameSpan
from photonpano.geometry import corner_displacements, from_parameters, inverse, translation
from photonpano.merging import chunks_of, clipped

SHAPE = (30, 40)


def test_chunks_of_still_camera_is_one_chunk(pan: Callable) -> None:
    (chunk,) = chunks_of(FrameSpan(5, 105), pan(0), SHAPE, 0.25)
    assert chunk.span == FrameSpan(5, 105)
    np.testing.assert_array_equal(chunk.homography, np.eye(3))


def test_chunks_of_splits_pan_where_it_moved_by_tolerance(pan: Callable) -> None:
    chunks = chunks_of(FrameSpan(10, 20), pan(0.125), SHAPE, 0.5)
    assert [chunk.span for chunk in chunks] == [FrameSpan(10, 14), FrameSpan(14, 18), FrameSpan(18, 20)]
    # Each is warped as the camera stood at its centre.
    np.testing.assert_allclose(chunks[0].homography, translation(0.125 * 11.5, 0))


def test_chunks_of_fast_camera_has_one_frame_each(pan: Callable) -> None:
    assert [len(chunk.span) for chunk in chunks_of(FrameSpan(0, 7), pan(3), SHAPE, 0.25)] == [1] * 7


@pytest.mark.parametrize("zoom", [0.5, 2.0])
def test_chunks_of_measures_tolerance_in_frame_pixels(known_motion: type, zoom: float) -> None:
    """The number of chunks does not depend on the scale of the reference plane."""
    motion = known_motion(lambda frame: np.diag([zoom, zoom, 1.0]) @ translation(0.125 * frame, 0))
    assert [len(chunk.span) for chunk in chunks_of(FrameSpan(0, 8), motion, SHAPE, 0.5)] == [4, 4]


wobbles = st.tuples(*[st.floats(-2e-3, 2e-3)] * 4, *[st.floats(-1, 1)] * 2, *[st.floats(-1e-6, 1e-6)] * 2)


@given(
    start=st.integers(0, 1000),
    length=st.integers(1, 60),
    wobble=wobbles,
    drift=wobbles,
    tolerance_px=st.floats(0.05, 8),
)
def test_chunks_of_covers_every_frame_once_within_tolerance(
    known_motion: type, start: int, length: int, wobble: tuple, drift: tuple, tolerance_px: float
) -> None:
    def at(frame: float) -> np.ndarray:
        return from_parameters(np.sin(frame / 7) * np.array(wobble) + 0.1 * frame / 60 * np.array(drift))

    motion = known_motion(at)
    span = FrameSpan(start, start + length)
    chunks = chunks_of(span, motion, SHAPE, tolerance_px)
    assert [chunks[0].span.start, *(chunk.span.stop for chunk in chunks)] == [
        *(chunk.span.start for chunk in chunks),
        span.stop,
    ]
    for chunk in chunks:
        np.testing.assert_array_equal(chunk.homography, at(chunk.span.centre))
        moved = inverse(chunk.homography) @ motion.at(range(chunk.span.start, chunk.span.stop))
        assert corner_displacements(moved, np.eye(3), SHAPE).max() <= tolerance_px * 1.01 + 0.01 * (len(chunk.span) > 1)


def test_clipped_keeps_chunks_inside_span(pan: Callable) -> None:
    motion = pan(0.125)
    chunks = chunks_of(FrameSpan(0, 40), motion, SHAPE, 0.5)
    found = clipped(chunks, FrameSpan(10, 23), motion)
    assert [each.span for each in found] == [FrameSpan(10, 12), FrameSpan(12, 16), FrameSpan(16, 20), FrameSpan(20, 23)]
    assert found[1] is chunks[3]
    for each in found:
        np.testing.assert_allclose(each.homography, translation(0.125 * each.span.centre, 0))


def test_clipped_returns_part_of_chunk_around_span(pan: Callable) -> None:
    chunks = chunks_of(FrameSpan(0, 40), pan(0.125), SHAPE, 4)
    (part,) = clipped(chunks, FrameSpan(33, 39), pan(0.125))
    assert part.span == FrameSpan(33, 39)
    assert clipped(chunks, FrameSpan(0, 40), pan(0.125)) == chunks
