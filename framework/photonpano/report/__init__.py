"""The HTML report of a run: one page that needs nothing else."""

from photonpano.report.page import render_report
from photonpano.report.record import RunArrays, RunRecord

__all__ = ["RunArrays", "RunRecord", "render_report"]
