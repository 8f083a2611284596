"""Light that changes over time, and the gain of the pixels, are told from the brightness of the scene."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from photonpano import FrameSpan
from photonpano.capture import capture_of, in_light
from photonpano.corrections import ColourFilter, Vignette, corrected_source, divided_by
from photonpano.corrections.gains import SeenCells, local_flicker, solve_gains
from photonpano.corrections.lighting import (
    PixelGain,
    decision_of,
    find_light,
    gain_of_frames,
    in_light_of,
    measure_pixel_gain,
    write_light,
)
from photonpano.execution.context import Context
from photonpano.geometry import Canvas, translation
from photonpano.merging.accumulate import gain_image
from photonpano.merging.panorama import render
from photonpano.testing import KnownMotion, MemorySource, Scene
from photonpano.testing.captures import detected, seen_along

SHAPE, N = (48, 64), 1024
MOTION = KnownMotion(lambda frame: translation(0.06 * float(frame), 0.01 * float(frame)))
STEADY = np.ones(N)
DRIFT = 0.5 ** np.linspace(0, 1, N)
FLICKER = 1 + 0.5 * np.cos(2 * np.pi * np.arange(N) / 90.5)


def panned(
    light: np.ndarray, flux: tuple[float, float] = (0.05, 0.5), seed: int = 0, tremor_px: np.ndarray | None = None
) -> MemorySource:
    """A pan over a scene that gets brighter along the way, with a tremor along x; light: (N,), or of pixels (N, H, W)."""
    scene, rng = Scene(seed, flux), np.random.default_rng(seed)
    frames = np.empty((N, *SHAPE), np.uint8)
    for first in range(0, N, 8):
        at = MOTION.at([first + 3.5])[0]
        if tremor_px is not None:
            at = at @ translation(tremor_px[first + 4], 0)
        view = scene.view(at, SHAPE) * (1 + (at[0, 2] + np.arange(SHAPE[1])) / 60)
        gain = light[first : first + 8].reshape(8, *light.shape[1:] or (1, 1))
        frames[first : first + 8] = rng.random((8, *SHAPE)) < -np.expm1(-view * gain)
    return MemorySource(frames)


@pytest.mark.parametrize("seed", range(2))
def test_lamp_that_is_switched_shows_no_slow_change(seed: int) -> None:
    """Harmonics miss what little light is left in the dark by more than that, and by more than photon noise."""
    light = np.where(np.arange(900) % 60 < 20, 0.05, 1.47)
    gain, std = light.reshape(-1, 4).mean(axis=1), np.where(light[::4] < 1, 0.037, 0.009)
    noisy = gain * (1 + std * np.random.default_rng(seed).standard_normal(225))
    found, _, frequency = gain_of_frames(np.arange(225) * 4 + 1.5, noisy, std, np.full(225, 4.0), 900)
    assert frequency == pytest.approx(1 / 60, rel=0.01)
    assert np.quantile(abs(found - light), 0.9) < 0.5
    assert found[light > 1].reshape(15, 40).mean(axis=1) == pytest.approx(1.47, abs=0.1)


@pytest.mark.parametrize("seed", range(2))
def test_pan_over_bright_scene_is_no_change_of_light(seed: int) -> None:
    assert find_light(panned(STEADY, seed=seed), MOTION, Context(threads=1)) is None


def test_tremor_that_the_motion_lacks_is_no_flicker() -> None:
    tremor = 1.5 * np.sin(2 * np.pi * np.arange(N) / 90.5)
    assert find_light(panned(STEADY, tremor_px=tremor), MOTION, Context(threads=1)) is None


@pytest.mark.parametrize(("light", "period"), [(DRIFT, None), (FLICKER, 90.5)], ids=["drift", "flicker"])
def test_gain_of_each_frame_is_measured(light: np.ndarray, period: float | None) -> None:
    found = find_light(panned(light), MOTION, Context(threads=1))
    assert found is not None
    error = found.gain - light / light.mean()
    assert float(np.sqrt(np.mean(error**2))) < 0.02
    assert found.gain.mean() == pytest.approx(1)
    assert found.frequency == (0 if period is None else pytest.approx(1 / period, rel=2e-3))
    decision = decision_of(found, 9050.0)
    assert decision.what == "light"
    if period is not None:
        assert decision.value == pytest.approx(0.5, abs=0.03)
        assert "Hz" in decision.reason


def test_each_colour_has_a_gain_of_its_own_where_a_red_lamp_goes_down(tmp_path: Path) -> None:
    light = np.ones((N, *SHAPE))
    light[N // 2 :, ::2, ::2] = 0.4  # at the red pixels of the array
    source = corrected_source(panned(light), [ColourFilter(pattern="rggb", keep="all")])
    found = find_light(source, MOTION, Context(threads=1))
    assert found is not None
    lit = {name: each.light for name, each in capture_of(in_light(source, found)).colours().items()}
    for colour, after in (("red", 0.4), ("green", 1.0), ("blue", 1.0)):
        seen = lit[colour]
        assert seen is not None
        true = np.where(np.arange(N) < N // 2, 1, after)
        # In the brightest light, all colours have one gain.
        error = seen.gain / found.gain[: N // 2].mean() - true
        assert float(np.sqrt(np.mean(error**2))) < 0.04, colour
        assert 0 < seen.std.max() < 0.1
    assert decision_of(found, None).reason.startswith("the light of the scene, in each colour by itself, changes between 0.4")
    write_light(tmp_path, found)
    red, read = lit["red"], capture_of(in_light_of(source, tmp_path)).colours()["red"].light
    assert red is not None
    assert read is not None
    np.testing.assert_array_equal((read.gain, read.std), (red.gain, red.std))


def test_colours_in_steady_light_have_no_gains() -> None:
    source = corrected_source(panned(STEADY), [ColourFilter(pattern="rggb", keep="all")])
    assert find_light(source, MOTION, Context(threads=1)) is None


def test_lamps_of_two_phases_are_told_apart() -> None:
    scene, rng, shape = Scene(3, (0.1, 0.6)), np.random.default_rng(3), (32, 96)
    motion = KnownMotion(lambda frame: translation(0.03 * float(frame), 0))
    turns = 2 * np.pi * np.arange(768) / 64
    frames = np.empty((768, *shape), np.uint8)
    for first in range(0, 768, 4):
        at = motion.at([first + 1.5])[0]
        x = at[0, 2] + np.arange(shape[1])
        # The left part of the scene has another phase than the right one.
        phase = np.where(x < 60, 0, 2 * np.pi / 3)
        gain = 1 + 0.6 * np.cos(turns[first : first + 4, None] + phase)
        frames[first : first + 4] = rng.random((4, *shape)) < -np.expm1(-scene.view(at, shape) * gain[:, None, :])
    light = find_light(MemorySource(frames), motion, Context(threads=1))
    assert light is not None
    assert light.has_lamps
    assert light.frequency == pytest.approx(1 / 64, rel=5e-3)
    assert "lamps over parts of the scene" in decision_of(light, None).reason
    for frame in (200, 333, 500):
        x = motion.at([frame])[0][0, 2] + np.arange(shape[1])
        expected = 1 + 0.6 * np.cos(turns[frame] + np.where(x < 60, 0, 2 * np.pi / 3))
        found = gain_image(light, FrameSpan(frame, frame + 1), motion.at([frame])[0], shape)[16]
        inside = (np.abs(x - 60) > 8) & (x > 20) & (x < 96)
        assert float(np.sqrt(np.mean((found - expected)[inside] ** 2))) < 0.08


FIELD, N_FIELD = (64, 96), 120
Y, X = np.indices(FIELD) / 32
GAIN = np.exp(0.3 * np.sin(2 * X + 0.5) * np.cos(1.5 * Y) + 0.1 * X)
GAIN /= GAIN.mean()
"""Brighter and darker by 30 % over distances of 50 px, and brighter to the right."""
EVEN = np.ones(FIELD)


def path(frame: float) -> np.ndarray:
    """Move through the scene, in both directions and back again."""
    turn = 2 * np.pi * frame / N_FIELD
    return translation(50 * np.sin(3 * turn), 40 * np.sin(2 * turn))


CROSSING = KnownMotion(path)


@pytest.fixture(scope="module")
def recorded(street: np.ndarray) -> Callable[..., MemorySource]:
    """Record a street, seen with this gain along this motion."""

    @cache
    def recorded(uneven: bool, motion: KnownMotion = CROSSING) -> MemorySource:
        views = seen_along(street, translation(300, 250) @ motion.at(np.arange(N_FIELD)), FIELD)
        return MemorySource(detected(0.4 * views * (GAIN if uneven else EVEN)))

    return recorded


@pytest.fixture(scope="module")
def measured(recorded: Callable[..., MemorySource]) -> Callable[..., PixelGain]:
    """Measure the gain of a recorded capture along its motion."""
    return cache(lambda uneven: measure_pixel_gain(recorded(uneven), CROSSING, Context()))


@pytest.mark.parametrize(("uneven", "most"), [(True, 0.04), (False, 0.02)], ids=["uneven", "even"])
def test_gain_is_measured_to_its_expected_error(uneven: bool, most: float, measured: Callable[..., PixelGain]) -> None:
    found = measured(uneven)
    error = found.gain / (GAIN if uneven else EVEN) - 1
    rms, expected = (float(np.sqrt(np.mean(each**2))) for each in (error, found.std))
    assert rms < 1.5 * expected
    assert expected < most


def rendered(source: MemorySource, found: PixelGain | None) -> np.ndarray:
    """Return the flux of what most frames saw: (60, 80)."""
    whole = FrameSpan(0, N_FIELD)
    if found is not None:
        mean = (source.counts(whole) / N_FIELD).astype(np.float32)
        source = divided_by(source, Vignette(found.gain, mean, found.spans, found.std))
    canvas = Canvas(60, 80, translation(-8, -2))
    return render(source, CROSSING, whole, canvas, 0.1, Context()).flux


@pytest.mark.parametrize(("uneven", "most"), [(True, 0.04), (False, 0.02)], ids=["uneven", "even"])
def test_divided_panorama_is_that_of_an_even_sensor(
    uneven: bool, most: float, recorded: Callable[..., MemorySource], measured: Callable[..., PixelGain]
) -> None:
    """Its contrast is that of the scene, of which the flat field takes nothing."""
    divided, truth = rendered(recorded(uneven), measured(uneven)), rendered(recorded(False), None)
    assert np.std(divided) / np.mean(divided) == pytest.approx(np.std(truth) / np.mean(truth), rel=most)


@pytest.mark.parametrize("phases", [(0.0, 2.0), (0.0, 0.0)], ids=["two lamps", "one light"])
def test_lamps_over_parts_of_the_scene_are_told_from_light_that_is_the_same_everywhere(phases: tuple[float, float]) -> None:
    """A view of 20 columns passes by: each square is in view for 1.7 periods at most."""
    n_times, frequency = 200, 1 / 700
    spans = tuple(FrameSpan(each, each + 10) for each in range(0, 10 * n_times, 10))
    canvas, rng = Canvas(14, 34, np.eye(3)), np.random.default_rng(0)
    first = np.arange(n_times) * 14 // n_times
    seen_at = (np.arange(34) >= first[:, None]) & (np.arange(34) < first[:, None] + 20)
    times, rows, columns = np.nonzero(np.broadcast_to(seen_at[:, None], (n_times, 14, 34)))
    share = 1 / (1 + np.exp((columns - 17) / 4))
    turns = 2 * np.pi * frequency * (10 * times + 4.5)
    light = 1 + 0.5 * (share * np.cos(turns) + (1 - share) * np.cos(turns + phases[1]))
    exposure = np.full(len(times), 400.0)
    photons = rng.poisson(exposure * light * rng.uniform(0.5, 1, (14, 34))[rows, columns]).astype(float)
    seen = SeenCells(spans=spans, cells=rows * 34 + columns, times=times, photons=photons, exposure=exposure, canvas=canvas)
    found = local_flicker(solve_gains(seen))
    assert (None if found is None else found.frequency) == (pytest.approx(frequency, rel=0.03) if phases[1] else None)
