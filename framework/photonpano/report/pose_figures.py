"""Figures of a run with `pose`: the path and the points from two sides, and the expected error over time."""

from __future__ import annotations

import numpy as np

from photonpano.poses import centres
from photonpano.report.drawing import INK, MUTED, SERIES, WIDTH_IN, Margins, add_axes, add_time_axis, plain_figure, svg_of
from photonpano.values import FloatArray, PoseEstimate

MAX_POINTS = 1500
"""Points that are drawn; of more, every nth."""
MAX_FRAMES = 2000
"""Frames of the path that are drawn; of more, every nth."""
_MARGIN = 0.06
_NEAR_QUANTILES = 0.02, 0.98
"""Quantiles of the points that are in the picture: few points lie very far."""


def path(estimate: PoseEstimate) -> str:
    """Draw the path of the camera, from above (x to the right, z up) and from the side (z to the right, y down)."""
    return _from_two_sides(estimate, np.zeros((0, 3)), "path")


def path_and_points(estimate: PoseEstimate) -> str:
    """Draw the path of the camera and the points that it sees, from above and from the side."""
    points = estimate.points.positions
    return _from_two_sides(estimate, points[:: max(1, -(-len(points) // MAX_POINTS))], "points")


def _from_two_sides(estimate: PoseEstimate, points: FloatArray, name: str) -> str:
    step = -(-len(estimate.located) // MAX_FRAMES)
    places = centres(estimate.camera_from_world[::step])
    known = np.flatnonzero(estimate.located)
    first, last = centres(estimate.camera_from_world[known[[0, -1]]])
    with plain_figure(WIDTH_IN, 5.0) as figure:
        views = add_axes(figure, Margins(left=0.75, bottom=0.55, top=0.3), columns=2, gap_in=0.85)
        sides = (("from above", 0, 2, "x", "z, ahead"), ("from the side", 2, 1, "z, ahead", "y, down"))
        for axes, (title, right, up, x_label, y_label) in zip(views, sides, strict=True):
            axes.plot(points[:, right], points[:, up], ".", color=MUTED, markersize=1.6, alpha=0.7)
            axes.plot(places[:, right], places[:, up], color=SERIES[0], linewidth=2)
            axes.plot(first[right], first[up], "o", color=SERIES[0], markersize=6)
            axes.plot(last[right], last[up], "s", color=SERIES[1], markersize=6)
            axes.set_title(title, color=INK, fontsize=10)
            axes.set_xlabel(x_label)
            axes.set_ylabel(y_label)
            # The axes are square, and so is the part of the scene.
            (left, top), half = _square(places[:, [right, up]], points[:, [right, up]])
            axes.set_xlim(left - half, left + half)
            axes.set_ylim(*((top + half, top - half) if up == 1 else (top - half, top + half)))
        return svg_of(figure, name)


def errors_over_time(estimate: PoseEstimate, frame_rate_hz: float | None) -> str | None:
    """Draw the expected errors of position and rotation over time; None if the estimator knows neither."""
    stds = [np.where(np.isfinite(std), std, np.nan) for std in (100 * estimate.std_position, estimate.std_rotation_deg)]
    if not any(np.isfinite(std).any() for std in stds):
        return None
    n_frames = len(estimate.located)
    frames = np.arange(0, n_frames, -(-n_frames // MAX_FRAMES))
    top = 0.1 if frame_rate_hz is None else 0.55
    with plain_figure(WIDTH_IN, 3.6) as figure:
        rows = add_axes(figure, Margins(top=top), rows=(1, 1), share_x=True)
        for axes, std, label, colour in zip(rows, stds, ("position (%)", "rotation (°)"), SERIES, strict=False):
            axes.plot(frames, std[frames], color=colour)
            axes.set_ylim(0, 1.15 * float(np.nanmax(std, initial=1e-9)))
            axes.set_ylabel(label)
        rows[-1].set_xlabel("frame")
        rows[-1].set_xlim(0, max(1, n_frames - 1))
        if frame_rate_hz is not None:
            add_time_axis(rows[0], n_frames, frame_rate_hz)
        return svg_of(figure, "pose-errors")


def _square(places: FloatArray, points: FloatArray) -> tuple[FloatArray, float]:
    """Return the middle and half the side of a square that holds places (N, 2), and all points (M, 2) but the farthest."""
    near = np.quantile(points, _NEAR_QUANTILES, axis=0) if len(points) else np.zeros((0, 2))
    ends = np.concatenate([[np.nanmin(places, axis=0), np.nanmax(places, axis=0)], near])
    low, high = ends.min(axis=0), ends.max(axis=0)
    return (low + high) / 2, (0.5 + _MARGIN) * float((high - low).max()) or 1.0
