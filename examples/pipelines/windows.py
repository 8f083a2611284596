"""Write windows.npy: a pan along equal windows, hidden by a hand while the camera moves on by one window."""

import math
from pathlib import Path

import cv2
import numpy as np

from photonpano.geometry import translation
from photonpano.testing.captures import detected, seen_along, textured
from photonpano.values import FloatArray

SHAPE, N_FRAMES, HAND, WINDOW_PX = (96, 144), 650, (300, 350), 40


def to_scene(frame: float) -> FloatArray:
    """Return the map from pixels of a frame to pixels of the scene: (3, 3)."""
    moved_on = WINDOW_PX if frame >= sum(HAND) / 2 else 0
    return translation(4 + 0.28 * frame + moved_on, 10 + 4 * math.sin(frame / 150))


def scene() -> FloatArray:
    """Draw two rows of windows, which only a poster between them tells apart: (H, W) flux."""
    y, x = np.mgrid[:124, :420]
    wall = np.full(x.shape, 0.5)
    for top in (16, 66):
        across, down = x % WINDOW_PX - 20, y - top
        pane = (abs(across) < 12) & (down > 0) & (down < 34)
        wall[pane] = 0.15
        wall[pane & ((abs(across) < 1.5) | (abs(down - 14) < 1.5))] = 0.7
    wall = cv2.GaussianBlur(wall * textured(x.shape, 0.975, 0.05, 6), (0, 0), 0.8)
    wall[6:118, 188:218] = cv2.GaussianBlur(textured((112, 30), 0.6, 1.2, 11), (0, 0), 0.8)
    return wall


def main(folder: Path = Path()) -> None:
    """Write the capture into a folder."""
    frames = detected(seen_along(scene(), [to_scene(frame) for frame in range(N_FRAMES)], SHAPE), 1)
    hand = np.random.default_rng(0).random((HAND[1] - HAND[0], *SHAPE)) < 0.35
    frames[slice(*HAND)] = hand
    np.save(folder / "windows.npy", np.packbits(frames, axis=-1))


if __name__ == "__main__":
    main()
