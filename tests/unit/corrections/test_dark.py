"""Dark counts and vignettes: measured, and taken out of sums without bias."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import FrameSpan, InputError
from photonpano.corrections import (
    DarkFrames,
    Vignette,
    corrected_source,
    divided_by,
    estimate_vignette,
    measure_dark,
    read_dark,
    write_dark,
)
from photonpano.geometry import translation
from photonpano.testing import KnownMotion, MemorySource
from photonpano.testing.captures import detected, seen_along
from photonpano.values import Decision

SHAPE = (20, 30)
N = 2000
SPAN = FrameSpan(0, N)


def frames_of(flux: Any) -> np.ndarray:
    return detected(np.broadcast_to(flux, (N, *SHAPE)))


@pytest.mark.parametrize("rate", [0.001, 0.05, 0.4, 1.5])
def test_dark_counts_are_subtracted_without_bias(rate: float, corrections: Callable, tmp_path: Path) -> None:
    flux = 0.2
    np.save(tmp_path / "dark.npy", np.full(SHAPE, rate))
    keys = {"dark": "dark.npy", "limit": 2}
    with corrected_source(MemorySource(frames_of(flux + rate)), corrections({"dark-counts": keys})) as source:
        found = source.corrected(source.counts(SPAN), N) / N
    p, n_all = -np.expm1(-flux - rate), N * found.size
    error = np.exp(rate) * np.sqrt(p * (1 - p) / n_all)
    assert abs(found.mean() + np.expm1(-flux)) < 4 * error


def test_dark_counts_of_intensities_are_subtracted(corrections: Callable, tmp_path: Path) -> None:
    values = np.random.default_rng(0).integers(0, 200, (5, *SHAPE), dtype=np.uint8)
    grey = MemorySource(values)
    grey.info = replace(grey.info, kind="intensity", bit_depth=8)
    np.save(tmp_path / "dark.npy", np.full(SHAPE, 12.5))
    with corrected_source(grey, corrections({"dark-counts": {"dark": "dark.npy"}})) as source:
        counts = source.counts(FrameSpan(0, 5))
        np.testing.assert_allclose(source.corrected(counts, 5), counts - 62.5)
        assert source.valid.all()


def test_pixels_with_more_than_the_limit_are_masked_and_counted(corrections: Callable, tmp_path: Path) -> None:
    rates = np.zeros(SHAPE)
    rates[3, 4], rates[5, 6], rates[7, 8] = 200, 0.11, 0.09
    np.save(tmp_path / "dark.npy", rates)
    with corrected_source(MemorySource(frames_of(0.1)), corrections("rot180", {"dark-counts": {"dark": "dark.npy"}})) as source:
        assert np.argwhere(~source.valid).tolist() == [[3, 4], [5, 6]]
        assert np.isfinite(source.corrected(source.counts(SPAN), N)).all()
        reason = "pixels with more than limit = 0.1 dark counts a frame are masked"
        assert source.decisions == (Decision("dark_counts_masked", 2, reason),)


def test_measure_dark_returns_the_rate_of_the_photons(tmp_path: Path) -> None:
    rates = np.array([0.01, 0.5, 1.5])[:, None].repeat(SHAPE[0] * SHAPE[1] // 3, axis=1).reshape(SHAPE)
    advanced: list[int] = []
    measured = measure_dark(MemorySource(frames_of(rates)), advanced.append)
    assert sum(advanced) == N == measured.n_frames
    std = np.sqrt(np.expm1(rates) / N)
    assert np.abs((measured.rates - rates) / std).mean() == pytest.approx(np.sqrt(2 / np.pi), rel=0.1)
    write_dark(tmp_path / "dark.npz", measured)
    again = read_dark(tmp_path / "dark.npz")
    np.testing.assert_array_equal(again.rates, measured.rates)
    assert again.n_frames == N
    assert DarkFrames(again.rates, None).n_frames is None


WRONG = {
    "negative": (
        np.array([[0, 1], [2, -0.5]]),
        "holds dark counts that are negative or not finite, first -0.5 at row 1, column 1",
    ),
    "not finite": (np.array([[0, np.nan]]), "holds dark counts that are negative or not finite, first nan at row 0, column 1"),
    "a mask": (np.zeros((2, 2), bool), "holds bool of shape (2, 2); dark counts are numbers of shape (height, width)"),
    "frames": (np.zeros((2, 2, 2)), "holds float64 of shape (2, 2, 2); dark counts are numbers of shape (height, width)"),
    "text": (None, "is not a file of dark counts: it is no .npy or .npz file of plain numbers"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_dark_files_are_refused(case: str, tmp_path: Path) -> None:
    array, message = WRONG[case]
    path = tmp_path / "dark.npy"
    if array is None:
        path.write_text("no array")
    else:
        np.save(path, array)
    with pytest.raises(InputError) as caught:
        read_dark(path)
    assert str(caught.value) == f"{path} {message}"


FRAME, N_PANNED = (96, 128), 600
MOTION = KnownMotion(lambda frame: translation(0.15 * float(frame), 0.04 * float(frame)))
_y, _x = np.indices(FRAME)
RADIUS = np.hypot(_y - 47.5, _x - 63.5) / np.hypot(48, 64)


@pytest.fixture(scope="module")
def panned(street: np.ndarray) -> Callable[..., MemorySource]:
    """Return a pan over a street, seen through a lens with a vignette, in light that drifts."""

    def panned(vignette: float, flux: float, speed: float = 1.0) -> MemorySource:
        views = seen_along(street, translation(300, 250) @ MOTION.at(speed * np.arange(N_PANNED)), FRAME)
        light = flux / 0.5 * (1 + 0.5 * np.arange(N_PANNED) / N_PANNED)
        return MemorySource(detected(views * (1 - vignette * RADIUS**2) * light[:, None, None], 2))

    return panned


@pytest.mark.parametrize("flux", [0.5, 0.05])
def test_vignette_is_measured_from_moving_scene(flux: float, panned: Callable[..., MemorySource]) -> None:
    vignette = estimate_vignette(panned(0.8, flux), MOTION)
    assert vignette is not None
    inside = RADIUS < 0.9
    np.testing.assert_allclose(vignette.gain[inside], (1 - 0.8 * RADIUS**2)[inside], atol=0.06)
    decision = vignette.decision
    assert decision.what == "vignette_gain"
    assert decision.value == pytest.approx(vignette.gain[0, 0], abs=1e-3)
    assert decision.reason.startswith("light that reaches the corners, relative to the middle, from ")


def test_divided_sums_are_on_average_those_without_vignette() -> None:
    """To first order around the mean of a pixel, which is exact there."""
    gain = (1 - 0.8 * RADIUS**2).astype(np.float32)
    lit = -np.expm1(-0.7 * gain)
    source = MemorySource((np.random.default_rng(0).random((2000, *FRAME)) < lit).astype(np.uint8))
    flat = divided_by(source, Vignette(gain, lit.astype(np.float32), (FrameSpan(0, 2000),)))
    corrected = flat.corrected(flat.counts(FrameSpan(0, 2000)), 2000) / 2000
    assert corrected.mean() == pytest.approx(-np.expm1(-0.7), abs=0.002)
    corners = RADIUS > 0.8
    assert corrected[corners].mean() == pytest.approx(-np.expm1(-0.7), abs=0.005)
