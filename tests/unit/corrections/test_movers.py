"""What moves before the background is told from it, and left out of what is merged and compared."""

from functools import cache

import numpy as np
import pytest

from photonpano import FrameSpan, Group, Source, parse_spec
from photonpano.capture import with_background
from photonpano.corrections.movers import (
    decision_of,
    find_background,
    without_layers,
)
from photonpano.execution.context import Context
from photonpano.execution.threads import Stopwatch
from photonpano.geometry import PATCHES, translation
from photonpano.merging import accumulate, chunks_of
from photonpano.motion.level import VirtualExposures
from photonpano.pipeline.components import build_levels
from photonpano.testing import KnownMotion, MemorySource, Scene

SHAPE, N = (96, 128), 1600
MOTION = KnownMotion(lambda frame: translation(0.04 * float(frame), 0.01 * float(frame)))
ALL = FrameSpan(0, N)


@cache
def panned(with_mover: bool, light: float = 0.0, tremor_px: float = 0.0, side: int = 32, speed: float = 0.06) -> MemorySource:
    """A pan over a scene; a square of 32 px walks through the frame in 1,600 frames."""
    scene, rng = Scene(0, (0.1, 0.5)), np.random.default_rng(0)
    frames = np.empty((N, *SHAPE), np.uint8)
    for first in range(0, N, 8):
        at = MOTION.at([first + 3.5])[0] @ translation(tremor_px * np.sin(first / 60), 0)
        view = scene.view(at, SHAPE).copy()
        if with_mover:
            view[walker(first + 4, side, speed)] = 0.9
        lit = view * (1 + light * np.cos((first + np.arange(8)) / 40))[:, None, None]
        frames[first : first + 8] = rng.random((8, *SHAPE)) < -np.expm1(-lit)
    return MemorySource(frames)


def walker(frame: int, side: int = 32, speed: float = 0.06) -> tuple[slice, slice]:
    left = round(speed * frame)
    return slice(30, 30 + side), slice(left, left + side)


def shares(found: object, frames: range, side: int = 32, speed: float = 0.06) -> tuple[float, float]:
    """Return which share of the square is hidden, and of all else."""
    hits, false = [], []
    for frame in frames:
        pixels = found.pixels(FrameSpan(frame, frame + 1))
        hidden = np.zeros(SHAPE, bool) if pixels is None else pixels == 0
        square = np.zeros(SHAPE, bool)
        square[walker(frame, side, speed)] = True
        hits.append(hidden[square].mean())
        false.append(hidden[~square].mean())
    return float(np.mean(hits)), float(np.mean(false))


@pytest.mark.parametrize("light", [0.0, 0.4], ids=["steady", "flickering"])
def test_what_walks_before_the_background_is_hidden_whatever_the_light(light: float) -> None:
    found = find_background(panned(with_mover=True, light=light), MOTION, None, ALL, Context(threads=1))
    assert found is not None
    hit, false = shares(found, range(100, 1500, 100))
    assert hit > 0.97
    assert false < 0.25
    assert "do not show the background" in decision_of(found).reason


@pytest.mark.parametrize(("light", "tremor_px"), [(0.0, 0.0), (0.4, 0.0), (0.0, 2.5)], ids=["still", "flicker", "tremor"])
@pytest.mark.parametrize("exact", [False, True])
def test_nothing_is_hidden_where_nothing_moves(light: float, tremor_px: float, *, exact: bool) -> None:
    source = panned(with_mover=False, light=light, tremor_px=tremor_px)
    assert find_background(source, MOTION, None, ALL, Context(threads=1), exact=exact) is None


def test_what_is_small_is_hidden_along_an_exact_motion_alone() -> None:
    """A square of 16 px covers 2 % of the frame, as much as the errors of a first motion may."""
    source = panned(with_mover=True, side=16)
    assert find_background(source, MOTION, None, ALL, Context(threads=1)) is None
    found = find_background(source, MOTION, None, ALL, Context(threads=1), exact=True)
    assert found is not None
    hit, false = shares(found, range(100, 1500, 100), side=16)
    assert hit > 0.9
    assert false < 0.2


