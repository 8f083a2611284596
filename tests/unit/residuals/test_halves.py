"""Halves of captures across cuts: their coherence, its noise, and how well they are tied."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from photonpano import FrameSpan
from photonpano.execution.context import Context
from photonpano.geometry import FrameTrajectory, canvas_of, translation
from photonpano.motion.frame_motion import FrameMotion
from photonpano.photometry import BinaryResponse
from photonpano.residuals.halves import Halves, _compared, halves_of
from photonpano.testing.captures import detected, seen_along, textured

SHAPE, N_FRAMES = (64, 96), 400
PAN = np.array([translation(10 + 0.25 * frame, 20) for frame in range(N_FRAMES)])


@pytest.fixture
def halves(memory_source: type) -> Callable[..., Halves]:
    def halves(scene: np.ndarray, true: np.ndarray = PAN, found: np.ndarray | None = None, seed: int = 0) -> Halves:
        """Compare the halves of a capture along a motion, by default the true one."""
        source = memory_source(detected(seen_along(scene, true, SHAPE), seed))
        homographies = np.linalg.inv(true[N_FRAMES // 2]) @ (true if found is None else found)
        everywhere, std_px = np.ones(N_FRAMES, dtype=bool), np.full(N_FRAMES, 0.05)
        trajectory, span = FrameTrajectory(homographies), FrameSpan(0, N_FRAMES)
        motion = FrameMotion(
            trajectory=trajectory,
            span=span,
            homographies=homographies,
            located=everywhere,
            std_px=std_px,
            reference=N_FRAMES // 2,
            frame_shape=SHAPE,
        )
        return halves_of(source, motion, canvas_of(homographies, SHAPE, 1.0), Context())

    return halves


@pytest.fixture(scope="module")
def scene() -> np.ndarray:
    return textured((110, 230), 1.0, seed=3).astype(np.float32)


@pytest.mark.parametrize("flux", [0.3, 0.02])
def test_coherence_along_the_true_motion_is_one_but_for_its_noise(halves: Callable, scene: np.ndarray, flux: float) -> None:
    found = [halves(flux * scene, seed=seed) for seed in range(5)]
    inner = slice(4, -4)  # at the ends, a half is a few frames
    scores = np.array([((each.cuts.coherence - 1) / each.cuts.std_coherence)[inner] for each in found])
    assert 0.7 < np.sqrt(np.mean(scores**2)) < 1.4
    assert abs(scores.mean()) < 0.5


@pytest.mark.parametrize("flux", [0.3, 0.02])
def test_error_of_the_shift_across_a_cut_is_that_of_photon_noise(halves: Callable, scene: np.ndarray, flux: float) -> None:
    """At a fifteenth of the light, it is about four times as large."""
    std_px = halves(flux * scene).cuts.std_px[len(PAN) // 25]
    lit = halves(0.3 * scene).cuts.std_px[len(PAN) // 25]
    expected = np.sqrt(0.3 / flux)
    np.testing.assert_allclose(std_px / lit, expected, rtol=0.4)
    assert (std_px >= lit).all()


def test_motion_that_is_wrong_after_a_cut_is_seen_there(halves: Callable, scene: np.ndarray) -> None:
    """A jump of 1 px that the motion lacks: halves across it are displaced."""
    found = PAN.copy()
    found[N_FRAMES // 2 :] = found[N_FRAMES // 2 :] @ translation(0, 1)
    wrong = halves(0.3 * scene, found=found).cuts
    sigmas = (1 - wrong.coherence) / wrong.std_coherence
    assert wrong.coherence[len(wrong.firsts) // 2] < 0.97
    assert sigmas[len(wrong.firsts) // 2] > 5
    assert abs(wrong.firsts[np.nanargmin(wrong.coherence)] - N_FRAMES // 2) < 0.2 * N_FRAMES


@pytest.mark.parametrize(("along", "angle"), [(0, 90), (1, 0)], ids=["vertical edges", "horizontal edges"])
def test_bare_edges_tie_nothing_along_them(halves: Callable, scene: np.ndarray, along: int, angle: int) -> None:
    """Before a wall with one edge, half of the longer side of a frame is all that is known."""
    wall = np.full_like(scene, 0.3)
    wall[(slice(None), slice(115, None)) if along == 0 else (slice(50, None), slice(None))] = 0.6
    found = halves(wall).cuts
    middle = len(found.firsts) // 2
    strong, weak = found.std_px[middle]
    assert strong < 0.1
    assert weak > 5
    assert min(abs(found.angles_deg[middle] - angle), abs(found.angles_deg[middle] - angle - 180)) < 3


@pytest.mark.parametrize("shape", [(1, 40), (40, 1)])
def test_a_single_row_or_column_ties_nothing(shape: tuple[int, int]) -> None:
    sums = np.ones((4, 2, *shape, 1), np.float32) * np.float32(10)
    assert _compared(sums, BinaryResponse(), 7.0).std_px == (7.0, 7.0)


def test_stretch_that_sees_a_bare_edge_is_tied_to_nothing_where_the_path_returns(halves: Callable, scene: np.ndarray) -> None:
    """Frames on both sides of each cut see the same places, so that no cut shows it."""
    wall = 0.3 * scene
    wall[:, 50:170] = 0.3
    wall[50:, 50:170] = 0.6
    there_and_back = np.array([translation(10 + 110 * np.sin(np.pi * frame / N_FRAMES), 20) for frame in range(N_FRAMES)])
    found = halves(wall, there_and_back)
    assert found.cuts.std_px[4:-4, 1].max() < 0.3
    bare = (found.stretches.std_px[:, 1] > 20) & (found.stretches.std_px[:, 0] < 0.2)
    frames = found.stretches.firsts[bare]
    assert 2 <= len(frames) <= 8
    assert min(frames) < N_FRAMES / 2 < max(frames)
    tied_px = found.tied_px(np.ones(N_FRAMES, dtype=bool))
    assert tied_px[frames.astype(int)].min() > 20
    assert tied_px[[0, N_FRAMES // 2, N_FRAMES - 1]].max() < 1
