import tracemalloc
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from photonpano import CanvasTooLargeError, FrameSpan, InputError, LocationError, Panorama
from photonpano.execution.context import Context, Quiet
from photonpano.geometry import Canvas, from_parameters, transform_points, translation
from photonpano.merging import MergeRenderer, accumulate
from photonpano.merging.panorama import BYTES_PER_PIXEL, Thumbnail, Tile, plan_canvas, render, render_tiles, tiles_of
from photonpano.photometry import tone_mapped

SHAPE = (30, 40)
N = 60
ALL = FrameSpan(0, N)
GIB = 1024**3


def test_plan_canvas_holds_frames_of_span_only_in_one_tile_if_it_fits(pan: Callable) -> None:
    """At 2 px per frame, frames 10 to 19 span 18 px and a frame."""
    canvas = plan_canvas(pan(2), FrameSpan(10, 20), SHAPE, 1.0, GIB)
    assert canvas.shape == (30, 40 + 18)
    np.testing.assert_array_equal(canvas.transform, translation(-20, 0))
    (tile,), reduction = tiles_of(canvas, canvas.height * canvas.width * BYTES_PER_PIXEL)
    assert (tile.left, tile.top, tile.canvas, reduction) == (0, 0, canvas, 1)


def test_plan_canvas_refuses_canvas_far_beyond_memory(pan: Callable) -> None:
    """40,000 px wide and 50,000 high at scale 10."""
    with pytest.raises(CanvasTooLargeError) as caught:
        plan_canvas(pan(3960 / (N - 1), 4970 / (N - 1)), ALL, SHAPE, 10.0, 2 * GIB)
    assert str(caught.value) == (
        "the panorama would have 50000x40000 px, 37 times what fits into the 2 GiB of run.memory; "
        "up to 16 times is rendered in tiles. More often means that the motion is wrong. "
        "Raise run.memory, lower render.scale from 10 to 6.5, "
        "or choose a render.reference nearer to the middle of the motion"
    )


