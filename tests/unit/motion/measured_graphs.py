"""Motion graphs whose pairs are measured with known errors."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from photonpano import FrameSpan, Group, Located
from photonpano.geometry import (
    align_planes,
    corner_displacements,
    corners,
    from_parameters,
    inverse,
    jacobian,
    normalised,
    parameters,
    transform_points,
    translation,
)
from photonpano.values import Edge

SHAPE = (254, 496)
NOISE_PX = 0.1
TO_CORNERS = jacobian(np.eye(3), corners(SHAPE)).reshape(8, 8)
"""The shifts of the corners of a frame by p1..p8 of a small motion."""


def groups_of(n_nodes: int, length: int = 10, step: int = 10) -> list[Group]:
    """Return groups of `length` frames, each begun `step` frames after the one before."""
    spans = [FrameSpan(step * node, step * node + length) for node in range(n_nodes)]
    return [Group(span, span.centre) for span in spans]


def true_motion(n_nodes: int, seed: int = 0) -> np.ndarray:
    """A camera that wanders by about 20 px from exposure to exposure, and turns."""
    steps = np.random.default_rng(seed).normal(size=(n_nodes, 8)) * [2e-3, 2e-3, 2e-3, 2e-3, 20, 5, 2e-6, 2e-6]
    return from_parameters(np.cumsum(steps, axis=0))


def noise_of(groups: Sequence[Group], rng: np.random.Generator, std_px: np.ndarray | float = NOISE_PX) -> np.ndarray:
    """Draw where exposures show the corners of their frames: (N, 8) px.

    A pair of exposures alike errs by `std_px` along each axis, half of the variance by either. Exposures share the noise of the
    frames that they share.
    """
    frames = rng.normal(size=(max(group.span.stop for group in groups), 8))
    drawn = np.array([frames[each.span.start : each.span.stop].sum(axis=0) / np.sqrt(len(each.span)) for each in groups])
    return drawn * np.broadcast_to(std_px, len(groups))[:, None] / np.sqrt(2)


def shifted(corners_px: np.ndarray) -> np.ndarray:
    """Return the small motions of frames that move their corners by (..., 8) px."""
    return from_parameters(np.linalg.solve(TO_CORNERS, corners_px[..., None])[..., 0])


def edge(
    true: np.ndarray,
    moving: int,
    fixed: int,
    noise: np.ndarray | None = None,
    std_px: np.ndarray | float = NOISE_PX,
    own: tuple[np.random.Generator, float] | None = None,
) -> Edge:
    """Measure a pair with its information, exactly or with the (N, 8) noise of the exposures.

    Args:
        true: the motion of the exposures.
        moving: one of them.
        fixed: the other one.
        noise: see `noise_of`.
        std_px: that of the noise, for all exposures or for each.
        own: a generator, and the standard deviation of the error that the pair adds at the corners by itself.
    """
    exact = normalised(inverse(true[fixed]) @ true[moving])
    stds = np.broadcast_to(std_px, len(true)) / np.sqrt(2)
    changes = from_parameters(np.eye(8)) - np.eye(3)
    covariance = np.zeros((8, 8))
    for moved, std in ((exact @ changes, stds[moving]), (-changes @ exact, stds[fixed])):
        slopes = parameters(np.eye(3) + moved - exact * moved[:, 2:, 2:]).T @ np.linalg.inv(TO_CORNERS)
        covariance += slopes @ slopes.T * std**2
    found = exact if noise is None else normalised(inverse(shifted(noise[fixed])) @ exact @ shifted(noise[moving]))
    if own is not None:
        rng, own_px = own
        back = np.linalg.inv(jacobian(exact, corners(SHAPE)).reshape(8, 8))
        covariance = back @ back.T * own_px**2 + (0 if noise is None else covariance)
        found = from_parameters(parameters(found) + back @ rng.normal(scale=own_px, size=8))
    return Edge(moving, fixed, Located(found, np.linalg.inv(covariance)))


def pairs(n_nodes: int, skips: Sequence[int]) -> list[tuple[int, int]]:
    return [(moving, moving - skip) for moving in range(n_nodes) for skip in skips if skip <= moving]


def measured(
    true: np.ndarray, skips: Sequence[int], noise: np.ndarray | None = None, std_px: np.ndarray | float = NOISE_PX
) -> list[Edge]:
    """Measure pairs, exactly or with the (N, 8) noise of their exposures."""
    return [edge(true, *pair, noise, std_px) for pair in pairs(len(true), skips)]


def apart(true: np.ndarray, skips: Sequence[int], rng: np.random.Generator, std_px: float = NOISE_PX) -> list[Edge]:
    """Measure pairs each of which errs by itself."""
    return [edge(true, *pair, own=(rng, std_px)) for pair in pairs(len(true), skips)]


def seen_by_points(true: np.ndarray, skips: Sequence[int], rng: np.random.Generator, std_px: float) -> list[Edge]:
    """Measure shifts, (N, 3, 3), as points of the scene show them that both exposures of a pair see.

    Each exposure shows each point with errors of `std_px` along each axis, alike in all its pairs. A pair is the homography
    with the least squares.
    """
    offsets, margin = true[:, :2, 2], np.array(SHAPE[::-1])
    least, most = offsets.min(axis=0), offsets.max(axis=0) + margin
    points = np.stack(np.meshgrid(*(np.arange(*ends, 25) for ends in zip(least, most, strict=True))), axis=-1).reshape(-1, 2)
    places = points - offsets[:, None]
    visible = np.all((places >= 0) & (places < margin), axis=-1)
    errors, found = rng.normal(scale=std_px, size=places.shape), []
    for moving, fixed in pairs(len(true), skips):
        both, exact = visible[moving] & visible[fixed], normalised(inverse(true[fixed]) @ true[moving])
        slopes = jacobian(exact, places[moving, both]).reshape(-1, 8)
        change = np.linalg.lstsq(slopes, (errors[fixed] - errors[moving])[both].ravel(), rcond=None)[0]
        motion = Located(from_parameters(parameters(exact) + change), slopes.T @ slopes / (2 * std_px**2))
        found.append(Edge(moving, fixed, motion))
    return found


def graph(n_nodes: int, skips: Sequence[int] = (1, 2, 4)) -> tuple[np.ndarray, list[Edge]]:
    """Return a true motion, and pairs each of which errs by itself."""
    true = true_motion(n_nodes)
    return true, apart(true, skips, np.random.default_rng(0))


def confident(edges: list[Edge], times: float) -> list[Edge]:
    """Scale the information of edges as if their errors were `times` smaller."""
    return [replace(each, motion=replace(each.motion, information=each.motion.information * times**2)) for each in edges]


def error_px(homographies: np.ndarray, true: np.ndarray, anchor: int) -> float:
    moved = inverse(normalised(inverse(true[anchor]) @ true)) @ homographies
    return float(corner_displacements(moved, np.eye(3), SHAPE).mean())


def squared_errors(homographies: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Return the mean square distance of the corners from where they should be, after the best alignment of planes: (N,)."""
    frame = corners(SHAPE)
    missed = transform_points(np.linalg.inv(true) @ align_planes(homographies, true, SHAPE) @ homographies, frame) - frame
    return np.sum(missed**2, axis=-1).mean(axis=-1)


def moved(wrong: Edge, x_px: float, y_px: float) -> Edge:
    """Return the edge with an error of (x_px, y_px)."""
    return replace(wrong, motion=replace(wrong.motion, homography=translation(x_px, y_px) @ wrong.motion.homography))


def without_information(edges: list[Edge]) -> list[Edge]:
    return [Edge(each.moving, each.fixed, replace(each.motion, information=None)) for each in edges]
