"""Hot and dead pixels are found, and what the scene shows is not taken for them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from photonpano import FrameSpan
from photonpano.corrections import DarkFrames, corrected_source, hot_in_the_dark, write_dark
from photonpano.testing import MemorySource

SHAPE = (60, 80)
N = 2000


def hot_ones(share: float = 0.03, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random(SHAPE) < share


def exposed(flux: np.ndarray, n: int = N, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.stack([rng.random(SHAPE) < -np.expm1(-flux) for _ in range(n)]).astype(np.uint8)


@pytest.mark.parametrize("n_frames", [100, 10_000])
def test_single_counts_in_few_dark_frames_are_not_hot(n_frames: int) -> None:
    rng, hot = np.random.default_rng(2), hot_ones()
    rates = np.where(hot, 0.5, 0.0013)
    measured = DarkFrames((rng.poisson(rates * n_frames) / n_frames).astype(np.float32), n_frames)
    found, limit = hot_in_the_dark(measured, 10, np.ones(SHAPE, bool))
    np.testing.assert_array_equal(found, hot)
    assert 0.0013 < limit < 0.5


def test_hot_pixels_are_found_in_dark_frames(corrections: Callable, tmp_path: Path) -> None:
    hot = hot_ones()
    rates = np.where(hot, 0.3, np.random.default_rng(0).lognormal(np.log(0.0013), 0.3, SHAPE)).astype(np.float32)
    write_dark(tmp_path / "dark.npz", DarkFrames(rates, 10**7))
    source = corrected_source(MemorySource(np.zeros((4, *SHAPE))), corrections({"hot-pixels": {"dark": "dark.npz"}}))
    np.testing.assert_array_equal(source.valid, ~hot)
    (decision,) = source.decisions
    assert (decision.what, decision.value) == ("hot_pixels", hot.sum())
    assert decision.reason.startswith(f"{hot.mean():.2%} of 4800 pixels have more than 0.00")
    assert decision.reason.endswith(" dark counts a frame in dark.npz, by threshold = 10")


def test_hot_and_dead_pixels_are_found_in_the_capture(corrections: Callable) -> None:
    """At the borders and beside each other, before a scene that is brighter on one side."""
    hot, dead = hot_ones(), hot_ones(0.01, seed=5)
    hot[0, 0] = hot[30, 40] = hot[30, 41] = True
    dead &= ~hot
    flux = np.linspace(0.1, 0.6, SHAPE[1]) * np.ones(SHAPE)
    source = corrected_source(MemorySource(exposed(np.where(dead, 0, flux + hot))), corrections("hot-pixels"))
    np.testing.assert_array_equal(source.valid, ~(hot | dead))
    assert source.decisions[0].value == (hot | dead).sum()
    assert "stand out from their neighbours in 2000 frames sampled all over the capture" in source.decisions[0].reason


def test_edges_and_lines_of_the_scene_are_not_hot(corrections: Callable) -> None:
    """As a camera sees them that moves along them."""
    flux = np.full(SHAPE, 0.1)
    flux[20] = 0.8
    flux[40:] = 0.6
    flux[:, 70] = 0.01
    source = corrected_source(MemorySource(exposed(flux)), corrections("hot-pixels"))
    assert source.valid.mean() > 0.999


@pytest.mark.parametrize("every", [2, 3])
def test_masked_pixels_are_not_used_as_neighbours(every: int, corrections: Callable, tmp_path: Path) -> None:
    """They are so bright that nothing would stand out among them. Of every third column, too few are left to tell."""
    bad, hot = np.broadcast_to(np.arange(SHAPE[1]) % every != 0, SHAPE), hot_ones()
    np.save(tmp_path / "bad.npy", bad)
    frames = exposed(np.where(bad, 3.0, 0.1) + 0.4 * hot)
    source = corrected_source(MemorySource(frames), corrections({"mask": {"file": "bad.npy"}}, "hot-pixels"))
    assert source.valid[~bad & ~hot].all()
    assert (source.valid[~bad & hot].mean() < 0.2) == (every == 2)


def test_frames_are_read_once_and_not_at_all_for_a_check(corrections: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = exposed(np.full(SHAPE, 0.1), n=50)
    read: list[FrameSpan] = []
    counts = MemorySource.counts
    monkeypatch.setattr(MemorySource, "counts", lambda self, span: read.append(span) or counts(self, span))
    checked = corrected_source(MemorySource(frames), corrections("hot-pixels"), look=False)
    assert checked.info.frame_shape == SHAPE
    assert read == []
    source = corrected_source(MemorySource(frames), corrections("hot-pixels"))
    assert [source.valid.all() for _ in range(3)] == [True] * 3
    assert read == [FrameSpan(0, 50)]


def test_many_hot_pixels_are_found_among_each_other(corrections: Callable) -> None:
    """Of every pixel's neighbours one in five is hot, too."""
    hot = hot_ones(0.2)
    source = corrected_source(MemorySource(exposed(np.where(hot, 0.4, 0.05))), corrections("hot-pixels"))
    assert (~source.valid[hot]).mean() > 0.95
    assert source.valid[~hot].mean() > 0.999
