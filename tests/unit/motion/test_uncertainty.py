"""The expected errors of a solved motion graph, and what its measurements say of a node."""

from collections.abc import Callable

import numpy as np
import pytest

from photonpano.geometry import (
    align_planes,
    corners,
    transform_points,
)
from photonpano.values import Edge

from .measured_graphs import (
    SHAPE,
    confident,
    edge,
    measured,
)

pytestmark = pytest.mark.usefixtures("one_thread")


def squared_errors(homographies: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Return the mean square distance of the corners from where they should be, after the best alignment of planes: (N,)."""
    frame = corners(SHAPE)
    missed = transform_points(np.linalg.inv(true) @ align_planes(homographies, true, SHAPE) @ homographies, frame) - frame
    return np.sum(missed**2, axis=-1).mean(axis=-1)


def unequal(true: np.ndarray, skips: tuple[int, ...], rng: np.random.Generator) -> list[Edge]:
    """Measure pairs with errors of 0.03 to 0.3 px, and matching information."""
    stds = np.random.default_rng(1).choice([0.03, 0.1, 0.3], size=len(true) * len(skips))
    pairs = [(moving, moving - skip) for moving in range(len(true)) for skip in skips if skip <= moving]
    return [edge(true, *pair, rng, std_px) for pair, std_px in zip(pairs, stds, strict=False)]


GRAPHS: dict[str, Callable[..., list[Edge]]] = {
    "a chain": lambda true, rng: measured(true, (1,), rng),
    "second neighbours": lambda true, rng: measured(true, (1, 2), rng),
    "closed at the end": lambda true, rng: measured(true, (1, len(true) - 1), rng),
    "closed in a part": lambda true, rng: [*measured(true, (1,), rng), edge(true, 8, 1, rng)],
    "unequal noise": lambda true, rng: unequal(true, (1, 2), rng),
    "overconfident": lambda true, rng: confident(measured(true, (1, 2), rng), 3),
}
