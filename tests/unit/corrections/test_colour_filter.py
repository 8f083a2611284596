"""Captures behind a colour filter array, with all colours kept: one grey source, and a source for each colour."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import FrameSpan, InputError
from photonpano.corrections import corrected_source, without_still_pixels
from photonpano.reading import COLOURS, bayer_array
from photonpano.testing import MemorySource

SHAPE = (48, 64)
FLUX = {"red": 0.15, "green": 0.4, "blue": 0.1}
N_FRAMES = 600
WHOLE = FrameSpan(0, N_FRAMES)
ALL = {"colour-filter": {"pattern": "rggb", "keep": "all"}}


def behind(places: np.ndarray, flux: np.ndarray, seed: int = 0) -> MemorySource:
    """Take frames of a scene, (T, H, W, 3), behind filters."""
    seen = np.array(list(COLOURS.values()))[places] / 255
    lit = np.random.default_rng(seed).random((len(flux), *places.shape)) < -np.expm1(-(flux * seen).sum(axis=-1))
    return MemorySource(lit)


@pytest.fixture(scope="module")
def grey_scene() -> MemorySource:
    """A flat scene whose light is far from white."""
    return behind(bayer_array("rggb", SHAPE), np.broadcast_to(list(FLUX.values()), (N_FRAMES, *SHAPE, 3)))


@pytest.fixture
def mosaic(tmp_path: Path) -> np.ndarray:
    """Write pattern.npy: three clear pixels in four, like SwissSPAD2, and return the place of each colour."""
    places = np.full(SHAPE, 3, np.int8)
    places[1::2, 1::2] = np.random.default_rng(2).integers(0, 3, (SHAPE[0] // 2, SHAPE[1] // 2))
    np.save(tmp_path / "pattern.npy", np.array(list(COLOURS.values()), np.uint8)[places])
    return places


def test_corrected_sums_of_all_colours_are_alike_and_weighted_by_their_light(
    grey_scene: MemorySource, corrections: Callable
) -> None:
    source = corrected_source(grey_scene, corrections(ALL))
    assert source.corrects_sums
    places = bayer_array("rggb", SHAPE)
    summed, weights = source.corrected(source.counts(WHOLE), N_FRAMES) / N_FRAMES, source.weights()
    for place, flux in enumerate(FLUX.values()):
        assert summed[places == place].mean() == pytest.approx(1 - np.exp(-0.4), rel=0.01)
        assert weights[places == place] == pytest.approx(flux / 0.4, rel=0.03)
    gains = {each.what: each.value for each in source.decisions}
    assert gains == pytest.approx({"red_gain": 0.375, "green_gain": 1, "blue_gain": 0.25}, rel=0.03)


def test_flux_of_clear_pixels_is_known_as_a_mix_of_the_others(mosaic: np.ndarray, corrections: Callable) -> None:
    """Two panes of strong colours; a clear pixel sees the sum of red, green and blue."""
    flux = np.empty((N_FRAMES, *SHAPE, 3))
    flux[:, :, :32], flux[:, :, 32:] = (0.3, 0.1, 0.05), (0.05, 0.1, 0.3)
    source = corrected_source(behind(mosaic, flux), corrections({"colour-filter": {"pattern": "pattern.npy", "keep": "all"}}))
    assert list(source.colours()) == ["red", "green", "blue", "clear"]
    assert source.clear_mix() == pytest.approx(np.ones(3), abs=0.15)


def test_bayer_array_of_the_capture_is_the_default_and_makes_auto_see_colours(
    grey_scene: MemorySource, corrections: Callable
) -> None:
    capture = behind(bayer_array("rggb", SHAPE), np.broadcast_to(list(FLUX.values()), (N_FRAMES, *SHAPE, 3)))
    capture.info = replace(capture.info, bayer="gbrg")
    turned = corrected_source(capture, corrections("rot180", {"colour-filter": {"keep": "all"}}))
    np.testing.assert_array_equal(turned.colours()["blue"].valid, bayer_array("gbrg", SHAPE)[::-1, ::-1] == 2)
    assert without_still_pixels(capture).colour is not None
    assert without_still_pixels(grey_scene).colour is None


@pytest.mark.parametrize("search", ["hot-pixels", "still-pixels"])
def test_filter_is_no_fixed_pattern_but_bad_pixels_of_each_colour_are_found(
    mosaic: np.ndarray, corrections: Callable, search: str
) -> None:
    """Coloured stripes move past; of all colours, one pixel in a hundred is hot."""
    rng = np.random.default_rng(3)
    stripes = rng.uniform(0.05, 0.3, (1, SHAPE[0], 400, 3))
    flux = np.concatenate([stripes[:, :, t // 4 : t // 4 + SHAPE[1]] for t in range(N_FRAMES)])
    hot = rng.random(SHAPE) < 0.01
    flux[:, hot] += 2
    pattern = {"colour-filter": {"pattern": "pattern.npy", "keep": "all"}}
    found = ~corrected_source(behind(mosaic, flux), corrections(pattern, search)).valid
    assert found[hot].mean() > 0.8  # near the border, few pixels are of one colour
    assert (found & ~hot).sum() <= 3


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (
            {"keep": "all"},
            "pattern is missing, and the capture does not give it; set it to a file, or to rggb, bggr, grbg, gbrg",
        ),
        (
            {"pattern": "clear.npy", "keep": "all"},
            "keep: all needs red and blue pixels, and {folder}/clear.npy has green and clear ones only; keep: [green, clear] "
            "makes a grey panorama of them",
        ),
        (
            {"pattern": "rggb"},
            "keep: [clear] needs clear pixels, and pattern: rggb has red, green and blue ones only; keep: [red, green, blue] "
            "makes a grey panorama of them",
        ),
        (
            {"pattern": "small.npy", "keep": "all"},
            "pattern: {folder}/small.npy has 4x4 px, and frames have 48x64 px at this place of the list",
        ),
    ],
)
def test_patterns_that_do_not_suit_are_refused(
    grey_scene: MemorySource, corrections: Callable, tmp_path: Path, keys: dict[str, Any], message: str
) -> None:
    np.save(tmp_path / "small.npy", np.full((4, 4, 3), 255, np.uint8))
    clear = np.full((*SHAPE, 3), 255, np.uint8)
    clear[::2] = (0, 255, 0)
    np.save(tmp_path / "clear.npy", clear)
    with pytest.raises(InputError) as caught:
        corrected_source(grey_scene, corrections({"colour-filter": keys}))
    assert str(caught.value) == message.format(folder=tmp_path)
