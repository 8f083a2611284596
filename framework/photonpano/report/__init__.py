"""The HTML report of a run: one page that needs nothing else."""

from photonpano.report.figures import load_figures
from photonpano.report.page import render_report
from photonpano.report.record import RunArrays, RunRecord

__all__ = ["RunArrays", "RunRecord", "load_figures", "render_report"]
