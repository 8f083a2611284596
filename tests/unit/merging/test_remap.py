"""Tests of warps onto cylinders and spheres, and through a lens."""

import cv2
import numpy as np
import pytest

from photonpano.capture import seen_through
from photonpano.geometry import (
    Camera,
    Canvas,
    canvas_around,
    canvas_of,
    covered_by,
    rotation_matrices,
    translation,
)
from photonpano.merging import Chunk, accumulate
from photonpano.testing.captures import MemorySource
from photonpano.values import FloatArray, FluxImage, FrameSpan

SHAPE = (48, 64)
CAMERA = Camera.of(60.0, SHAPE)
LENS = Camera.of(60.0, SHAPE, [-0.15, 0.04, 0.003, -0.002])
YAWS = np.arange(0.0, 400, 8)


def brightness(rays: FloatArray) -> FluxImage:
    """Return a smooth brightness of directions, 100 on average."""
    x, y, z = np.moveaxis(rays / np.linalg.norm(rays, axis=-1, keepdims=True), -1, 0)
    return np.asarray(100 + 40 * np.sin(5 * x + 1) * np.cos(4 * z) + 30 * np.sin(6 * y + 2 * z), np.float32)


def rotations(yaws: FloatArray = YAWS, pitch: float = 0.0) -> FloatArray:
    about_y = np.stack([0 * yaws, np.radians(yaws), 0 * yaws], axis=-1)
    wobble = np.stack([np.radians(pitch + 3 * np.sin(yaws)), 0 * yaws, 0.05 * np.cos(yaws)], axis=-1)
    return np.linalg.inv(rotation_matrices(wobble[0])) @ rotation_matrices(about_y) @ rotation_matrices(wobble)


