from __future__ import annotations

import numpy as np
import pytest

from photonpano.captures.obstacles import naming_obstacles, obstacles, repetition_px
from photonpano.errors import LocationError
from photonpano.testing.captures import MemorySource
from photonpano.values import Decision

SHAPE = 96, 128


def counts(rate: np.ndarray, seed: int, n_frames: int = 128) -> np.ndarray:
    return np.random.default_rng(seed).binomial(n_frames, rate).astype(np.uint32)


def tiles(period: int) -> np.ndarray:
    rows, columns = np.indices(SHAPE)
    return np.where((rows // (period // 2) + columns // (period // 2)) % 2, 0.05, 0.15)


def texture(seed: int) -> np.ndarray:
    waves = np.random.default_rng(seed).normal(size=SHAPE)
    smooth = np.fft.ifft2(np.fft.fft2(waves) * np.outer(*(np.exp(-((np.fft.fftfreq(n) * 12) ** 2)) for n in SHAPE))).real
    return np.asarray(0.1 + 0.03 * smooth / smooth.std()).clip(0.01, 0.4)


def test_period_of_checkerboard_is_distance_of_its_nearest_copy() -> None:
    found = repetition_px(counts(tiles(20), 0), counts(tiles(20), 1))
    assert found == pytest.approx(10 * np.sqrt(2), abs=0.5)


@pytest.mark.parametrize("seed", range(5))
def test_texture_does_not_repeat(seed: int) -> None:
    rate = texture(seed)
    assert repetition_px(counts(rate, 0), counts(np.roll(rate, 3, axis=1), 1)) is None


@pytest.mark.parametrize("rate", [0.0, 0.02])
def test_frames_without_texture_do_not_repeat(rate: float) -> None:
    flat = np.full(SHAPE, rate)
    assert repetition_px(counts(flat, 0), counts(flat, 1)) is None


def test_error_names_what_stands_still_and_what_repeats() -> None:
    frames = np.random.default_rng(0).random((64, *SHAPE)) < 4 * tiles(20)
    decisions = [Decision("standing_share", 0.38, "")]
    with pytest.raises(LocationError) as raised, MemorySource(frames) as source, naming_obstacles(source, decisions):
        raise LocationError("none of the pairs could be located")
    assert str(raised.value).splitlines() == [
        "none of the pairs could be located",
        "38% of the frame stands still while the rest moves, as a window or dirt in front of the sensor does: mask it under "
        "corrections, or cut it off.",
        "The image repeats every 14 px, so that pairs fit at several places: "
        "use shorter groups, between which it moves by less than half of that.",
    ]


def test_error_stays_as_it_is_where_nothing_is_found() -> None:
    frames = np.random.default_rng(0).random((64, *SHAPE)) < texture(0)
    with MemorySource(frames) as source:
        assert obstacles(source, []) == []
