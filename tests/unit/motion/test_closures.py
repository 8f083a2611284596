from __future__ import annotations

from collections.abc import Callable
from functools import cache

import cv2
import numpy as np
import pytest

from photonpano import FrameSpan, Group, VirtualExposure
from photonpano.geometry import inverse, rescaling, translation
from photonpano.motion.closures import exposure_similarity
from photonpano.photometry import BinaryResponse

SHAPE = (128, 160)
RESPONSE = BinaryResponse()
HERE, NEARBY, ELSEWHERE = translation(20, 20), translation(40.3, 27.6), translation(230, 90)


@cache
def scene(seed: int) -> np.ndarray:
    """A plane of 240x420 px with structures of all sizes from 3 px on, bright and dark by half a stop about 1."""
    noise = np.random.default_rng(seed).normal(size=(240, 420))
    structure = cv2.GaussianBlur(noise, (0, 0), 3) + 4 * cv2.GaussianBlur(noise, (0, 0), 12)
    return np.exp(0.5 * structure / structure.std())


def seen(
    plane: np.ndarray,
    to_plane: np.ndarray,
    flux: float,
    rng: np.random.Generator,
    frames: int = 250,
    scale: float = 1.0,
    unseen: np.ndarray | None = None,
) -> VirtualExposure:
    """Expose a camera that stands still, with the noise of its photons."""
    height, width = (round(side * scale) for side in SHAPE)
    to_pixels = to_plane @ inverse(rescaling(scale))
    mean = cv2.warpPerspective(plane, to_pixels, (width, height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP) * flux
    counts = rng.binomial(frames, 1 - np.exp(-mean))
    weight = np.full(mean.shape, frames, np.float32)
    estimated = RESPONSE.flux((counts / frames).astype(np.float32), weight)
    if unseen is not None:
        estimated[unseen], weight[unseen] = np.nan, 0
    return VirtualExposure(estimated, weight, Group(FrameSpan(0, frames), 0.0), scale, RESPONSE)


def several(measure: Callable[[np.ndarray, np.random.Generator], float], times: int = 12) -> np.ndarray:
    return np.array([measure(scene(seed), np.random.default_rng(seed)) for seed in range(times)])


@pytest.mark.parametrize("scale", [1.0, 0.5])
@pytest.mark.parametrize("flux", [1.0, 0.1, 0.02])
def test_the_same_place_agrees_whatever_the_noise(flux: float, scale: float) -> None:
    """At flux 0.02, most of what varies between pixels is noise: it would pull a plain correlation below 0.9."""

    def alike(plane: np.ndarray, rng: np.random.Generator) -> float:
        moving, fixed = (seen(plane, place, flux, rng, scale=scale) for place in (HERE, NEARBY))
        return exposure_similarity(moving, fixed, inverse(NEARBY) @ HERE)

    found = several(alike)
    assert found.mean() == pytest.approx(1, abs=0.005)
    assert 0.97 < found.min() < found.max() < 1.03


def test_in_the_dark_it_agrees_or_does_not_tell() -> None:
    def alike(plane: np.ndarray, rng: np.random.Generator) -> float:
        moving, fixed = (seen(plane, place, 0.002, rng) for place in (HERE, NEARBY))
        return exposure_similarity(moving, fixed, inverse(NEARBY) @ HERE)

    found = several(alike)
    assert np.all((found == 0) | (found > 0.7))
    assert 0 < np.count_nonzero(found) < len(found)


@pytest.mark.parametrize("scale", [1.0, 0.5])
@pytest.mark.parametrize("flux", [1.0, 0.1, 0.02, 0.002])
def test_different_places_do_not_agree(flux: float, scale: float) -> None:
    def alike(plane: np.ndarray, rng: np.random.Generator) -> float:
        moving, fixed = (seen(plane, place, flux, rng, scale=scale) for place in (HERE, ELSEWHERE))
        return exposure_similarity(moving, fixed, inverse(NEARBY) @ HERE)

    assert np.abs(several(alike)).max() < 0.6


@pytest.mark.parametrize("motion", [np.eye(3), translation(2.2, 1.7), translation(40, 0)], ids=["none", "small", "large"])
@pytest.mark.parametrize("flux", [3.0, 0.1, 0.002])
def test_where_there_is_only_noise_nothing_agrees(flux: float, motion: np.ndarray) -> None:
    def alike(plane: np.ndarray, rng: np.random.Generator) -> float:
        moving, fixed = (seen(np.ones_like(plane), HERE, flux, rng) for _ in range(2))
        return exposure_similarity(moving, fixed, motion)

    np.testing.assert_array_equal(several(alike), 0)


def test_a_wrong_motion_agrees_less_the_further_it_is_off() -> None:
    rng = np.random.default_rng(0)
    moving, fixed = (seen(scene(0), place, 0.1, rng) for place in (HERE, NEARBY))
    found = [exposure_similarity(moving, fixed, translation(off_px, 0) @ inverse(NEARBY) @ HERE) for off_px in (0, 2, 4, 8, 16)]
    assert found == sorted(found, reverse=True)
    assert found[0] > 0.99
    assert found[-1] < 0.5


def test_a_camera_that_rolls_and_tilts_sees_the_same_place() -> None:
    roll = np.array([[np.cos(0.35), -np.sin(0.35), 90], [np.sin(0.35), np.cos(0.35), 30], [2e-4, 0, 1]])
    rng = np.random.default_rng(0)
    moving, fixed = (seen(scene(0), place, 0.1, rng) for place in (roll, translation(80, 60)))
    assert exposure_similarity(moving, fixed, inverse(translation(80, 60)) @ roll) == pytest.approx(1, abs=0.02)


def test_exposures_of_different_lengths_agree() -> None:
    rng = np.random.default_rng(0)
    short, long = seen(scene(0), HERE, 0.1, rng, frames=60), seen(scene(0), NEARBY, 0.1, rng, frames=1000)
    assert exposure_similarity(short, long, inverse(NEARBY) @ HERE) == pytest.approx(1, abs=0.02)
    assert exposure_similarity(long, short, inverse(HERE) @ NEARBY) == pytest.approx(1, abs=0.02)


def test_pixels_that_were_not_seen_do_not_count() -> None:
    """Columns and single pixels are missing from one exposure, rows from the other."""
    rng = np.random.default_rng(0)
    columns, rows = np.zeros(SHAPE, bool), np.zeros(SHAPE, bool)
    columns[:, 70:90] = columns[5, 5] = rows[20:40] = True
    moving = seen(scene(0), HERE, 0.1, rng, unseen=columns)
    fixed = seen(scene(0), NEARBY, 0.1, rng, unseen=rows)
    assert exposure_similarity(moving, fixed, inverse(NEARBY) @ HERE) == pytest.approx(1, abs=0.01)


def test_what_hardly_overlaps_or_is_hardly_seen_does_not_agree() -> None:
    rng = np.random.default_rng(0)
    exposure = seen(scene(0), HERE, 1.0, rng)
    sliver = np.ones(SHAPE, bool)
    sliver[:6] = False
    assert exposure_similarity(exposure, exposure, np.eye(3)) == pytest.approx(1, abs=0.02)
    assert exposure_similarity(exposure, exposure, translation(155, 0)) == 0
    assert exposure_similarity(exposure, exposure, translation(500, 0)) == 0
    assert exposure_similarity(exposure, seen(scene(0), HERE, 1.0, rng, unseen=sliver), np.eye(3)) == 0
    assert exposure_similarity(exposure, seen(scene(0), HERE, 1.0, rng, unseen=np.ones(SHAPE, bool)), np.eye(3)) == 0
    tiny = seen(scene(0), HERE, 1.0, rng, scale=0.02)
    assert exposure_similarity(tiny, tiny, np.eye(3)) == 0
