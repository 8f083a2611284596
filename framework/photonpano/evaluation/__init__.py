"""Scores of trajectories and panoramas against a known truth."""

from photonpano.evaluation.alignment import align_planes
from photonpano.evaluation.images import ImageScore, covered, image_score, true_panorama, white_flux
from photonpano.evaluation.inputs import Truth, load_truth
from photonpano.evaluation.run_scores import Evaluation, Renderer, evaluate
from photonpano.evaluation.trajectory import FrameTrajectory, TrajectoryScore, corner_errors

__all__ = [
    "Evaluation",
    "FrameTrajectory",
    "ImageScore",
    "Renderer",
    "TrajectoryScore",
    "Truth",
    "align_planes",
    "corner_errors",
    "covered",
    "evaluate",
    "image_score",
    "load_truth",
    "true_panorama",
    "white_flux",
]
