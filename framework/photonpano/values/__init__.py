"""Frozen values that stages exchange; this package imports numpy only."""

from photonpano.values.arrays import BoolArray, Counts, FloatArray, FluxImage, Frames, Homography
from photonpano.values.background import CELL_PX, Background
from photonpano.values.capture import Bayer, CaptureSummary, Decision, DecisionValue, StreamInfo
from photonpano.values.exposure import Panorama, PanoramaRows, Response, VirtualExposure
from photonpano.values.frames import FrameSpan, Group, true_spans
from photonpano.values.light import Light
from photonpano.values.motion import Ambiguity, Edge, Located, NotLocated, Patches, Refined, SpanResiduals
from photonpano.values.poses import CameraGuess, LostFrames, PosedView, PoseEstimate, ScenePoints
from photonpano.values.verdict import Reason, Verdict

__all__ = [
    "CELL_PX",
    "Ambiguity",
    "Background",
    "Bayer",
    "BoolArray",
    "CameraGuess",
    "CaptureSummary",
    "Counts",
    "Decision",
    "DecisionValue",
    "Edge",
    "FloatArray",
    "FluxImage",
    "FrameSpan",
    "Frames",
    "Group",
    "Homography",
    "Light",
    "Located",
    "LostFrames",
    "NotLocated",
    "Panorama",
    "PanoramaRows",
    "Patches",
    "PoseEstimate",
    "PosedView",
    "Reason",
    "Refined",
    "Response",
    "ScenePoints",
    "SpanResiduals",
    "StreamInfo",
    "Verdict",
    "VirtualExposure",
    "true_spans",
]
