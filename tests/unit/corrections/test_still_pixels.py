"""What stands still while the frame moves is masked, and nothing is masked where all of it moves or stands."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from photonpano import Capture
from photonpano.corrections import corrected_source
from photonpano.geometry import translation
from photonpano.testing import MemorySource

SHAPE, N = (96, 128), 640


@pytest.fixture(scope="module")
def panned(street: np.ndarray) -> Callable[..., np.ndarray]:
    """Return the detection probabilities of a pan over a street, or another scene: (N, H, W)."""

    def panned(speed_px: float, flux: float = 0.3, scene: np.ndarray = street) -> np.ndarray:
        size, flags = SHAPE[::-1], cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        views = (cv2.warpPerspective(scene, translation(300 + speed_px * t, 250), size, flags=flags) for t in range(N))
        return -np.expm1(np.stack(list(views)) * (-flux / scene.mean()))

    return panned


def found_in(chances: np.ndarray, corrections: Callable, seed: int = 0) -> Capture:
    frames = (np.random.default_rng(seed).random(chances.shape, np.float32) < chances).astype(np.uint8)
    source = corrected_source(MemorySource(frames), corrections("still-pixels"))
    assert source.valid.shape == SHAPE
    return source


def decided(source: Capture) -> dict[str, float]:
    return {each.what: float(each.value) for each in source.decisions}


def in_front(chances: np.ndarray, street: np.ndarray, columns: slice) -> np.ndarray:
    """Put a part of the street that stands still in front of some columns."""
    chances = chances.copy()
    chances[:, :, columns] = -np.expm1(-0.6 * street[400 : 400 + SHAPE[0], 100 : 100 + SHAPE[1]])[:, columns]
    return chances


def test_still_pixels_masks_window_before_moving_scene(panned: Callable, street: np.ndarray, corrections: Callable) -> None:
    source = found_in(in_front(panned(0.15), street, slice(0, 40)), corrections)
    assert not source.valid[:, :40].any()
    assert source.valid[:, 48:].all()
    found = decided(source)
    assert found["still_pixels"] == (~source.valid).sum()
    assert found["standing_share"] == pytest.approx(40 / SHAPE[1], abs=0.06)
    assert source.decisions[0].reason.endswith("stand still in 608 frames sampled all over the capture, while the rest moves")


@pytest.mark.parametrize(("flux", "share", "least"), [(0.01, 0.05, 0.9), (0.01, 0.2, 0.85), (0.1, 0.05, 0.75)])
def test_still_pixels_masks_hot_and_dead_pixels_in_the_dark(
    flux: float, share: float, least: float, panned: Callable, corrections: Callable
) -> None:
    rng = np.random.default_rng(1)
    hot = rng.random(SHAPE) < share
    rates = np.where(hot, np.exp(rng.uniform(np.log(0.1), np.log(2), SHAPE)), 0.001)
    source = found_in(1 - (1 - panned(0.15, flux)) * np.exp(-rates), corrections)
    assert (~source.valid[hot]).mean() > least
    assert source.valid[~hot].mean() > 0.999


@pytest.mark.parametrize("flux", [0.5, 0.02])
def test_still_pixels_masks_nothing_of_moving_scene(flux: float, panned: Callable, corrections: Callable) -> None:
    source = found_in(panned(0.15, flux), corrections)
    assert source.valid.all()
    assert decided(source) == {"still_pixels": 0, "standing_share": 0}


def test_still_pixels_masks_nothing_if_all_stands(panned: Callable, corrections: Callable) -> None:
    """Light that drifts is no motion."""
    light = np.linspace(0.7, 1.3, N)[:, None, None]
    source = found_in(1 - (1 - panned(0.0)) ** light, corrections)
    assert source.valid.all()
    assert decided(source)["standing_share"] > 0.95


def test_still_pixels_masks_nothing_but_records_share_if_most_stands(
    panned: Callable, street: np.ndarray, corrections: Callable
) -> None:
    source = found_in(in_front(panned(0.15), street, slice(0, 96)), corrections)
    assert source.valid.all()
    assert decided(source)["standing_share"] == pytest.approx(0.75, abs=0.06)
    assert "of the frame stands still, so that it is open which part is the scene" in source.decisions[0].reason


def test_still_pixels_takes_lines_along_the_motion_for_no_rest(panned: Callable, corrections: Callable) -> None:
    """Rails that stay in their rows while the camera pans along them, below houses."""
    scene = np.random.default_rng(0).random((682, 1024), np.float32)
    scene = cv2.GaussianBlur(scene, (0, 0), 2) ** 3
    scene[300:] = np.repeat(scene[300:, :1], 1024, axis=1)
    source = found_in(panned(0.15, 0.3, scene), corrections)
    assert source.valid.mean() > 0.999


def test_still_pixels_masks_nothing_of_uniform_frames(corrections: Callable) -> None:
    source = found_in(np.full((N, *SHAPE), 0.2, np.float32), corrections)
    assert source.valid.all()
    assert decided(source)["standing_share"] == 0
    assert source.decisions[0].reason == f"0.00% of {SHAPE[0] * SHAPE[1]} pixels are masked: nothing in the frame moves"


@pytest.mark.parametrize("n_frames", [1, 20, 40])
def test_still_pixels_leaves_short_captures_as_they_are(n_frames: int, corrections: Callable) -> None:
    frames = np.random.default_rng(0).integers(0, 2, (n_frames, *SHAPE), np.uint8)
    assert corrected_source(MemorySource(frames), corrections("still-pixels")).valid.all()
