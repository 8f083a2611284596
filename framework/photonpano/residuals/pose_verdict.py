"""The verdict on poses: a table of tests of what an estimator found, after the doubts of its own."""

from __future__ import annotations

import numpy as np

from photonpano.values import FloatArray, PoseEstimate, Verdict
from photonpano.values.verdict import Found, Test, judged


def judge_poses(estimate: PoseEstimate) -> Verdict:
    """Judge an estimate in a world in which the path has the length 1."""
    return judged(TESTS, estimate, estimate.residual_ratio, estimate.doubts)


def _residuals(estimate: PoseEstimate) -> Found | None:
    return None if estimate.residual_ratio is None else Found(estimate.residual_ratio)


def _position(estimate: PoseEstimate) -> Found | None:
    return _expected(100 * estimate.std_position[estimate.located], "% of the path, root mean square")


def _rotation(estimate: PoseEstimate) -> Found | None:
    return _expected(estimate.std_rotation_deg[estimate.located], "degrees, root mean square")


def _expected(std: FloatArray, unit: str) -> Found | None:
    return Found(float(np.sqrt(np.mean(std**2))), unit) if np.isfinite(std).all() else None


def _unknown(estimate: PoseEstimate) -> Found:
    known = np.isfinite(estimate.std_position) & np.isfinite(estimate.std_rotation_deg)
    return Found(float((~known[estimate.located]).mean()), "share of the frames with a pose")


def _lost(estimate: PoseEstimate) -> Found:
    lost, frames = int((~estimate.located).sum()), len(estimate.located)
    return Found(lost / frames, f"{lost} of {frames} frames")


_MORE_LIGHT = "use more light, a longer path, or more frames of it; or another pose.with.group_size"
TESTS: tuple[Test[PoseEstimate], ...] = (
    Test(
        "the poses do not explain the photons: points are farther from where exposures show them than noise explains",
        1.0,
        "the poses are likely wrong: move farther, or choose another pose.with.group_size",
        _residuals,
    ),
    Test("the expected error of the positions is large", 0.3, _MORE_LIGHT, _position),
    Test("the expected error of the rotations is large", 5.0, _MORE_LIGHT, _rotation),
    Test("the expected errors are not known", 0, "use a pose estimator that knows them, or more light", _unknown),
    Test("many frames have no pose", 0.5, "see the reasons under `lost`; choose another pose.with.group_size", _lost),
)