def capture(turns: FloatArray, camera: Camera, valid: np.ndarray | None = None) -> MemorySource:
    """Return a capture of counts without noise, one frame for each rotation."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    ahead = camera.directions(np.stack([x, y], axis=-1).astype(float))
    frames = np.array([np.rint(brightness(ahead @ turn.T)) for turn in turns]).astype(np.uint8)
    return MemorySource(frames, valid)


def chunks(turns: FloatArray, camera: Camera) -> list[Chunk]:
    return [Chunk(FrameSpan(t, t + 1), matrix) for t, matrix in enumerate(camera.homographies(turns))]


def true_on(canvas: Canvas) -> FluxImage:
    (p, s), (q, r, t) = canvas.columns(), canvas.rows()
    rays = np.stack([np.outer(r, p), np.repeat(q[:, None], len(p), axis=1), np.outer(r, s) + t[:, None]], axis=-1)
    return brightness(rays @ np.linalg.inv(canvas.plane_to_rays @ CAMERA.matrix).T)


def assert_shows_the_scene(mean: FluxImage, canvas: Canvas, seen: np.ndarray) -> None:
    """At the border of a frame, its value is that of half a pixel beside."""
    error = np.abs(mean - true_on(canvas))[seen]
    assert np.quantile(error, 0.98) < 1.2
    assert error.max() < 4


def mean_on(canvas: Canvas, source: MemorySource, turns: FloatArray) -> tuple[FluxImage, FluxImage]:
    photons = accumulate(source, chunks(turns, CAMERA), canvas, canvas.shape)
    with np.errstate(invalid="ignore", divide="ignore"):
        return photons.counts / photons.weight, photons.weight


def around(turns: FloatArray, camera: Camera, projection: str = "spherical", scale: float = 1.0) -> Canvas:
    return canvas_around(covered_by(turns, camera, SHAPE), CAMERA, scale, projection)


def alike(turns: FloatArray, valid: np.ndarray | None = None) -> MemorySource:
    """Return frames of the same value everywhere."""
    return MemorySource(np.full((len(turns), *SHAPE), 7, np.uint8), valid)


@pytest.mark.parametrize("projection", ["cylindrical", "spherical", "mercator"])
@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
def test_full_turn_shows_the_scene_without_a_seam(projection: str, camera: Camera) -> None:
    turns = rotations()
    canvas = around(turns, camera, projection)
    mean, weight = mean_on(canvas, seen_through(capture(turns, camera), camera), turns)
    seen = weight > 0.5
    assert seen[len(seen) // 2].all(), "no hole at the seam"
    assert_shows_the_scene(mean, canvas, seen)
    assert seen[:, [0, -1]].mean() > 0.7


@pytest.mark.parametrize("projection", ["panini", "stereographic"])
@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
def test_wide_views_show_the_scene(projection: str, camera: Camera) -> None:
    turns = rotations(np.arange(-70.0, 71, 5))
    turns = np.linalg.inv(turns[14]) @ turns
    canvas = around(turns, camera, projection)
    mean, weight = mean_on(canvas, seen_through(capture(turns, camera), camera), turns)
    seen = weight > 0.5
    assert seen[len(seen) // 2, 5:-5].all()
    assert_shows_the_scene(mean, canvas, seen)


def test_lens_on_a_plane_straightens_frames() -> None:
    turns = rotations(np.arange(-20.0, 21, 5))
    turns = np.linalg.inv(turns[4]) @ turns
    canvas = canvas_of(CAMERA.homographies(turns), SHAPE, 1.0)
    source = seen_through(capture(turns, LENS), LENS)
    mean, weight = mean_on(canvas, source, turns)
    seen = weight > 0.5
    assert_shows_the_scene(mean, canvas, seen)
    # Nothing is folded in from beyond the lens.
    assert seen.mean() > 0.7


def test_counts_and_weight_are_interpolated_alike_at_masks_and_borders() -> None:
    turns = rotations()
    valid = np.random.default_rng(0).random(SHAPE) > 0.2
    canvas = around(turns, CAMERA, scale=1.3)
    mean, weight = mean_on(canvas, alike(turns, valid), turns)
    _, whole = mean_on(canvas, alike(turns), turns)
    assert np.allclose(mean[weight > 1e-3], 7, rtol=1e-3)
    assert weight.sum() == pytest.approx(valid.mean() * whole.sum(), rel=0.02)


def test_part_of_a_canvas_is_the_same_as_that_part_of_the_whole() -> None:
    turns = rotations()
    canvas = around(turns, LENS)
    source = seen_through(capture(turns, LENS), LENS)
    whole = accumulate(source, chunks(turns, CAMERA), canvas, canvas.shape)
    part = canvas.part(canvas.width - 40, 10, 20, 40)
    piece = accumulate(source, chunks(turns, CAMERA), part, part.shape)
    box = np.s_[10:30, canvas.width - 40 :]
    assert np.allclose(piece.counts, whole.counts[box], atol=0.05)
    assert np.allclose(piece.weight, whole.weight[box], atol=1e-3)


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
@pytest.mark.parametrize("run", [1, 5, 64])
def test_runs_of_chunks_add_up_also_across_the_seam(camera: Camera, run: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(accumulate.__globals__, "_RUN", run)
    turns = rotations()
    canvas = around(turns, camera)
    source = seen_through(capture(turns, camera), camera)
    at_once = accumulate(source, chunks(turns, CAMERA), canvas, canvas.shape)
    in_runs = accumulate(source, chunks(turns, CAMERA), canvas, canvas.shape, in_order=map)
    assert np.allclose(in_runs.counts, at_once.counts, atol=0.05)
    assert np.allclose(in_runs.weight, at_once.weight, atol=1e-3)


def test_remap_onto_a_plane_is_that_of_opencv() -> None:
    image = np.random.default_rng(0).random(SHAPE, np.float32)
    matrix = translation(-20, 10) @ CAMERA.homographies(rotation_matrices([0.05, 0.1, 0.2]))
    none = Camera(CAMERA.matrix, np.array([1e-12, 0, 0, 0]))
    canvas = Canvas(60, 80, np.eye(3))
    source = seen_through(MemorySource((image * 255).astype(np.uint8)[None]), none)
    photons = accumulate(source, [Chunk(FrameSpan(0, 1), matrix)], np.eye(3), canvas.shape)
    pixels = (image * 255).astype(np.uint8).astype(np.float32)
    expected = cv2.warpPerspective(pixels, matrix, (80, 60), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    assert np.abs(photons.counts - expected).max() < 0.01 * 255


def test_frames_behind_a_plane_leave_no_ghost() -> None:
    """A part of the plane is rendered of a camera that turns all around."""
    turns = rotations()
    canvas = Canvas(*SHAPE, np.eye(3))
    source = alike(turns)
    photons = accumulate(source, chunks(turns, CAMERA), canvas, canvas.shape)
    ahead = np.degrees(np.arccos(np.clip(turns[:, 2, 2], -1, 1))) < 80
    few = accumulate(source, [chunk for chunk, near in zip(chunks(turns, CAMERA), ahead, strict=True) if near], canvas, SHAPE)
    assert np.allclose(photons.weight, few.weight, atol=1e-3)
    assert np.allclose(photons.counts, few.counts, atol=0.02)


def test_tangential_distortion_moves_pixels_as_the_camera_says() -> None:
    """Frames whose counts are x, or y: on the canvas of ideal pixels, the mean count is the place of the distorted pixel."""
    lens = Camera.of(60.0, SHAPE, [0.0, 0.0, 0.05, -0.03])
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    places = lens.distorted(np.stack([x, y], axis=-1).astype(float))
    canvas, inside = Canvas(*SHAPE, np.eye(3)), ((places > 1) & (places < np.array(SHAPE[::-1]) - 2)).all(axis=-1)
    for axis, ramp in enumerate((x, y)):
        source = seen_through(MemorySource(ramp[None].astype(np.uint8)), lens)
        photons = accumulate(source, [Chunk(FrameSpan(0, 1), np.eye(3))], canvas, SHAPE)
        found = photons.counts[inside] / photons.weight[inside]
        np.testing.assert_allclose(found, places[inside][:, axis], atol=0.01)
