from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from photonpano import FrameSpan, Group, InputError, Light
from photonpano.geometry import Camera
from photonpano.lighting import in_light
from photonpano.photometry import BinaryResponse
from photonpano.testing import MemorySource
from photonpano_core.configs import BurstConfig, PhotonMleConfig
from photonpano_core.mergers.burst import BurstMerger, PatchGrid, aligned, at_instant, wiener_mean
from photonpano_core.mergers.photon_mle import PhotonMleMerger

N, HEIGHT, WIDTH = 200, 72, 100
GROUP = Group(FrameSpan(0, N), (N - 1) / 2)


def texture(shape: tuple[int, int]) -> np.ndarray:
    noise = np.random.default_rng(1).standard_normal(shape)
    layers = sum(sigma * cv2.GaussianBlur(noise, (0, 0), sigma) for sigma in (1.5, 4.0))
    return np.float32(0.6 * np.exp(0.6 * layers))


SCENE = texture((HEIGHT, 160))


def view(frame: float, speed_px: float) -> np.ndarray:
    to_scene = np.array([[1, 0, 10 + speed_px * frame], [0, 1, 0]])
    return cv2.warpAffine(SCENE, to_scene, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)


def capture(speed_px: float, valid: np.ndarray | None = None) -> MemorySource:
    rng = np.random.default_rng(0)
    frames = [rng.random((HEIGHT, WIDTH)) < -np.expm1(-view(frame, speed_px)) for frame in range(N)]
    return MemorySource(np.array(frames, np.uint8), valid)


def burst(**config: int) -> BurstMerger:
    return BurstMerger(BurstConfig.model_validate({"block_frames": 25} | config))


@pytest.mark.parametrize("patch_px", [16, 32])
def test_panning_camera_is_compensated_without_a_trajectory(patch_px: int) -> None:
    source, inside = capture(0.15), (slice(8, -8), slice(20, -20))
    true = view(GROUP.reference, 0.15)[inside]
    average = PhotonMleMerger(PhotonMleConfig())
    errors = [
        np.mean((each.merge(source, GROUP, None, 1.0).flux[inside] - true) ** 2) for each in (burst(patch_px=patch_px), average)
    ]
    assert errors[0] < 0.2 * errors[1]


def test_trajectory_is_ignored(pan: Callable) -> None:
    source = capture(0.15)
    first, second = (burst().merge(source, GROUP, motion, 1.0) for motion in (None, pan(3.0)))
    np.testing.assert_array_equal(first.flux, second.flux)


def test_camera_that_stands_still_is_not_moved_by_noise() -> None:
    """Blocks rest, so that masked pixels stay unknown."""
    valid = np.ones((HEIGHT, WIDTH), bool)
    valid[30:33] = False
    exposure = burst().merge(capture(0.0, valid), GROUP, None, 1.0)
    assert np.isnan(exposure.flux[30:33]).all()
    np.testing.assert_allclose(exposure.weight[valid], N, rtol=1e-4)
    error = (exposure.flux - view(0, 0.0))[valid]
    assert abs(error.mean()) < 0.01


def test_patches_are_found_to_fractions_of_a_pixel() -> None:
    smooth = cv2.GaussianBlur(SCENE, (0, 0), 1.5)
    fixed, moving = smooth[:, 20:120].copy(), (0.75 * smooth[:, 13:113] + 0.25 * smooth[:, 12:112]).astype(np.float32)
    grid = PatchGrid((HEIGHT, WIDTH), 16)
    found = aligned(fixed, moving, grid, np.zeros((*grid.n_patches, 2)), 1e-6)
    inner = found[2:-2, 2:-3]
    np.testing.assert_allclose(np.median(inner.reshape(-1, 2), axis=0), [7.25, 0], atol=0.1)
    assert (np.abs(inner - [7.25, 0]).max(axis=-1) < 0.5).mean() > 0.9


def test_motion_is_interpolated_and_extrapolated_in_time() -> None:
    motion = np.array([0.0, 10.0, 30.0])[:, None]
    found = [float(at_instant([0.0, 10.0, 20.0], motion, instant)[0]) for instant in (-5, 5, 15, 25)]
    assert found == [-5, 5, 20, 40]
    assert at_instant([4.0], motion[:1], 100.0) == 0


def test_windows_of_patches_add_up_to_one() -> None:
    grid = PatchGrid((37, 51), 16)
    np.testing.assert_allclose(grid.joined(np.ones((*grid.n_patches, 16, 16), np.float32)), 1, rtol=1e-5)


def test_wiener_mean_leaves_out_a_block_that_differs() -> None:
    rng = np.random.default_rng(2)
    p = np.full((3, 1, 1, 16, 16), 0.3)
    p[2, ..., :8] = 0.8
    frames = 400
    counts = rng.binomial(frames, p).astype(np.float32)
    mean = wiener_mean(counts, np.full_like(counts, frames), 0, BinaryResponse())
    assert abs(mean[..., :8].mean() - 0.3) < 0.03
    assert counts[:, ..., :8].mean() / frames > 0.45
    # And noise is averaged over the blocks that agree.
    assert (mean[..., 8:] - 0.3).std() < 0.85 * (counts[0, ..., 8:] / frames - 0.3).std()


def test_group_of_one_frame_is_that_frame() -> None:
    source = capture(0.1)
    exposure = burst().merge(source, Group(FrameSpan(3, 4), 3.0), None, 1.0)
    np.testing.assert_allclose(exposure.weight, 1, rtol=1e-4)
    np.testing.assert_array_equal(exposure.flux > 0.3, source.frames(FrameSpan(3, 4))[0] > 0)


def test_lens_and_changing_light_are_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    source = capture(0.0)
    with pytest.raises(InputError, match=r"burst does not divide by light that changes; use photon-mle"):
        burst().merge(in_light(source, Light.of_frames(np.ones(N))), GROUP, None, 1.0)
    monkeypatch.setattr(source, "camera", Camera.of(100.0, (HEIGHT, WIDTH), (-0.1, 0, 0, 0)), raising=False)
    with pytest.raises(InputError, match=r"burst does not warp through a lens that distorts; use photon-mle"):
        burst().merge(source, GROUP, None, 1.0)
