"""Motion graphs whose pairs are measured with known errors."""

from dataclasses import replace

import numpy as np

from photonpano import Located
from photonpano.geometry import (
    corner_displacements,
    corners,
    from_parameters,
    inverse,
    jacobian,
    normalised,
    parameters,
    translation,
)
from photonpano.values import Edge

SHAPE = (254, 496)
NOISE_PX = 0.1


def true_motion(n_nodes: int, seed: int = 0) -> np.ndarray:
    """A camera that wanders by about 20 px from exposure to exposure, and turns."""
    steps = np.random.default_rng(seed).normal(size=(n_nodes, 8)) * [2e-3, 2e-3, 2e-3, 2e-3, 20, 5, 2e-6, 2e-6]
    return from_parameters(np.cumsum(steps, axis=0))


def edge(true: np.ndarray, moving: int, fixed: int, rng: np.random.Generator | None = None, std_px: float = NOISE_PX) -> Edge:
    """Measure a pair; with a generator, corners have errors of `std_px` along each axis, as the information predicts."""
    homography = normalised(inverse(true[fixed]) @ true[moving])
    to_corners = jacobian(homography, corners(SHAPE)).reshape(8, 8)
    information = to_corners.T @ to_corners / std_px**2
    if rng is not None:
        change = np.linalg.solve(to_corners, rng.normal(scale=std_px, size=8))
        homography = from_parameters(parameters(homography) + change)
    return Edge(moving, fixed, Located(homography, information))


def measured(
    true: np.ndarray, skips: tuple[int, ...], rng: np.random.Generator | None = None, std_px: float = NOISE_PX
) -> list[Edge]:
    return [edge(true, moving, moving - skip, rng, std_px) for moving in range(len(true)) for skip in skips if skip <= moving]


def graph(n_nodes: int, skips: tuple[int, ...] = (1, 2, 4)) -> tuple[np.ndarray, list[Edge]]:
    """Return a true motion, and its pairs measured with noise."""
    true = true_motion(n_nodes)
    return true, measured(true, skips, np.random.default_rng(0))


def confident(edges: list[Edge], times: float) -> list[Edge]:
    """Scale the information of edges as if their errors were `times` smaller."""
    return [replace(each, motion=replace(each.motion, information=each.motion.information * times**2)) for each in edges]


def error_px(homographies: np.ndarray, true: np.ndarray, anchor: int) -> float:
    moved = inverse(normalised(inverse(true[anchor]) @ true)) @ homographies
    return float(corner_displacements(moved, np.eye(3), SHAPE).mean())


def moved(wrong: Edge, x_px: float, y_px: float) -> Edge:
    """Return the edge with an error of (x_px, y_px)."""
    return replace(wrong, motion=replace(wrong.motion, homography=translation(x_px, y_px) @ wrong.motion.homography))


def without_information(edges: list[Edge]) -> list[Edge]:
    return [Edge(each.moving, each.fixed, replace(each.motion, information=None)) for each in edges]
