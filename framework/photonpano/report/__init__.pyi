from .batch_page import render_batch as render_batch
from .drawing import loading_figures as loading_figures
from .failure_page import render_failure as render_failure
from .live_page import LiveFigures as LiveFigures
from .live_page import render_live as render_live
from .page import OpenCapture as OpenCapture
from .page import render_report as render_report
from .pose_page import render_pose_report as render_pose_report
