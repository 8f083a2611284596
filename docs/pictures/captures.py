"""Simulated captures, and runs of them, which later calls use again."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from photonpano import evaluate, open_source, run
from photonpano.captures.writing import truth_path, write_packed
from photonpano.geometry import FrameTrajectory

if TYPE_CHECKING:
    from photonpano import Plan

EXAMPLES = Path(__file__).parents[2] / "examples" / "pipelines"


def in_folder(folder: Path, name: str) -> Path:
    """Return the run folder of a run."""
    return folder / name.replace(" ", "-")


def written(plan: Plan, cube: Path) -> Path:
    """Simulate a capture."""
    if not cube.exists():
        with open_source(plan) as source:
            write_packed(source, cube)
    return cube


def done(plan: Plan) -> Path:
    """Run a plan, unless it was run, and return its run folder."""
    if not (plan.output.directory / "run.json").exists():
        run(plan)
    return plan.output.directory


def finish(plan: Plan, name: str, cube: Path) -> None:
    """Run a plan, and print its scores."""
    scores = evaluate(done(plan), truth_path(cube))
    assert scores.panorama is not None
    print(
        f"{name:16} corner error mean {scores.trajectory.mean_px:.2f} px, worst {scores.trajectory.max_px:.2f} px, "
        f"PSNR {scores.panorama.psnr_db:.2f} dB, {scores.below_oracle_db:.2f} dB below the oracle"
    )


def spec_of(cube: Path, **sections: Any) -> dict[str, Any]:
    """Return the spec of a capture of single photons."""
    source = {"use": "packed-npy", "with": {"path": str(cube.absolute()), "frame_rate_hz": 96_800}}
    return {"version": 1, "source": source, **sections}


def motion(directory: Path) -> FrameTrajectory:
    """Return the estimated motion of a run."""
    with np.load(directory / "trajectory.npz") as trajectory:
        return FrameTrajectory(trajectory["homographies"])