def test_plan_canvas_suggests_no_scale_that_specs_refuse(pan: Callable) -> None:
    with pytest.raises(CanvasTooLargeError, match=r"Raise run\.memory, or choose a render\.reference"):
        plan_canvas(pan(1e5), ALL, SHAPE, 1.0, GIB // 4096)


@pytest.mark.parametrize(("scale", "memory"), [(8.0, GIB // 8), (1.0, GIB // 256), (0.9, GIB // 256)])
def test_plan_canvas_suggests_largest_scale_that_fits(pan: Callable, scale: float, memory: int) -> None:
    with pytest.raises(CanvasTooLargeError) as caught:
        plan_canvas(pan(5), ALL, (1000, 2000), scale, memory)
    suggested = float(str(caught.value).split(f"render.scale from {scale:g} to ")[1].split(",")[0])
    plan_canvas(pan(5), ALL, (1000, 2000), suggested, memory)
    with pytest.raises(CanvasTooLargeError):
        plan_canvas(pan(5), ALL, (1000, 2000), 1.1 * suggested, memory)


def test_plan_canvas_refuses_turn_to_the_horizon(known_motion: type) -> None:
    motion = known_motion(lambda frame: from_parameters([0, 0, 0, 0, 0, 0, -frame / N / 20, 0]))
    with pytest.raises(LocationError) as caught:
        plan_canvas(motion, ALL, SHAPE, 1.0, GIB)
    assert str(caught.value) == (
        "the motion turns so far away from the reference frame that a flat panorama cannot show it "
        "(homography 59 of 60 sends part of its frame behind the reference plane); "
        "choose a render.reference in the middle of the motion, or fewer frames"
    )


@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_plan_canvas_of_reference_is_its_frame(pan: Callable, scale: float) -> None:
    canvas = plan_canvas(pan(2), ALL, SHAPE, scale, GIB, extent="reference")
    assert canvas.shape == (30 * scale, 40 * scale)
    np.testing.assert_allclose(canvas.transform, plan_canvas(pan(0), ALL, SHAPE, scale, GIB).transform, atol=1e-12)


def test_plan_canvas_of_box_is_part_of_panorama(pan: Callable) -> None:
    canvas = plan_canvas(pan(2), ALL, SHAPE, 1.0, GIB, extent=(-5, 10, 55, 25))
    assert canvas.shape == (15, 60)
    np.testing.assert_array_equal(canvas.transform, translation(5, -10))


@pytest.mark.parametrize("box", [(158, 0, 170, 30), (-9, 0, 0, 30), (0, 30, 40, 31), (0, -4, 40, 0)])
def test_plan_canvas_refuses_box_outside_panorama(pan: Callable, box: tuple[int, int, int, int]) -> None:
    with pytest.raises(InputError) as caught:
        plan_canvas(pan(2), ALL, SHAPE, 2.0, GIB, extent=box)
    assert str(caught.value) == (
        f"{list(box)} lies outside the panorama, which holds x from 0 to 157 and y from 0 to 29, "
        "in pixels of the reference frame"
    )


def test_render_of_box_equals_part_of_panorama(panning: Any, pan: Callable) -> None:
    whole, _ = rendered(panning, pan(1))
    canvas = plan_canvas(pan(1), ALL, SHAPE, 1.0, GIB, extent=(20, 5, 50, 25))
    part = render(panning, pan(1), ALL, canvas, 0.25, Context())
    np.testing.assert_allclose(part.flux, whole.flux[5:25, 20:50], rtol=1e-4)
    np.testing.assert_allclose(part.weight, whole.weight[5:25, 20:50], rtol=1e-5)


def scene(width: int) -> np.ndarray:
    """Mean counts of stripes 8 px wide: (30, width)."""
    return np.tile(np.where(np.arange(width) // 8 % 2, 0.8, 0.2), (SHAPE[0], 1))


@pytest.fixture(scope="module")
def panning(memory_source: type) -> Any:
    """Frame t shows the scene from column t on."""
    rng, wide = np.random.default_rng(0), scene(SHAPE[1] + N)
    return memory_source(np.array([rng.random(SHAPE) < wide[:, start : start + SHAPE[1]] for start in range(N)]))


def rendered(source: Any, motion: Any, scale: float = 1.0, span: FrameSpan = ALL) -> tuple[Panorama, Canvas]:
    canvas = plan_canvas(motion, span, SHAPE, scale, GIB)
    return render(source, motion, span, canvas, 0.25, Context()), canvas


def test_render_shows_scene_with_binomial_noise(panning: Any, pan: Callable) -> None:
    panorama, canvas = rendered(panning, pan(1))
    assert canvas.shape == panorama.flux.shape == (30, 40 + N - 1)
    np.testing.assert_allclose(panorama.weight[0], np.minimum(np.arange(99), 98 - np.arange(99)).clip(max=39) + 1, rtol=1e-5)
    weight = panorama.weight[:, 10:-10]
    # Flux is estimated with half a dark frame more, so that it is not biased.
    mean_count = panning.response.mean_count(panorama.flux)[:, 10:-10] * (1 + 0.5 / weight)
    error = mean_count - scene(99)[:, 10:-10]
    # The rule for saturated pixels pulls few of them by half a photon.
    assert abs(error.mean()) < 4 * np.sqrt(0.16 / weight.sum()) + 1e-3
    assert (error * np.sqrt(weight)).std() == pytest.approx(np.sqrt(0.16), rel=0.1)


def test_render_ignores_frames_beyond_span(panning: Any, pan: Callable) -> None:
    panorama, _ = rendered(panning, pan(1), span=FrameSpan(10, 20))
    assert panorama.weight.max() == pytest.approx(10)
    assert panorama.weight.sum() == pytest.approx(10 * 30 * 40)


def test_render_at_twice_the_scale_keeps_brightness(panning: Any, pan: Callable) -> None:
    panorama, canvas = rendered(panning, pan(1), scale=2.0)
    assert canvas.shape == panorama.flux.shape == (60, 2 * 99)
    mean_count = panning.response.mean_count(panorama.flux)
    # The middle of a stripe is as bright as it is at scale 1.
    bright = [mean_count[10:50, 2 * column : 2 * column + 2].mean() for column in (44, 60)]
    dark = [mean_count[10:50, 2 * column : 2 * column + 2].mean() for column in (36, 52)]
    np.testing.assert_allclose(bright, 0.8, atol=0.03)
    np.testing.assert_allclose(dark, 0.2, atol=0.03)


@pytest.mark.parametrize("motion", [(1, 0.0), (0.2, 1.5)], ids=["wide", "high"])
@pytest.mark.parametrize("scale", [1.0, 1.7])
def test_render_tiles_equals_render(panning: Any, known_motion: type, motion: tuple[float, float], scale: float) -> None:
    right, down = motion
    turning = known_motion(lambda t: from_parameters([1e-4 * t, 2e-4 * t, -2e-4 * t, 0, right * t, down * t, 1e-6 * t, 0]))
    canvas = plan_canvas(turning, ALL, SHAPE, scale, GIB)
    whole = render(panning, turning, ALL, canvas, 0.25, Context())
    tiles, reduction = tiles_of(canvas, canvas.height * canvas.width * BYTES_PER_PIXEL // 3)
    assert len(tiles) > 2
    flux, weight = np.zeros(canvas.shape), np.zeros(canvas.shape)
    shown = Thumbnail(canvas, reduction)
    two = Context(2)
    parts = render_tiles(MergeRenderer(two.in_order), panning, turning, ALL, tiles, 0.25, two)
    for tile, part in zip(tiles, parts, strict=True):
        box = np.s_[tile.top : tile.top + tile.canvas.height, tile.left : tile.left + tile.canvas.width]
        flux[box], weight[box] = part.flux, part.weight
        shown.add(tile, part, 0.1 * part.flux)
    np.testing.assert_allclose(weight, whole.weight, rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(flux, whole.flux, rtol=1e-3, atol=1e-4)
    single = Thumbnail(canvas, reduction)
    flux, weight = flux.astype(np.float32), weight.astype(np.float32)
    single.add(Tile(0, 0, canvas), Panorama(flux, weight, canvas.transform), 0.1 * flux)
    np.testing.assert_allclose(shown.panorama.flux, single.panorama.flux, rtol=1e-6)
    np.testing.assert_allclose(shown.panorama.weight, single.panorama.weight, rtol=1e-6)


@pytest.mark.parametrize("n_tiles", [1, 2])
def test_render_of_rolled_frames_does_not_depend_on_threads(memory_source: type, known_motion: type, n_tiles: int) -> None:
    """Warps of parts of the grid are rounded by where the parts start: these must not depend on the threads."""
    frames = np.random.default_rng(2).random((40, 150, 60)) < 0.4
    source = memory_source(frames)
    roll = known_motion(lambda frame: np.array([[1, -0.002 * frame, 0.3 * frame], [0.002 * frame, 1, 0.1], [1e-5, 0, 1]]))
    canvas = plan_canvas(roll, source.info.span, source.info.frame_shape, 1.0, 2**30)
    tiles, _ = tiles_of(canvas, BYTES_PER_PIXEL * canvas.height * canvas.width // (1 if n_tiles == 1 else 2))
    assert (len(tiles) > 1) == (n_tiles > 1)
    one, *others = (
        list(render_tiles(MergeRenderer(context.in_order), source, roll, source.info.span, tiles, 0.1, context))
        for context in map(Context, (1, 2, 3, 5))
    )
    for other in others:
        for part, same in zip(one, other, strict=True):
            np.testing.assert_array_equal(part.flux, same.flux)
            np.testing.assert_array_equal(part.weight, same.weight)


def test_thumbnail_averages_seen_pixels() -> None:
    flux = np.array([[1, 3, np.nan], [np.nan, 5, np.nan], [4, 4, 8]], np.float32)
    canvas = Canvas(3, 3, translation(2, 1))
    shown = Thumbnail(canvas, 2)
    weight = np.where(np.isnan(flux), 0, 8).astype(np.float32)
    shown.add(Tile(0, 0, canvas), Panorama(flux, weight, canvas.transform), flux / 2)
    np.testing.assert_array_equal(shown.panorama.flux, [[3, np.nan], [4, 8]])
    np.testing.assert_array_equal(shown.panorama.weight, [[6, 0], [4, 2]])
    np.testing.assert_array_equal(shown.std, [[1.5, np.nan], [2, 4]])
    # The centre of the first square lies between the pixels 0 and 1.
    np.testing.assert_allclose(transform_points(shown.panorama.canvas, [[-1.5, -0.5]]), [[0, 0]], atol=1e-12)


@pytest.mark.parametrize("size", [(3000, 40_000), (50_000, 3000), (3001, 3003)])
@pytest.mark.parametrize("excess", [1.01, 3, 16])
def test_tiles_of_fit_into_memory_with_thumbnail(size: tuple[int, int], excess: float) -> None:
    canvas, memory = Canvas(*size, np.eye(3)), int(size[0] * size[1] * BYTES_PER_PIXEL / excess)
    tiles, reduction = tiles_of(canvas, memory)
    assert sum(tile.canvas.height * tile.canvas.width for tile in tiles) == size[0] * size[1]
    assert all(tile.left % reduction == tile.top % reduction == 0 for tile in tiles)
    most = max(tile.canvas.height * tile.canvas.width for tile in tiles)
    assert BYTES_PER_PIXEL * (most + size[0] * size[1] / reduction**2) <= memory
    assert len(tiles) <= 4 * excess


def test_render_reports_progress_of_every_frame(panning: Any, pan: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    class Counting(Quiet):
        def __init__(self) -> None:
            self.frames: list[int] = []

        def stage(self, title: str, total: int, unit: str) -> Any:
            self.title = (title, total, unit)
            return self

        def __enter__(self) -> Any:
            return self.frames.append

        def __exit__(self, *_: object) -> None: ...

    progress = Counting()
    motion, span = pan(1), FrameSpan(10, 40)
    monkeypatch.setitem(accumulate.__globals__, "_RUN", 4)
    render(panning, motion, span, plan_canvas(motion, span, SHAPE, 1.0, GIB), 2.0, Context(2, progress))
    assert progress.title == ("panorama", 30, "frames")
    assert progress.frames == [8, 8, 8, 6]


def test_render_takes_no_more_memory_than_predicted(memory_source: type, pan: Callable) -> None:
    """Peak memory for a still camera, at a scale of 2.4 megapixels a frame."""
    source = memory_source(np.random.default_rng(0).random((4, 60, 100)) < 0.5)
    canvas = plan_canvas(pan(0), source.info.span, source.info.frame_shape, 20.0, GIB)
    tracemalloc.start()
    try:
        panorama = render(source, pan(0), source.info.span, canvas, 0.25, Context())
        white = np.quantile(panorama.flux[panorama.weight > 0], 0.995)
        tone_mapped(panorama.flux, float(white))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert 0.5 * BYTES_PER_PIXEL < peak / (canvas.height * canvas.width) < BYTES_PER_PIXEL
