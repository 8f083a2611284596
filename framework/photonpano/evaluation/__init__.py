"""Scores of trajectories and panoramas against the truth of simulated captures."""

from photonpano.evaluation.bounds import exposure_bound_px, pair_bound_px
from photonpano.evaluation.images import ImageScore, covered, image_score, true_panorama, white_flux
from photonpano.evaluation.inputs import RunTrajectory, Truth, load_panorama, load_run_trajectory, load_truth
from photonpano.evaluation.poses import (
    PoseScore,
    RunPoses,
    align_positions,
    evaluate_poses,
    has_poses,
    load_run_poses,
    load_true_poses,
    pose_errors,
)
from photonpano.evaluation.run_scores import Evaluation, Renderer, evaluate
from photonpano.evaluation.trajectory import RotationScore, TrajectoryScore, Turn, corner_errors, rotation_errors

__all__ = [
    "Evaluation",
    "ImageScore",
    "PoseScore",
    "Renderer",
    "RotationScore",
    "RunPoses",
    "RunTrajectory",
    "TrajectoryScore",
    "Truth",
    "Turn",
    "align_positions",
    "corner_errors",
    "covered",
    "evaluate",
    "evaluate_poses",
    "exposure_bound_px",
    "has_poses",
    "image_score",
    "load_panorama",
    "load_run_poses",
    "load_run_trajectory",
    "load_true_poses",
    "load_truth",
    "pair_bound_px",
    "pose_errors",
    "rotation_errors",
    "true_panorama",
    "white_flux",
]
