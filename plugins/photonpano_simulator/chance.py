"""Random generators: one for each thing left to chance, so that none depends on another."""

from __future__ import annotations

from enum import IntEnum

import numpy as np


class Draw(IntEnum):
    """What is left to chance."""

    PHOTONS = 0
    HOT_PIXELS = 1
    SHAKE = 2
    PATH = 3


def generator(seed: int, draw: Draw, index: int = 0) -> np.random.Generator:
    """Return a generator that depends on nothing but these three numbers."""
    # SFC64 is the fastest of numpy's; hashing the numbers, not adding them, keeps the streams independent.
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed, spawn_key=(draw, index))))
