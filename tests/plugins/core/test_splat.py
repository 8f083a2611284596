from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from photonpano import FrameSpan, Group, InputError, Light, Trajectory, VirtualExposure, capture_of
from photonpano.capture import in_light
from photonpano.geometry import inverse, rescaling
from photonpano.testing import KnownMotion, MemorySource
from photonpano_core.mergers import SplatMerger

N, HEIGHT, WIDTH = 24, 30, 41
GROUP = Group(FrameSpan(2, N - 2), 10.5)


@pytest.fixture(scope="module")
def frames() -> np.ndarray:
    return (np.random.default_rng(0).random((N, HEIGHT, WIDTH)) < 0.15).astype(np.uint8)


@pytest.fixture(scope="module")
def rigid(pan: Callable) -> Trajectory:
    return pan(0.23, -0.17)


@pytest.fixture(scope="module")
def turning(known_motion: type) -> Trajectory:
    """A camera that rolls, zooms and tilts, so that pixels are no longer 1 px apart."""

    def at(frame: float) -> np.ndarray:
        cosine, sine = np.cos(0.02 * frame), np.sin(0.02 * frame)
        nearer = 1 + 0.01 * frame
        return np.array([[nearer * cosine, -sine, 0.2 * frame], [sine, nearer * cosine, 0.1 * frame], [1e-4 * frame, 0, 1]])

    return known_motion(at)


def dense(frame: np.ndarray, to_grid: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Splat a frame by the definition: each pixel of the grid sums nearby photons with tent weights."""
    y, x = np.mgrid[: frame.shape[0], : frame.shape[1]]
    u, v, depth = np.einsum("ij,jyx->iyx", to_grid, np.array([x, y, np.ones_like(x)], dtype=float))
    worth = frame * np.linalg.det(to_grid) / depth**3
    across = np.maximum(0, 1 - np.abs((v / depth)[..., None] - np.arange(shape[0])))
    along = np.maximum(0, 1 - np.abs((u / depth)[..., None] - np.arange(shape[1])))
    return np.einsum("yx,yxi,yxj->ij", worth, across, along)


def expected(frames: np.ndarray, valid: np.ndarray, motion: Trajectory, scale: float) -> tuple[np.ndarray, np.ndarray]:
    shape = round(HEIGHT * scale), round(WIDTH * scale)
    onto = rescaling(scale) @ inverse(motion.at([GROUP.reference])[0])
    counts, weight = np.zeros(shape), np.zeros(shape)
    for index in range(GROUP.span.start, GROUP.span.stop):
        to_grid = onto @ motion.at([index])[0]
        counts += dense(frames[index] * valid, to_grid, shape)
        weight += dense(valid.astype(float), to_grid, shape)
    return counts, weight


def counts_of(exposure: VirtualExposure) -> np.ndarray:
    return exposure.response.mean_count(exposure.flux) * exposure.weight


def some_masked() -> np.ndarray:
    valid = np.random.default_rng(1).random((HEIGHT, WIDTH)) > 0.05
    valid[5:12, 20:24] = False
    return valid


@pytest.mark.parametrize(
    ("motion", "scale", "masked"),
    [
        ("rigid", 1.0, False),
        ("rigid", 1.0, True),
        ("rigid", 2.0, True),
        ("rigid", 0.7, True),
        ("turning", 1.0, False),
        ("turning", 1.6, True),
    ],
)
def test_splat_equals_adjoint_of_interpolation(
    memory_source: type, frames: np.ndarray, motion: str, scale: float, masked: bool, request: pytest.FixtureRequest
) -> None:
    valid = some_masked() if masked else np.ones((HEIGHT, WIDTH), bool)
    trajectory = request.getfixturevalue(motion)
    exposure = SplatMerger().merge(memory_source(frames, valid), GROUP, trajectory, scale)
    counts, weight = expected(frames, valid, trajectory, scale)
    known = exposure.weight > 0
    np.testing.assert_allclose(exposure.weight[known], weight[known], rtol=2e-5, atol=2e-4)
    np.testing.assert_array_equal(known, weight >= 1)
    np.testing.assert_array_equal(np.isnan(exposure.flux), ~known)
    np.testing.assert_allclose(counts_of(exposure)[known], counts[known], rtol=1e-4, atol=1e-3)
    assert exposure.flux.dtype == exposure.weight.dtype == np.float32
    assert (exposure.group, exposure.scale) == (GROUP, scale)


class Intensities:
    """A camera that counts photons."""

    def mean_count(self, flux: np.ndarray) -> np.ndarray:
        return flux

    def flux(self, mean_count: np.ndarray, frames: Any) -> np.ndarray:
        return mean_count


def test_splat_is_unbiased(memory_source: type, rigid: Trajectory) -> None:
    """The mean over many captures lies within four standard errors of the truth."""
    share, rng = 0.2, np.random.default_rng(2)
    means = []
    for _ in range(40):
        frames = rng.random((N, HEIGHT, WIDTH)) < share
        exposure = SplatMerger().merge(memory_source(frames, some_masked()), GROUP, rigid, 1.0)
        known = exposure.weight > 0
        means.append(counts_of(exposure)[known].sum() / exposure.weight[known].sum())
    assert abs(np.mean(means) - share) < 4 * np.std(means) / np.sqrt(len(means))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_splat_takes_counts_above_1(memory_source: type, rigid: Trajectory, dtype: type) -> None:
    counts = np.random.default_rng(3).poisson(0.7, (N, HEIGHT, WIDTH)).astype(dtype) * 50
    source = memory_source(counts)
    source._frames, source.response = counts, Intensities()
    exposure = SplatMerger().merge(source, GROUP, rigid, 1.0)
    total, weight = expected(counts, np.ones((HEIGHT, WIDTH)), rigid, 1.0)
    known = exposure.weight > 0
    np.testing.assert_allclose(exposure.flux[known], (total / np.maximum(weight, 1))[known], rtol=1e-3, atol=1e-3)


def test_splat_refuses_source_with_corrected_sums() -> None:
    """Also at the first level, where frames are not splatted."""
    source = replace(capture_of(MemorySource(np.zeros((10, 8, 8)))), steps=(lambda counts, n_frames: counts - n_frames,))
    for trajectory in (None, KnownMotion(lambda _: np.eye(3))):
        with pytest.raises(InputError) as caught:
            SplatMerger().merge(source, Group(FrameSpan(0, 10), 5), trajectory, 1.0)
        assert str(caught.value) == (
            "merge.use: splat warps photons one by one, so that it cannot subtract dark counts, interpolate pixels or "
            "compare colours; use photon-mle, or only corrections that move or mask pixels"
        )


def test_splat_divides_by_mean_gain_of_group(memory_source: type, frames: np.ndarray, rigid: Trajectory) -> None:
    gain = 1 + 0.8 * np.cos(np.arange(N) / 3)
    plain = SplatMerger().merge(memory_source(frames), GROUP, rigid, 1.0)
    lit = SplatMerger().merge(in_light(memory_source(frames), Light.of_frames(gain)), GROUP, rigid, 1.0)
    np.testing.assert_allclose(lit.weight, plain.weight * gain[2 : N - 2].mean(), rtol=1e-5)
    np.testing.assert_allclose(counts_of(lit), counts_of(plain), atol=1e-3)
