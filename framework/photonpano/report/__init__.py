"""The HTML report of a run: one page that needs nothing else."""

from photonpano.report.drawing import loading_figures
from photonpano.report.page import render_report
from photonpano.report.pose_page import render_pose_report

__all__ = ["loading_figures", "render_pose_report", "render_report"]
