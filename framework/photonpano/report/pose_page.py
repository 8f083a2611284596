"""Render the report of a run with `pose` as an HTML page."""

from __future__ import annotations

from photonpano.record.pose_record import DOUBTFUL
from photonpano.record.schema import RunRecord
from photonpano.report import pose_figures
from photonpano.report.page import environment_of, head_of
from photonpano.values import PoseEstimate


def render_pose_report(record: RunRecord, estimate: PoseEstimate) -> str:
    """Return the report of a run with `pose` as one HTML page that needs no other file, no network and no script.

    Args:
        record: the content of `run.json`.
        estimate: the poses, in a world in which the path has the length 1.
    """
    page: str = (
        environment_of()
        .get_template("poses.html")
        .render(
            head_of(record),
            poses=record["poses"],
            warnings=[each for each in record["warnings"] if not each.startswith(DOUBTFUL)],
            path=pose_figures.path(estimate),
            path_and_points=pose_figures.path_and_points(estimate),
            errors_over_time=pose_figures.errors_over_time(estimate, record["source"]["frame_rate_hz"]),
        )
    )
    return page
