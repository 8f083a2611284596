"""Describe a run that found poses, for `run.json`."""

from __future__ import annotations

import numpy as np

from photonpano.geometry import Camera
from photonpano.record.schema import PosesRecord
from photonpano.values import FloatArray, PoseEstimate

DOUBTFUL = "doubtful: "  # begins the warnings that are doubts
_SHOWN = 3  # spans of lost frames that a warning names


def poses_record(estimate: PoseEstimate) -> PosesRecord:
    """Describe an estimate, in a world in which the path has the length 1."""
    camera = Camera(estimate.camera_matrix, estimate.distortion)
    return {
        "camera": {
            "focal_px": camera.focal_px,
            "std_focal_px": _finite(estimate.std_focal_px),
            "centre_px": list(camera.centre_px),
            "distortion": camera.distortion.tolist(),
            "std_distortion": [0.0] * 4,
        },
        "located": int(estimate.located.sum()),
        "std_position": _rms(estimate.std_position[estimate.located]),
        "std_rotation_deg": _rms(estimate.std_rotation_deg[estimate.located]),
        "points": len(estimate.points.positions),
        "exposures": len(estimate.views),
        "lost": [{"frames": [each.span.start, each.span.stop], "reason": each.reason} for each in estimate.lost],
        "levels": [dict(level) for level in estimate.levels],
        "doubts": list(estimate.doubts),
    }


def poses_warnings(estimate: PoseEstimate) -> list[str]:
    """Warn of doubts, and of frames without a pose."""
    warnings = [f"{DOUBTFUL}{doubt}" for doubt in estimate.doubts]
    if not estimate.located.all():
        lost, frames = int((~estimate.located).sum()), len(estimate.located)
        spans = "; ".join(f"{each.span}: {each.reason}" for each in estimate.lost[:_SHOWN])
        more = f"; and {len(estimate.lost) - _SHOWN} more spans" if len(estimate.lost) > _SHOWN else ""
        warnings.append(f"{lost} of {frames} frames have no pose ({spans}{more})")
    return warnings


def _rms(std: FloatArray) -> float | None:
    return _finite(float(np.sqrt(np.mean(std**2)))) if len(std) else None


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
