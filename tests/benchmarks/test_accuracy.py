"""Accuracy of motion and panorama on simulated captures of 254x496 px.

Every run has three levels and the default components: `direct`, with `opencv-sift` as the fallback for lost pairs. Captures
have 10,000 frames along a random spline of 1,500 px, at most 0.5 photons per pixel per frame, with and without tremor;
one has a path at five times the speed, and one a raster with loop closures. Bounds are on means over scenes.

`make bench` prints the tables. Scenes are three streets that are built in; photographs can be added, separated by colons:

    PHOTONPANO_BENCH_PHOTOS=canyon.jpg:stream.jpg make bench
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano.evaluation import corner_errors

SCENES: dict[str, dict[str, Any]] = {f"street {seed}": {"kind": "street", "seed": seed} for seed in range(3)}
for photo in filter(None, os.environ.get("PHOTONPANO_BENCH_PHOTOS", "").split(":")):
    SCENES[Path(photo).stem] = {"kind": "photo", "file": str(Path(photo).resolve()), "width": 2048}


SHAKE = {"rms_px": 1.0, "frequencies_hz": [25.0, 90.0, 180.0]}


@dataclass(frozen=True)
class Case:
    """A kind of capture, with bounds on the mean scores over the scenes."""

    flux: float
    mean_px: float
    worst_px: float | None = None
    below_oracle_db: float | None = None
    shake: bool = False
    path_px: int = 1500
    n_frames: int = 10_000
    group_size: int | str = "auto"
    kind: str = "random-spline"

    def __str__(self) -> str:
        shake = "-shake" if self.shake else ""
        return f"{self.path_px}px-{self.n_frames}frames-m{self.group_size}-flux{self.flux}{shake}"


CASES = [
    Case(flux, mean_px, worst_px, below_oracle_db, shake)
    for shake in (False, True)
    for flux, mean_px, worst_px, below_oracle_db in ((0.5, 0.08, 0.8, 0.1), (0.1, 0.12, 1.0, 0.1), (0.02, 0.25, 2.0, 0.15))
]
FAST = Case(0.5, 0.5, below_oracle_db=1.0, path_px=3000, n_frames=4000)
REVISITS = Case(0.5, 0.08, path_px=3000, n_frames=20_000, kind="scan")
TREMBLING = Case(0.5, 0.08, shake=True, path_px=750)
STRETCHES = 10
"""Parts of a path that are compared with each other."""
NEIGHBOURS = {"skips": [], "closure_overlap": None}
HEADER = (
    "| scene | path px | frames | group | flux | shake | variant "
    "| mean px | max px | within 3 std | PSNR dB | oracle dB | SSIM | s | peak MiB |"
)


def photonpano(*arguments: str) -> str:
    """Run the command line as users do, and return its output."""
    command = [sys.executable, "-c", "from photonpano.cli import main; main()", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def simulate(folder: Path, scene: str, case: Case) -> Path:
    """Write a capture, with the truth beside it."""
    path = {"kind": case.kind, "length_px": case.path_px, "shake": SHAKE if case.shake else None}
    simulator = {"scene": SCENES[scene], "path": path, "flux": case.flux, "n_frames": case.n_frames, "frame_shape": [254, 496]}
    spec = folder / "capture.yaml"
    spec.write_text(json.dumps({"version": 1, "source": {"use": "simulator", "with": simulator}}))
    cube = folder / "cube.npy"
    photonpano("simulate", str(spec), "--output", str(cube))
    return cube


def measure(cube: Path, scene: str, case: Case, variant: str = "full", **sections: Any) -> dict[str, float]:
    """Run the pipeline on a capture, score it, and print a row of the table."""
    source = {"use": "packed-npy", "with": {"path": str(cube), "frame_rate_hz": 96800}}
    document = {"version": 1, "source": source, "resample": {"with": {"group_size": case.group_size}}, "levels": 3}
    spec = cube.with_name("run.yaml")
    spec.write_text(json.dumps(document | sections))
    run = cube.with_name("run")
    photonpano("run", str(spec), "--output", str(run))
    scores = json.loads(photonpano("evaluate", str(run), "--truth", str(cube.with_name("cube.truth.npz")), "--json"))
    record = json.loads((run / "run.json").read_text())
    row = {
        "error_px": scores["corner_error_px"]["mean"],
        "max_px": scores["corner_error_px"]["max"],
        "within_std": scores["within_three_std_share"],
        "psnr_db": scores["panorama"]["psnr_db"],
        "oracle_db": scores["oracle"]["psnr_db"],
        "ssim": scores["panorama"]["ssim"],
        "seconds": record["seconds"],
        "peak_mib": record["peak_memory_bytes"] / 2**20,
    }
    kind = f"{case.path_px} | {case.n_frames} | {case.group_size} | {case.flux} | {'yes' if case.shake else 'no'}"
    figures = "{error_px:.3f} | {max_px:.2f} | {within_std:.3f} | {psnr_db:.2f} | {oracle_db:.2f} | {ssim:.3f}"
    print(f"| {scene} | {kind} | {variant} | {(figures + ' | {seconds:.0f} | {peak_mib:.0f}').format(**row)} |", flush=True)
    return row


@pytest.fixture(scope="module", autouse=True)
def header():
    print(f"\n{HEADER}\n|{'---|' * HEADER.count('| ')}")


def mean(rows: list[dict[str, float]], figure: str) -> float:
    return statistics.mean(row[figure] for row in rows)


def errors_px(cube: Path) -> np.ndarray:
    """Return the error of every frame of the last run."""
    with np.load(cube.with_name("run") / "trajectory.npz") as found, np.load(cube.with_name("cube.truth.npz")) as truth:
        return corner_errors(found["homographies"], truth["homographies"], tuple(truth["frame_shape"])).errors_px


@pytest.mark.timeout(14_400)
@pytest.mark.parametrize("case", [*CASES, FAST], ids=str)
def test_run_reaches_accuracy_bounds(tmp_path, case):
    rows = []
    for scene in SCENES:
        folder = tmp_path / scene
        folder.mkdir()
        cube = simulate(folder, scene, case)
        rows.append(measure(cube, scene, case))
        cube.unlink()
    assert max(row["peak_mib"] for row in rows) < 1024
    assert min(row["within_std"] for row in rows) >= 0.95
    assert mean(rows, "error_px") < case.mean_px
    if case.worst_px is not None:
        assert mean(rows, "max_px") < case.worst_px
    if case.below_oracle_db is not None:
        assert mean(rows, "oracle_db") - mean(rows, "psnr_db") < case.below_oracle_db


@pytest.mark.timeout(14_400)
def test_loop_closures_bound_drift(tmp_path):
    chains, closed = [], []
    for scene in SCENES:
        folder = tmp_path / scene
        folder.mkdir()
        cube = simulate(folder, scene, REVISITS)
        chains.append(measure(cube, scene, REVISITS, "neighbours", graph=NEIGHBOURS))
        closed.append(measure(cube, scene, REVISITS))
        stretches = [stretch.mean() for stretch in np.array_split(errors_px(cube), STRETCHES)]
        assert max(stretches) < 2 * statistics.median(stretches)
        cube.unlink()
    assert mean(closed, "error_px") < REVISITS.mean_px
    assert mean(chains, "error_px") > 3 * mean(closed, "error_px")


@pytest.mark.timeout(7200)
def test_each_level_improves_and_ablations_are_worse(tmp_path):
    """The tremor is faster than the distance of two groups, so that level 1 cannot resolve it."""
    case = TREMBLING
    cube = simulate(tmp_path, "street 0", case)
    one, two = (measure(cube, "street 0", case, f"{levels} levels", levels=levels) for levels in (1, 2))
    full = measure(cube, "street 0", case)
    naive = measure(cube, "street 0", case, "naive average", merge={"with": {"compensate": False}})
    groups = {"use": "constant-groups", "with": {"group_size": case.group_size}}
    constant = measure(cube, "street 0", case, "constant groups", resample=groups)
    assert full["error_px"] < two["error_px"] < one["error_px"]
    assert naive["error_px"] > 2 * full["error_px"]
    assert constant["error_px"] > 2 * full["error_px"]
