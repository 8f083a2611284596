"""Frames that are interlaced from two captures, or shuffled, are named; tremor, flicker and copies are not taken for that."""

import cv2
import numpy as np
import pytest

from photonpano.motion.timeline import INTERLACED, SHUFFLED
from photonpano.pipeline.frame_order import interlaced, shuffled
from photonpano.pipeline.obstacles import obstacles
from photonpano.reading import COLOURS, bayer_array
from photonpano.testing import MemorySource

SHAPE, N_FRAMES = (64, 96), 400
TIMES = np.arange(N_FRAMES)


def scene(seed: int) -> np.ndarray:
    """Paint clouds of many sizes: (110, 260) of flux."""
    rng = np.random.default_rng(seed)
    waves = sum(size * cv2.GaussianBlur(rng.standard_normal((110, 260)), (0, 0), size) for size in (1.5, 4, 12))
    return 0.4 * np.exp(0.6 * waves / waves.std())


def taken(x: np.ndarray, flux: np.ndarray, gain: np.ndarray | float = 1.0, seed: int = 0) -> np.ndarray:
    """Take frames at x px: (n, 64, 96)."""
    rng, maps = np.random.default_rng(seed), np.eye(2, 3)
    frames = np.empty((len(x), *SHAPE), np.uint8)
    for frame, at, light in zip(frames, x, np.broadcast_to(gain, len(x)), strict=True):
        maps[:, 2] = at, 20
        seen = cv2.warpAffine(flux, maps, SHAPE[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        frame[:] = rng.random(SHAPE) < -np.expm1(-light * seen)
    return frames


PAN = taken(10 + 0.3 * TIMES, scene(1))
EVERY_SECOND = TIMES % 2


@pytest.mark.parametrize(
    "others",
    [
        pytest.param(taken(10 + 0.3 * TIMES, scene(2), seed=1), id="another scene"),
        pytest.param(np.roll(PAN, -60, axis=0), id="18 px further"),
    ],
)
def test_odd_and_even_frames_of_two_images_are_interlaced(others: np.ndarray) -> None:
    frames = np.where(EVERY_SECOND[:, None, None], others, PAN)[:330]
    [found] = interlaced(MemorySource(frames))
    assert (found.what, float(found.value) > 0.5) == (INTERLACED, True)
    assert any(each.startswith("Odd and even frames show two") for each in obstacles(MemorySource(frames), [found]))


FILTERS = (np.array(list(COLOURS.values()))[bayer_array("rggb", SHAPE)] / 255).mean(axis=-1)


@pytest.mark.parametrize(
    "frames",
    [
        pytest.param(PAN, id="pan"),
        pytest.param(PAN[::-1], id="reversed"),
        pytest.param(PAN & (np.random.default_rng(3).random(PAN.shape) < FILTERS), id="colour filters"),
        pytest.param(PAN[:20], id="20 frames"),
        pytest.param(PAN[:3], id="3 frames"),
        pytest.param(taken(10 + 0.3 * TIMES + 4 * EVERY_SECOND, scene(1)), id="tremor of every second frame"),
        pytest.param(taken(10 + 0.3 * TIMES + np.random.default_rng(1).normal(0, 1, N_FRAMES), scene(1)), id="tremor"),
        pytest.param(taken(10 + 0.3 * TIMES, scene(1), 1 - 0.7 * EVERY_SECOND), id="flicker at half of the frame rate"),
        pytest.param(taken(10 + 0.3 * TIMES, scene(1), 1.0 - EVERY_SECOND), id="light in every second frame"),
        pytest.param(taken(10 + 0.3 * TIMES, scene(1), 0.01), id="dark"),
        pytest.param(taken(10 + 0.0 * TIMES, scene(1)), id="rest"),
        pytest.param(taken(10 + 0.3 * TIMES, np.full((110, 260), 0.4)), id="no texture"),
        pytest.param(taken(10 + 6 * TIMES[:25], scene(1)), id="fast"),
        pytest.param(np.repeat(PAN[:200], 2, axis=0), id="each frame twice"),
        pytest.param(PAN[TIMES - (TIMES % 10 == 9)], id="every tenth frame twice"),
    ],
)
def test_frames_in_their_order_are_neither_interlaced_nor_shuffled(frames: np.ndarray) -> None:
    source = MemorySource(frames)
    assert interlaced(source) == shuffled(source) == []


def test_shuffled_frames_jump_back_and_forth() -> None:
    source = MemorySource(PAN[np.random.default_rng(4).permutation(N_FRAMES)])
    assert interlaced(source) == []
    [found] = shuffled(source)
    assert (found.what, float(found.value) > 0.05) == (SHUFFLED, True)
    [says] = obstacles(source, [found])
    assert says.startswith("From one frame to the next, the image jumps back and forth by ")
