"""Runs of cameras that turn: what is written, how exact it is, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import parse_spec, run, simulate
from photonpano.geometry import align_rotations, rotation_vectors
from photonpano.pipeline.run import RunResult

FOCAL_PX = 163.0
SIMULATED: dict[str, Any] = {
    "scene": {"kind": "street", "width": 1024, "height": 512, "seed": 2},
    "path": {"kind": "turn", "degrees": 80, "pitch_wobble_deg": 3, "roll_wobble_deg": 2},
    "frame_shape": [96, 160],
    "focal_length_px": FOCAL_PX,
    "flux": 0.8,
    "n_frames": 500,
    "distortion": {"k1": -0.08},
}


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A turn by 80 degrees, through a lens that distorts."""
    path = tmp_path_factory.mktemp("turn") / "turn.npy"
    simulate(parse_spec({"version": 1, "source": {"use": "simulator", "with": SIMULATED}}), path)
    return path


def spec_of(capture: Path, **sections: Any) -> dict[str, Any]:
    source = {"use": "packed-npy", "with": {"path": str(capture), "frame_rate_hz": 96800}}
    return {
        "version": 1,
        "source": source,
        "resample": {"use": "midpoint", "with": {"group_size": 32}},
        "refine": [],
        **sections,
    }


@pytest.fixture(scope="module")
def result(capture: Path) -> RunResult:
    """A run that knows neither the focal length nor the lens."""
    sections = {"motion": {"model": "auto"}, "camera": {"distortion": {"k1": "find"}}}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("photonpano.pipeline.run.render_report", lambda *_: "")
        return run(parse_spec(spec_of(capture, **sections), output=capture.parent / "run"))


def test_rotations_focal_length_and_lens_are_found(result: RunResult, capture: Path) -> None:
    with np.load(result.directory / "trajectory.npz") as found, np.load(capture.with_suffix(".truth.npz")) as truth:
        aligned = align_rotations(found["rotations"], truth["rotations"]) @ found["rotations"]
        away = rotation_vectors(np.swapaxes(truth["rotations"], -1, -2) @ aligned)
        k1 = found["distortion"][0]
    camera = result.record["levels"][-1]["camera"]
    assert np.rad2deg(np.linalg.norm(away, axis=1)).mean() < 0.12
    assert abs(camera["focal_px"] / FOCAL_PX - 1) < 0.005
    assert abs(camera["focal_px"] - FOCAL_PX) < 3 * camera["std_focal_px"]
    assert k1 == pytest.approx(-0.08, rel=0.05)
    assert abs(k1 + 0.08) < 3 * camera["std_distortion"][0]
    assert result.verdict.status == "trusted", [str(each) for each in result.verdict.reasons]


def test_auto_records_which_model_it_took_and_why(result: RunResult) -> None:
    [decision] = [each for each in result.record["decisions"] if each["what"] == "motion_model"]
    assert decision["value"] == "rotation with a lens"
    assert decision["reason"].startswith("beyond shift and roll, the ends of a frame move by ")
