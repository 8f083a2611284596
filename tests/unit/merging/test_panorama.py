import tracemalloc
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from photonpano import CanvasTooLargeError, FrameSpan, InputError, LocationError, Panorama
from photonpano.execution.context import Context
from photonpano.geometry import Canvas, from_parameters, translation
from photonpano.merging import MergeRenderer
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
    two = Context(threads=2)
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
