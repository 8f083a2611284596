"""What moves is shown in a panorama as it was at some moments, and the background everywhere else."""

from functools import cache, partial
from typing import Literal

import numpy as np
import pytest

from photonpano import FrameSpan
from photonpano.capture import with_background
from photonpano.corrections.movers import showing
from photonpano.execution.threads import in_order
from photonpano.geometry import Canvas, translation
from photonpano.merging.panorama import MergeRenderer
from photonpano.testing import KnownMotion, MemorySource, Scene
from photonpano.values import Background

SHAPE, N, SIDE = (96, 128), 800, 24
INSTANTS = np.arange(5.0, N, 10)
CANVAS = Canvas(*SHAPE, np.eye(3))
BRIGHT = 3.0


def walker(frame: float) -> tuple[slice, slice]:
    """A square of 24 px that walks by 0.11 px a frame."""
    left = round(12 + 0.11 * frame)
    return slice(40, 40 + SIDE), slice(left, left + SIDE)


@cache
def crossed(speed_px: float) -> tuple[MemorySource, KnownMotion]:
    """A scene before which a bright square walks, seen by a camera that turns by some px a frame."""
    motion, scene, rng = (
        KnownMotion(lambda frame: translation(speed_px * frame, 0)),
        Scene(0, (0.05, 0.4)),
        np.random.default_rng(0),
    )
    frames, cells = np.empty((N, *SHAPE), np.uint8), []
    for index in range(N):
        if index == 0 or (speed_px and index % 20 == 0):
            still = scene.view(motion.at([index + 10 * bool(speed_px)])[0], SHAPE)
        view = still.copy()
        view[walker(index)] = BRIGHT
        frames[index] = rng.random(SHAPE) < -np.expm1(-view)
    for instant in INSTANTS:
        hidden = np.zeros(SHAPE, bool)
        hidden[walker(instant)] = True
        reaching = np.pad(hidden, 4)
        cells.append(~np.array([[reaching[y : y + 16, x : x + 16].any() for x in range(0, 128, 8)] for y in range(0, 96, 8)]))
    shown = np.array(cells)
    return with_background(MemorySource(frames), Background(INSTANTS, shown, shown, SHAPE)), motion


def merged(movers: str | int, speed_px: float = 0.0) -> tuple[np.ndarray, str]:
    """Return the panorama of the first view, and the reason of the last decision."""
    source, motion = crossed(speed_px)
    shown, decisions, _ = showing(source, motion, None, movers)
    panorama = MergeRenderer(partial(in_order, threads=1)).render(shown, motion, FrameSpan(0, N), CANVAS, 0.125, lambda _: None)
    return panorama.flux, decisions[-1].reason if decisions else ""


def bright_columns(flux: np.ndarray) -> np.ndarray:
    return flux[44 : 40 + SIDE - 4].mean(axis=0) > BRIGHT / 2


@pytest.mark.parametrize("speed_px", [0.0, 0.02])
@pytest.mark.parametrize("frame", [0, 300, 420])
def test_movers_are_shown_where_they_were_at_a_frame(frame: int, speed_px: float) -> None:
    flux, said = merged(frame, speed_px)
    there = walker(frame)[1]
    moved = round(speed_px * frame)
    expected = np.zeros(128, bool)
    expected[there.start + moved : there.stop + moved] = True
    assert (bright_columns(flux) == expected).mean() > 0.95
    assert np.isfinite(flux[:, 16:]).all()
    assert f"{INSTANTS[np.abs(INSTANTS - frame).argmin()]:.0f}" in said


def test_an_action_shot_shows_a_mover_several_times_apart_from_itself() -> None:
    flux, said = merged("action")
    bright = bright_columns(flux)
    starts, ends = (np.flatnonzero(np.diff(bright.astype(int), prepend=0, append=0) == step) for step in (1, -1))
    assert len(starts) == said.count(",") + 1 == 2
    assert (np.abs(ends - starts - SIDE) <= 6).all()
    assert np.isfinite(flux).all()
    assert flux[:36].mean() < 0.3


@pytest.mark.parametrize("movers", ["hide", "show"])
def test_the_share_whose_background_was_never_seen_is_told(movers: Literal["hide", "show"]) -> None:
    """The verdict doubts large ones, whatever the panorama shows."""
    source, motion = crossed(0.0)
    shown = np.ones((len(INSTANTS), 12, 16), bool)
    shown[:, 4:8, 4:12] = False
    never = with_background(source, Background(INSTANTS, shown, np.ones_like(shown), SHAPE))
    _, (said,), share = showing(never, motion, None, movers)
    assert (said.what, said.value) == ("background_never_seen", share)
    assert share == pytest.approx(32 / 192, abs=0.02)
