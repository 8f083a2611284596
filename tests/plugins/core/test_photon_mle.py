from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from photonpano import FrameSpan, Group, Source
from photonpano.geometry import translation
from photonpano.merging import accumulate, chunks_of
from photonpano_core.configs import PhotonMleConfig
from photonpano_core.mergers.photon_mle import PhotonMleMerger

N = 60
GROUP = Group(FrameSpan(0, N), 29.5)
SPEED_PX = 0.25


@pytest.fixture(scope="module")
def scene() -> np.ndarray:
    """(40, 80) stripes, 8 px wide."""
    return np.tile(np.where(np.arange(80) // 8 % 2, 0.9, 0.2), (40, 1))


@pytest.fixture(scope="module")
def still(memory_source: type, scene: np.ndarray) -> Source:
    return memory_source(np.random.default_rng(0).random((N, 40, 48)) < scene[:, :48])


@pytest.fixture(scope="module")
def panning(memory_source: type, scene: np.ndarray) -> Source:
    """Frame t shows the scene from SPEED_PX * t on, rounded to whole pixels."""
    rng = np.random.default_rng(0)
    starts = np.floor(SPEED_PX * np.arange(N)).astype(int)
    return memory_source(np.array([rng.random((40, 48)) < scene[:, start : start + 48] for start in starts]))


def merger(**config: object) -> PhotonMleMerger:
    return PhotonMleMerger(PhotonMleConfig.model_validate(config))


def test_photon_mle_sums_unwarped_frames_without_trajectory(still: Source) -> None:
    exposure = merger().merge(still, GROUP, None, 1.0)
    expected = still.response.flux((still.counts(GROUP.span) / N).astype(np.float32), N)
    np.testing.assert_allclose(exposure.flux, expected, rtol=1e-6)
    np.testing.assert_array_equal(exposure.weight, np.full((40, 48), N))
    assert (exposure.group, exposure.scale, exposure.response) == (GROUP, 1.0, still.response)


def test_photon_mle_sharpens_edges_along_known_motion(panning: Source, scene: np.ndarray, pan: Callable) -> None:
    """At frame 29.5 the scene begins at 7 px: frames see whole pixels, so the true start is floor(29.5 / 4)."""
    motion = pan(SPEED_PX)
    compensated = merger(tolerance_px=0.25).merge(panning, GROUP, motion, 1.0)
    naive = merger(compensate=False).merge(panning, GROUP, motion, 1.0)
    true = -np.log1p(-scene[:, 7 : 7 + 48])
    inside = (slice(None), slice(8, 40))
    errors = [np.sqrt(np.mean((exposure.flux - true)[inside] ** 2)) for exposure in (compensated, naive)]
    assert errors[0] < 0.4
    assert errors[1] > 2 * errors[0]


def test_photon_mle_uses_reference_at_end_of_group(panning: Source, pan: Callable) -> None:
    exposure = merger().merge(panning, Group(FrameSpan(0, N), 0.0), pan(SPEED_PX), 1.0)
    # Later frames see further right, so that the left border of the first one is seen by it and few others.
    assert exposure.weight[20, 0] < N / 4
    assert exposure.weight[20, 40] == pytest.approx(N)


def test_photon_mle_sums_chunks_within_tolerance(panning: Source, pan: Callable) -> None:
    motion = pan(SPEED_PX)
    to_reference = translation(-SPEED_PX * GROUP.reference, 0)
    for tolerance_px in (0.25, 4.0):
        chunks = chunks_of(GROUP.span, motion, (40, 48), tolerance_px)
        expected, _ = accumulate(panning, chunks, to_reference, (40, 48)).estimate(panning.response)
        exposure = merger(tolerance_px=tolerance_px).merge(panning, GROUP, motion, 1.0)
        np.testing.assert_allclose(exposure.flux, expected, atol=1e-3)
