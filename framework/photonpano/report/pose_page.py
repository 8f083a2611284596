"""Render the report of a run with `pose` as an HTML page."""

from __future__ import annotations

from photonpano.record.pose_record import DOUBTFUL
from photonpano.record.schema import RunRecord
from photonpano.report.environment import environment_of
from photonpano.report.page import head_of
from photonpano.report.pose_figures import errors_over_time
from photonpano.report.pose_views import path_views, scene_views
from photonpano.values import PoseEstimate


def render_pose_report(record: RunRecord, estimate: PoseEstimate) -> str:
    """Return the report of a run with `pose` as one HTML page that needs no other file, no network and no script.

    Args:
        record: the content of `run.json`.
        estimate: the poses, in a world in which the path has the length 1.
    """
    shape = record["source"]["height"], record["source"]["width"]
    page: str = (
        environment_of()
        .get_template("poses.html")
        .render(
            head_of(record),
            poses=record["poses"],
            warnings=[each for each in record["warnings"] if not each.startswith(DOUBTFUL)],
            path_views=path_views(estimate, shape),
            scene_views=scene_views(estimate, shape) if len(estimate.points.positions) else (),
            errors_over_time=errors_over_time(estimate, record["source"]["frame_rate_hz"]),
        )
    )
    return page
