from .other_pages import ComparedRun as ComparedRun
from .other_pages import LiveFigures as LiveFigures
from .other_pages import render_batch as render_batch
from .other_pages import render_comparison as render_comparison
from .other_pages import render_failure as render_failure
from .other_pages import render_live as render_live
from .page import OpenCapture as OpenCapture
from .page import render_report as render_report
