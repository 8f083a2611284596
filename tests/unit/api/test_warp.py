"""Frames warped along a motion, and panoramas as datasets, against what is known."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import tifffile

from photonpano import InputError, RunResult, load_panorama, load_trajectory, load_xarray, warp
from photonpano.geometry import Camera, inverse, translation
from photonpano.testing.captures import Scene, rolled

SHAPE = (40, 56)
SCENE = Scene(3)
MOTION = np.array([translation(0.7 * t - 3, 0.3 * t) @ rolled(t - 4, SHAPE) for t in range(9)])
TRUE = SCENE.view(np.eye(3), SHAPE)


def frames_along(motion: np.ndarray) -> np.ndarray:
    return np.stack([SCENE.view(each, SHAPE) for each in motion])


def test_warped_frames_show_the_reference_frame() -> None:
    warped = warp(frames_along(MOTION), MOTION)
    assert warped.dtype == np.float32
    seen = np.isfinite(warped)
    assert 0.7 < seen.mean() < 1
    assert seen[:, 15:25, 20:36].all()
    error = (warped - TRUE)[seen]
    assert np.sqrt(np.mean(error**2)) < 0.1 * TRUE.std()
    assert np.abs(np.mean(error)) < 0.01 * TRUE.std()


def test_lens_of_a_run_is_seen_through(small_run: RunResult) -> None:
    run = load_trajectory(small_run.directory)
    camera = Camera.of(60.0, SHAPE, (-0.2, 0, 0, 0))
    y, x = np.indices(SHAPE, dtype=float)
    frame = SCENE.flux(camera.ideal(np.stack([x, y], axis=-1)).reshape(-1, 2)).reshape(SHAPE)
    motion = replace(run, homographies=np.eye(3)[None], camera=camera, frame_shape=SHAPE)
    (warped,) = warp(frame[None], motion)
    seen = np.isfinite(warped)
    assert np.sqrt(np.mean((warped - TRUE)[seen] ** 2)) < 0.1 * TRUE.std()


def test_tensors_become_what_arrays_become_and_can_be_differentiated() -> None:
    torch = pytest.importorskip("torch")
    frames = frames_along(MOTION).astype(np.float32)
    tensor = torch.tensor(frames, requires_grad=True)
    warped = warp(tensor, MOTION)
    np.testing.assert_allclose(warped.detach().numpy(), warp(frames, MOTION), atol=1e-3)
    torch.nansum(warped).backward()
    # Inside of a frame that turns, each pixel is shown once on average.
    assert float(tensor.grad[0, 15:25, 20:36].mean()) == pytest.approx(1, abs=0.01)


def test_frames_and_motion_that_differ_are_refused(small_run: RunResult) -> None:
    with pytest.raises(InputError, match=re.escape("got the shapes (2, 40, 56) and (9, 3, 3)")):
        warp(np.zeros((2, *SHAPE)), MOTION)
    run = load_trajectory(small_run.directory)
    height, width = run.frame_shape
    with pytest.raises(InputError, match=f"the motion is of frames of {height}x{width} px, and these have 40x56"):
        warp(np.zeros((len(run.homographies), *SHAPE)), small_run.directory)


def test_dataset_holds_panorama_and_its_places(small_run: RunResult) -> None:
    pytest.importorskip("xarray")
    found, panorama = load_xarray(small_run.directory), load_panorama(small_run.directory)
    np.testing.assert_array_equal(found["flux"], panorama.flux)
    np.testing.assert_array_equal(found["coverage"], panorama.weight)
    np.testing.assert_array_equal(found["std"], tifffile.imread(small_run.directory / "panorama-std.tiff"))
    x, y = (inverse(panorama.canvas) @ [7, 5, 1])[:2]
    assert (float(found["x"][7]), float(found["y"][5])) == pytest.approx((x, y))
    assert found["x"].attrs["units"] == "px of the reference frame"
