"""Hot pixels, and what stands still while the frame moves."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from photonpano import Capture
from photonpano.corrections import DarkFrames, corrected_source, write_dark
from photonpano.geometry import translation
from photonpano.testing import MemorySource
from photonpano.testing.captures import seen_along

SHAPE = (60, 80)
N = 2000


def hot_ones(share: float = 0.03, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random(SHAPE) < share


def exposed(flux: np.ndarray, n: int = N, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.stack([rng.random(SHAPE) < -np.expm1(-flux) for _ in range(n)]).astype(np.uint8)


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


FRAME, N_PANNED = (96, 128), 640


@pytest.fixture(scope="module")
def panned(street: np.ndarray) -> Callable[..., np.ndarray]:
    """Return the detection probabilities of a pan over a street, or another scene: (N_PANNED, H, W)."""

    def panned(speed_px: float, flux: float = 0.3, scene: np.ndarray = street) -> np.ndarray:
        views = seen_along(scene, [translation(300 + speed_px * t, 250) for t in range(N_PANNED)], FRAME)
        return -np.expm1(views * (-flux / scene.mean()))

    return panned


def found_in(chances: np.ndarray, corrections: Callable, seed: int = 0) -> Capture:
    frames = (np.random.default_rng(seed).random(chances.shape, np.float32) < chances).astype(np.uint8)
    source = corrected_source(MemorySource(frames), corrections("still-pixels"))
    assert source.valid.shape == FRAME
    return source


def decided(source: Capture) -> dict[str, float]:
    return {each.what: float(each.value) for each in source.decisions}


def in_front(chances: np.ndarray, street: np.ndarray, columns: slice) -> np.ndarray:
    """Put a part of the street that stands still in front of some columns."""
    chances = chances.copy()
    chances[:, :, columns] = -np.expm1(-0.6 * street[400 : 400 + FRAME[0], 100 : 100 + FRAME[1]])[:, columns]
    return chances


def test_still_pixels_masks_window_before_moving_scene(panned: Callable, street: np.ndarray, corrections: Callable) -> None:
    source = found_in(in_front(panned(0.15), street, slice(0, 40)), corrections)
    assert not source.valid[:, :40].any()
    assert source.valid[:, 48:].all()
    found = decided(source)
    assert found["still_pixels"] == (~source.valid).sum()
    assert found["standing_share"] == pytest.approx(40 / FRAME[1], abs=0.06)
    assert source.decisions[0].reason.endswith("stand still in 608 frames sampled all over the capture, while the rest moves")


@pytest.mark.parametrize(("flux", "share", "least"), [(0.01, 0.05, 0.9), (0.01, 0.2, 0.85), (0.1, 0.05, 0.75)])
def test_still_pixels_masks_hot_and_dead_pixels_in_the_dark(
    flux: float, share: float, least: float, panned: Callable, corrections: Callable
) -> None:
    rng = np.random.default_rng(1)
    hot = rng.random(FRAME) < share
    rates = np.where(hot, np.exp(rng.uniform(np.log(0.1), np.log(2), FRAME)), 0.001)
    source = found_in(1 - (1 - panned(0.15, flux)) * np.exp(-rates), corrections)
    assert (~source.valid[hot]).mean() > least
    assert source.valid[~hot].mean() > 0.999


def test_lines_of_the_sensor_that_never_vary_are_masked_and_named(panned: Callable, corrections: Callable) -> None:
    chances = panned(0.15)
    chances[:, 20:23], chances[:, :, -3:] = 1, 0
    source = found_in(chances, corrections)
    assert not source.valid[20:23].any()
    assert not source.valid[:, -3:].any()
    assert source.valid.sum() == source.valid.size - 3 * FRAME[1] - 3 * (FRAME[0] - 3)
    named = "of rows 20 to 22; columns 125 to 127, as where `width: 125` is missing"
    assert source.decisions[0].reason.endswith(f"all pixels are lit in all of them, or in none, {named}")


def test_dark_sky_above_the_scene_is_not_masked(panned: Callable, corrections: Callable) -> None:
    chances = panned(0.15)
    roofs = 20 + 6 * np.sin(np.arange(FRAME[1]) / 9)
    chances[:, np.arange(FRAME[0])[:, None] < roofs] = 0
    assert found_in(chances, corrections).valid.all()


@pytest.mark.parametrize("flux", [0.5, 0.02])
def test_still_pixels_masks_nothing_of_moving_scene(flux: float, panned: Callable, corrections: Callable) -> None:
    source = found_in(panned(0.15, flux), corrections)
    assert source.valid.all()
    assert decided(source) == {"still_pixels": 0, "standing_share": 0}


def test_still_pixels_masks_nothing_if_all_stands(panned: Callable, corrections: Callable) -> None:
    """Light that drifts is no motion."""
    light = np.linspace(0.7, 1.3, N_PANNED)[:, None, None]
    source = found_in(1 - (1 - panned(0.0)) ** light, corrections)
    assert source.valid.all()
    assert decided(source)["standing_share"] == 0


def test_still_pixels_masks_nothing_but_records_share_if_most_stands(
    panned: Callable, street: np.ndarray, corrections: Callable
) -> None:
    source = found_in(in_front(panned(0.15), street, slice(0, 96)), corrections)
    assert source.valid.all()
    assert decided(source)["standing_share"] == pytest.approx(0.75, abs=0.06)
    assert "of the frame stands still, so that it is open which part is the scene" in source.decisions[0].reason
