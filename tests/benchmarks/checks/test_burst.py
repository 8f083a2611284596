"""The baseline `burst`: patches of blocks of frames that find their motion without any of the camera."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from photonpano import FrameSpan, Group, InputError, Light, capture_of
from photonpano.capture import in_light
from photonpano.geometry import Camera
from photonpano.photometry import BinaryResponse
from photonpano.testing import MemorySource
from photonpano_baselines.burst import BurstMerger, PatchGrid, aligned, at_instant, wiener_mean
from photonpano_baselines.configs import BurstConfig
from photonpano_core.configs import PhotonMleConfig
from photonpano_core.mergers import PhotonMleMerger

NOISE = np.random.default_rng(1).standard_normal((72, 160))
SCENE = 0.6 * np.exp(0.6 * sum(sigma * cv2.GaussianBlur(NOISE, (0, 0), sigma) for sigma in (1.5, 4.0)))


def shifted(image: np.ndarray, left: float, shape: tuple[int, int]) -> np.ndarray:
    to_image = np.array([[1, 0, left], [0, 1, 0]])
    return cv2.warpAffine(image, to_image, shape[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)


def burst(**config: int) -> BurstMerger:
    return BurstMerger(BurstConfig.model_validate({"block_frames": 25} | config))


def panned(speed_px: float, valid: np.ndarray | None = None) -> tuple[MemorySource, np.ndarray]:
    """Return 200 frames of a camera that pans, and what it sees at their middle."""
    rng, n = np.random.default_rng(0), 200
    views = [shifted(SCENE, 10 + speed_px * frame, (72, 100)) for frame in (*range(n), BURST.reference)]
    return MemorySource(np.array([rng.random(each.shape) < -np.expm1(-each) for each in views[:n]]), valid), views[n]


BURST = Group(FrameSpan(0, 200), 99.5)


@pytest.mark.parametrize("patch_px", [16, 32])
def test_panning_camera_is_compensated_without_a_trajectory(patch_px: int, pan: Callable) -> None:
    (source, true), inside = panned(0.15), (slice(8, -8), slice(20, -20))
    mergers = burst(patch_px=patch_px), PhotonMleMerger(PhotonMleConfig(tolerance_px=0.5))
    found, average = (each.merge(source, BURST, None, 1.0) for each in mergers)
    errors = [np.mean((each.flux - true)[inside] ** 2) for each in (found, average)]
    assert errors[0] < 0.2 * errors[1]
    told = burst(patch_px=patch_px).merge(source, BURST, pan(3.0), 1.0)
    np.testing.assert_array_equal(told.flux, found.flux)


def test_camera_that_stands_still_is_not_moved_by_noise() -> None:
    """Blocks rest, so that masked pixels stay unknown."""
    valid = np.ones((72, 100), bool)
    valid[30:33] = False
    source, true = panned(0.0, valid)
    exposure = burst().merge(source, BURST, None, 1.0)
    assert np.isnan(exposure.flux[30:33]).all()
    np.testing.assert_allclose(exposure.weight[valid], 200, rtol=1e-4)
    assert abs((exposure.flux - true)[valid].mean()) < 0.01


def test_patches_are_found_to_fractions_of_a_pixel() -> None:
    smooth = cv2.GaussianBlur(SCENE.astype(np.float32), (0, 0), 1.5)
    fixed, moving = smooth[:, 20:120].copy(), (0.75 * smooth[:, 13:113] + 0.25 * smooth[:, 12:112]).astype(np.float32)
    grid = PatchGrid((72, 100), 16)
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
    source, _ = panned(0.0)
    exposure = burst().merge(source, Group(FrameSpan(3, 4), 3.0), None, 1.0)
    np.testing.assert_allclose(exposure.weight, 1, rtol=1e-4)
    np.testing.assert_array_equal(exposure.flux > 0.3, source.frames(FrameSpan(3, 4))[0] > 0)


def test_changing_light_and_a_lens_that_distorts_are_errors() -> None:
    source, _ = panned(0.0)
    with pytest.raises(InputError, match=r"burst does not divide by light that changes; use photon-mle"):
        burst().merge(in_light(source, Light.of_frames(np.ones(200))), BURST, None, 1.0)
    distorting = replace(capture_of(source), camera=Camera.of(100.0, (72, 100), (-0.1, 0, 0, 0)))
    with pytest.raises(InputError, match=r"burst does not warp through a lens that distorts; use photon-mle"):
        burst().merge(distorting, BURST, None, 1.0)
