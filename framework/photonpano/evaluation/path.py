"""Draw the path of a camera as SVG."""

from __future__ import annotations

import numpy as np

from photonpano.geometry import apply, corners
from photonpano.values import FloatArray

_MAX_POINTS = 500
_MAX_SIDE = 100
"""Longer side of a drawing, in sides of a frame; of a camera that turns further, the plane shows no path."""


def drawn_path(homographies: FloatArray, frame_shape: tuple[int, int]) -> str:
    """Return the path of the middle of the frame over the reference plane, with the outlines of the first and last frame.

    Args:
        homographies: (N, 3, 3) of the located frames, frame pixels to reference pixels.
        frame_shape: (height, width) of a frame.

    Returns:
        An SVG element, which takes the colour of the text around it; empty where the path goes out of the plane.
    """
    if not len(homographies):
        return ""
    some = homographies[np.linspace(0, len(homographies) - 1, min(len(homographies), _MAX_POINTS)).round().astype(int)]
    outline = corners(frame_shape)
    middles = apply(some, np.broadcast_to(outline.mean(axis=0), (len(some), 1, 2)))[:, 0]
    outlines = apply(some[[0, -1]], np.broadcast_to(outline, (2, *outline.shape)))
    points = np.concatenate([middles, outlines.reshape(-1, 2)])
    low, size = points.min(axis=0), np.ptp(points, axis=0)
    if not np.isfinite(points).all() or size.max() > _MAX_SIDE * max(frame_shape):
        return ""
    width, height = size.tolist()
    polygons = "".join(f'<polygon points="{_points(each)}" stroke-opacity="0.4"/>' for each in outlines)
    margin = 0.02 * max(width, height)
    box = f"{low[0] - margin:.1f} {low[1] - margin:.1f} {width + 2 * margin:.1f} {height + 2 * margin:.1f}"
    return (
        f'<svg viewBox="{box}" width="480" style="max-width:100%" fill="none" stroke="currentColor" '
        f'stroke-width="{max(width, height) / 240:.3g}" role="img" aria-label="the path of the camera">'
        f'{polygons}<polyline points="{_points(middles)}"/></svg>'
    )


def _points(points: FloatArray) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
