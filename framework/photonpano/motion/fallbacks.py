"""Fallback locators: check what they found against the pairs that the first locator located."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from photonpano.geometry import corner_displacements, inverse
from photonpano.motion.graph import components, solve
from photonpano.motion.model import HOMOGRAPHIES, MotionModel
from photonpano.values import Edge, FloatArray, Located, NotLocated

_CONTRADICTION = 0.05
"""A motion by a fallback locator contradicts those of the first locator if it differs by this share of the shorter side of a
frame."""


def checked_fallbacks(
    edges: Sequence[Edge],
    first_locator: str,
    n_groups: int,
    frame_shape: tuple[int, int],
    start: FloatArray | None,
    model: MotionModel = HOMOGRAPHIES,
) -> tuple[Edge, ...]:
    """Return the pairs; those of fallback locators are not located that contradict what the first locator found between them.

    Exposures that are far apart show less of the scene in common, but all of an object that moves along with the camera. The
    first locator then fails, and features follow the object.

    Args:
        edges: all pairs.
        first_locator: its name.
        n_groups: number of exposures.
        frame_shape: (height, width) of a frame.
        start: (N, 3, 3) homographies by the motion known so far; None at the first level.
        model: what the motion may be.
    """
    firsts = [edge for edge in edges if edge.locator == first_locator]
    others = [edge for edge in edges if isinstance(edge.motion, Located) and edge.locator != first_locator]
    if not firsts or not others:
        return tuple(edges)
    parts = components(n_groups, firsts)
    tied = {(edge.moving, edge.fixed) for edge in others if parts[edge.moving] == parts[edge.fixed]}
    contradicting: dict[tuple[int, int], float] = {}
    for part in {int(parts[moving]) for moving, _ in tied}:
        of_part = [edge for edge in firsts if parts[edge.moving] == part]
        anchor = of_part[len(of_part) // 2].moving
        homographies = solve(n_groups, of_part, anchor, frame_shape, start, model).homographies
        for edge in others:
            if (edge.moving, edge.fixed) in tied and parts[edge.moving] == part and isinstance(edge.motion, Located):
                between = inverse(homographies[edge.fixed]) @ homographies[edge.moving]
                away_px = float(corner_displacements(between, edge.motion.homography, frame_shape).mean())
                if away_px > _CONTRADICTION * min(frame_shape):
                    contradicting[edge.moving, edge.fixed] = away_px

    def checked(edge: Edge) -> Edge:
        away_px = contradicting.get((edge.moving, edge.fixed))
        if away_px is None:
            return edge
        reason = f"{edge.locator}: the motion is {away_px:.0f} px from that along the pairs of {first_locator} in between"
        return replace(edge, motion=NotLocated(reason, edge.motion.evidence), locator="")

    return tuple(map(checked, edges))
