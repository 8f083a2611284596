"""Render the report of a run with `pose` as an HTML page."""

from __future__ import annotations

import numpy as np

from photonpano.record.pose_record import DOUBTFUL
from photonpano.record.schema import RunRecord
from photonpano.report.drawing import SERIES, WIDTH_IN, Margins, add_axes, add_time_axis, plain_figure, svg_of
from photonpano.report.environment import filled
from photonpano.report.page import head_of
from photonpano.report.pose_views import path_views, scene_views
from photonpano.values import PoseEstimate


def render_pose_report(record: RunRecord, estimate: PoseEstimate) -> str:
    """Return the report of a run with `pose` as one HTML page that needs no other file, no network and no script.

    The path of the estimate has the length 1.
    """
    shape = record["source"]["height"], record["source"]["width"]
    return filled(
        "poses.html",
        **(head_of(record) | {"warnings": [each for each in record["warnings"] if not each.startswith(DOUBTFUL)]}),
        poses=record["poses"],
        path_views=path_views(estimate, shape),
        scene_views=scene_views(estimate, shape) if len(estimate.points.positions) else (),
        errors_over_time=errors_over_time(estimate, record["source"]["frame_rate_hz"]),
    )


MAX_FRAMES = 2000  # frames that are drawn; of more, every nth


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
