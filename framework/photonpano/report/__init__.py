"""The HTML report of a run: one page that needs nothing else."""

from photonpano.report.drawing import loading_figures
from photonpano.report.page import render_report

__all__ = ["loading_figures", "render_report"]