def test_what_stands_near_and_shifts_all_the_time_is_hidden_along_an_exact_motion() -> None:
    """Of a low contrast, it looks like the background at any instant; the place changes over time, in patches."""
    scene, near, rng = Scene(0, (0.1, 0.5)), Scene(1, (0.15, 0.45)), np.random.default_rng(0)
    frames = np.empty((N, *SHAPE), np.uint8)
    standing = np.zeros((N, *SHAPE), bool)
    for first in range(0, N, 8):
        motion = MOTION.at([first + 3.5])[0]
        view = scene.view(motion, SHAPE).copy()
        left = 80 - round(motion[0, 2])
        square = slice(24, 72), slice(max(left, 0), max(left + 48, 0))
        view[square] = near.view(motion @ translation(first / 80, 0), SHAPE)[square]
        standing[first : first + 8][:, *square] = True
        frames[first : first + 8] = rng.random((8, *SHAPE)) < -np.expm1(-view)
    found = find_background(MemorySource(frames), MOTION, None, ALL, Context(threads=1), exact=True)
    assert found is not None
    hidden = [found.pixels(FrameSpan(frame, frame + 1)) == 0 for frame in range(100, 1500, 100)]
    assert np.mean([each[there].mean() for each, there in zip(hidden, standing[100:1500:100], strict=True)]) > 0.7
    assert np.mean([each[~there].mean() for each, there in zip(hidden, standing[100:1500:100], strict=True)]) < 0.2


def test_the_merged_background_is_that_without_the_walker() -> None:
    found = find_background(panned(with_mover=True), MOTION, None, ALL, Context(threads=1))
    assert found is not None
    onto, shape = translation(0, 0), (112, 192)
    chunks = chunks_of(ALL, MOTION, SHAPE, 1.0)

    def flux(source: object) -> np.ndarray:
        photons = accumulate(source, chunks, onto, shape)
        return np.where(photons.weight > 100, photons.counts / np.maximum(photons.weight, 1), np.nan)

    true = flux(panned(with_mover=False))
    ghost, clean = (
        flux(source) - true for source in (panned(with_mover=True), with_background(panned(with_mover=True), found))
    )
    assert np.nanmax(np.abs(ghost)) > 0.2
    assert np.sqrt(np.nanmean(clean**2)) < 0.25 * np.sqrt(np.nanmean(ghost**2))


@pytest.mark.parametrize("merger", ["photon-mle", "splat"])
def test_exposures_of_mergers_show_the_background_alone(merger: str) -> None:
    found = find_background(panned(with_mover=True), MOTION, None, ALL, Context(threads=1))
    assert found is not None
    group = Group(FrameSpan(700, 860), 779.5)

    def flux(source: Source) -> np.ndarray:
        spec = {"version": 1, "source": {"use": "simulator"}, "levels": [{"merge": {"use": merger}}]}
        (level,) = build_levels(parse_spec(spec), source, [])
        return VirtualExposures(level=level, source=source, groups=[group], previous=MOTION, clock=Stopwatch()).merged(0).flux

    ghost, clean, background = map(
        flux,
        (
            panned(with_mover=True),
            with_background(panned(with_mover=True), found),
            with_background(panned(with_mover=False), found),
        ),
    )
    assert np.isfinite(clean).mean() > 0.7
    assert np.nanmax(np.abs(ghost - background)) > 0.2
    np.testing.assert_allclose(clean, background, atol=1e-6)


def test_patches_that_do_not_follow_the_motion_are_hidden() -> None:
    layers = np.ones((8, PATCHES**2))
    instants = np.linspace(0, N, 8)
    assert without_layers(None, instants, layers, SHAPE) is None
    layers[:, 5 * PATCHES + 6] = 40.0
    found = without_layers(None, instants, layers, SHAPE)
    assert found is not None
    pixels = found.pixels(FrameSpan(800, 801))
    assert pixels is not None
    y, x = int(5.5 * SHAPE[0] / PATCHES), int(6.5 * SHAPE[1] / PATCHES)
    assert pixels[y, x] == 0
    assert pixels.mean() > 0.8
