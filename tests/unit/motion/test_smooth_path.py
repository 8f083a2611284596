"""The smooth path along which few photons of all frames fit together."""

import re
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest

from photonpano.errors import LocationError
from photonpano.execution.context import Context
from photonpano.motion.smooth_path import FoundPath, SmoothPath, find_path

SHAPE = (64, 96)
N_FRAMES = 900
REFERENCE = 450


def swaying(px: float) -> np.ndarray:
    """A path that returns 5 and 8 times: (N, 2) in px."""
    turns = 2 * np.pi * np.arange(N_FRAMES)[:, None] / N_FRAMES * [5, 8] + [0, 1]
    return px * np.sin(turns)


@pytest.fixture
def stars(memory_source: type) -> Callable[..., Any]:
    """Simulate stars that move along a path before a faint sky, by a few photons in a frame."""

    def stars(shifts: np.ndarray, photons: float, sky: float, seed: int = 0) -> Any:
        rng = np.random.default_rng(seed)
        scene = np.zeros((SHAPE[0] * 2, SHAPE[1] * 2), np.float32)
        scene[rng.integers(0, len(scene), 80), rng.integers(0, scene.shape[1], 80)] = 1
        scene = cv2.GaussianBlur(scene, (0, 0), 1.0)
        scene *= photons / scene[SHAPE[0] // 2 : 3 * SHAPE[0] // 2, SHAPE[1] // 2 : 3 * SHAPE[1] // 2].sum()
        frames = []
        for x, y in shifts:
            view = np.float32([[1, 0, x - SHAPE[1] / 2], [0, 1, y - SHAPE[0] / 2]])
            flux = cv2.warpAffine(scene, view, SHAPE[::-1]) + sky / (SHAPE[0] * SHAPE[1])
            frames.append(rng.random(SHAPE) < -np.expm1(-flux))
        return memory_source(frames)

    return stars


def found(source: Any) -> FoundPath:
    return find_path(source, REFERENCE, Context(threads=1))


@pytest.mark.parametrize("seed", [0, 1])
def test_path_is_found_within_its_error_from_a_few_photons_a_frame(stars: Callable, seed: int) -> None:
    shifts = swaying(5.0)
    path = found(stars(shifts, photons=8, sky=4, seed=seed)).trajectory
    homographies = path.at(np.arange(N_FRAMES))
    np.testing.assert_allclose(homographies[REFERENCE], np.eye(3), atol=1e-12)
    apart = homographies[:, :2, 2] + shifts
    error_px = float(np.sqrt(((apart - apart.mean(axis=0)) ** 2).sum(axis=1).mean()))
    assert error_px < 0.2
    assert 0.6 * error_px < path.std_px < 1.7 * error_px


@pytest.mark.parametrize(
    ("px", "photons", "sky"), [pytest.param(5, 0, 12, id="noise"), pytest.param(0, 8, 4, id="stars that stand still")]
)
def test_noise_and_rest_have_no_path(stars: Callable, px: float, photons: float, sky: float) -> None:
    with pytest.raises(LocationError, match=re.escape("no smooth path stands out from photon noise")):
        found(stars(swaying(px), photons, sky))


def test_shifts_of_a_path_pass_through_its_knots_at_the_ends() -> None:
    path = SmoothPath(np.array([[0.0, 0], [1, 0], [2, 0], [3, 6]]), 100, -0.5, std_px=0.5)
    np.testing.assert_allclose(path.at([-0.5, 99.5])[:, :2, 2], [[0, 0], [3, 6]], atol=1e-12)
    assert path.error_px_a_frame == pytest.approx(0.5 * 4 / 100)
