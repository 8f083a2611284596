"""Sums of frames: their chunks, cache, footprints and warps."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from photonpano import FrameSpan, InputError
from photonpano.geometry import Canvas, corner_displacements, from_parameters, inverse, transform_points, translation
from photonpano.merging import CountsCache, chunks_of
from photonpano.merging.warping import Footprint, Grid, Texture, add_warped, footprints_of

SHAPE = (30, 40)


def test_chunks_of_splits_pan_where_it_moved_by_tolerance(pan: Callable) -> None:
    chunks = chunks_of(FrameSpan(10, 20), pan(0.125), SHAPE, 0.5)
    assert [chunk.span for chunk in chunks] == [FrameSpan(10, 14), FrameSpan(14, 18), FrameSpan(18, 20)]
    # Each is warped as the camera stood at its centre.
    np.testing.assert_allclose(chunks[0].homography, translation(0.125 * 11.5, 0))
    (still,) = chunks_of(FrameSpan(5, 105), pan(0), SHAPE, 0.25)
    assert still.span == FrameSpan(5, 105)
    np.testing.assert_array_equal(still.homography, np.eye(3))
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


@pytest.fixture
def counted(memory_source: type) -> tuple[object, list[FrameSpan]]:
    """A source of 20 frames, and the spans that it summed."""
    source = memory_source(np.random.default_rng(0).random((20, 4, 6)) < 0.5)
    summed: list[FrameSpan] = []
    sums = source.counts

    def counts(span: FrameSpan) -> np.ndarray:
        summed.append(span)
        if span.start == 7:
            raise InputError("a damaged block")
        return sums(span)

    source.counts = counts
    return source, summed


def test_counts_cache_computes_sum_once_for_concurrent_threads(counted: tuple) -> None:
    source, summed = counted
    shared, together = CountsCache(source, 1000), Barrier(4)

    def ask(_: int) -> np.ndarray:
        together.wait()
        return shared(FrameSpan(0, 20))

    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(ask, range(4)))
    assert len(summed) == 1
    assert all(each is found[0] for each in found)


FRAME, GRID = (254, 496), Canvas(300, 700, np.eye(3))


def footprints(to_grid: np.ndarray) -> list[Footprint]:
    return footprints_of(GRID, None, to_grid, FRAME)


IMAGE = np.random.default_rng(0).random((23, 37)).astype(np.float32)


def interpolated(image: np.ndarray, to_image: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Interpolate an image, with zeros around it, at each pixel of a grid."""
    padded = np.pad(image.astype(np.float64), 2)
    y, x = np.mgrid[: shape[0], : shape[1]]
    seen = transform_points(to_image, np.stack([x.ravel(), y.ravel()], axis=-1).astype(float)) + 2
    u, v = (np.clip(seen[:, axis], 0, padded.shape[1 - axis] - 2) for axis in (0, 1))
    left, top = np.floor(u).astype(int), np.floor(v).astype(int)
    a, b = u - left, v - top
    upper = (1 - a) * padded[top, left] + a * padded[top, left + 1]
    lower = (1 - a) * padded[top + 1, left] + a * padded[top + 1, left + 1]
    return ((1 - b) * upper + b * lower).reshape(shape)


def warped(image: np.ndarray, to_image: np.ndarray, shape: tuple[int, int], seen: np.ndarray | None = None) -> Grid:
    """Warp an image, and its share of each pixel times 3, onto a grid of zeros."""
    grid, footprint = Grid.zeros(Canvas(*shape, np.eye(3)), 1), Footprint(1, to_image, range(shape[0]), (range(shape[1]),))
    textures = [None if each is None else Texture.of(each) for each in (image, seen)]
    add_warped(textures[0], textures[1], np.array([3.0]), footprint, grid)
    return grid


@settings(max_examples=60)
@given(
    x=st.floats(-45, 45),
    y=st.floats(-30, 30),
    linear=st.lists(st.floats(-0.15, 0.15), min_size=4, max_size=4),
    perspective=st.lists(st.floats(-1e-3, 1e-3), min_size=2, max_size=2),
)
def test_add_warped_equals_bilinear_interpolation(x: float, y: float, linear: list[float], perspective: list[float]) -> None:
    to_image = np.array([[1 + linear[0], linear[1], x], [linear[2], 1 + linear[3], y], [*perspective, 1]])
    grid = warped(IMAGE, to_image, (31, 53), seen=IMAGE > 0.5)
    np.testing.assert_allclose(grid.total, interpolated(IMAGE, to_image, (31, 53)), atol=1e-4)
    np.testing.assert_allclose(grid.coverages[0], 3 * interpolated(IMAGE > 0.5, to_image, (31, 53)), atol=4e-4)


@pytest.mark.parametrize("shift", [(0, 0), (3, -5), (2.25, 1.5), (-0.5, 0.5), (36.5, 0), (37, 0), (0, -22.5), (200, 0)])
def test_add_warped_is_exact_up_to_the_border(shift: tuple[float, float]) -> None:
    grid = warped(IMAGE, translation(*shift), (40, 60))
    np.testing.assert_allclose(grid.total, interpolated(IMAGE, translation(*shift), (40, 60)), atol=2e-5)
    whole = np.ones(IMAGE.shape)
    np.testing.assert_allclose(grid.coverages[0], 3 * interpolated(whole, translation(*shift), (40, 60)), atol=2e-5)


def test_places_on_a_wide_grid_are_exact_to_a_thousandth_of_a_pixel() -> None:
    ramp = np.tile(np.arange(64, dtype=np.float32), (16, 1))
    to_image = np.array([[0.5, 0.001, -20_000.25], [0, 1, 0], [0, 0, 1]])
    grid = warped(ramp, to_image, (16, 40_200))
    inside = slice(40_010, 40_110)
    np.testing.assert_allclose(grid.total[5, inside], 0.5 * np.arange(40_200)[inside] + 0.005 - 20_000.25, atol=0.01)
