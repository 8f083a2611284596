"""Lamps on the mains that light a scene, or parts of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photonpano_simulator.config import Lamp


def brightness(lamp: Lamp, n_frames: int, frame_rate_hz: float) -> NDArray[np.float64]:
    """Return the light of a lamp in each frame: (n_frames,), 1 on average."""
    turns = np.arange(n_frames) / frame_rate_hz * lamp.frequency_hz
    return np.asarray(1 + lamp.depth * np.cos(2 * np.pi * turns + np.deg2rad(lamp.phase_deg)))


def shares(lamps: tuple[Lamp, ...], scene_shape: tuple[int, int], is_round: bool = False) -> NDArray[np.float32]:
    """Return the share of each lamp in the light of each place of the scene.

    Args:
        lamps: of the scene.
        scene_shape: (height, width).
        is_round: whether the left and the right end of the scene meet.

    Returns:
        (N, Hs, Ws); where the lamps together would give more than all of the light, each gives less.
    """
    height, width = scene_shape
    found = np.ones((len(lamps), height, width), np.float32)
    for lamp, share in zip(lamps, found, strict=True):
        if lamp.at is not None:
            x, y = lamp.at[0] * width - 0.5, lamp.at[1] * height - 0.5
            std_px = lamp.radius * height
            beside = np.arange(width) - x
            if is_round:
                beside = np.mod(beside + width / 2, width) - width / 2
            across = np.exp(-(beside**2) / (2 * std_px**2))
            down = np.exp(-((np.arange(height) - y) ** 2) / (2 * std_px**2))
            share[:] = np.outer(down, across)
    return np.asarray(found / np.maximum(found.sum(axis=0), 1), np.float32)
