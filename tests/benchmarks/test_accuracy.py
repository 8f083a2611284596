"""Accuracy of motion and panorama on simulated captures of 254x496 px.

Every run has three levels and the default components: `direct`, with `opencv-sift` as the fallback for lost pairs. Captures
have 10,000 frames along a random spline of 1,500 px, at most 0.5 photons per pixel per frame, with and without tremor;
one has a path at five times the speed, and one a raster with loop closures. Bounds are on means over scenes.

`make bench` prints the tables. Scenes are three streets that are built in; photographs can be added, separated by colons:

    PHOTONPANO_BENCH_PHOTOS=canyon.jpg:stream.jpg make bench
"""

from __future__ import annotations

import os
import statistics
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parent))
from harness import Compared, Study, groups, in_child, packed, record_of, scores_of, simulator

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
STRETCHES = 10  # parts of a path that are compared with each other
NEIGHBOURS = {"skips": [], "closure_overlap": None}
HEADER = (
    "| scene | path px | frames | group | flux | shake | variant "
    "| mean px | max px | within 3 std | PSNR dB | oracle dB | SSIM | s | peak MiB |"
)


Measure = Callable[..., dict[str, float]]


def simulated(folder: Path, scene: str, case: Case) -> Measure:
    """Write a capture, with the truth beside it, and return what measures runs of it."""
    path = {"kind": case.kind, "length_px": case.path_px, "shake": SHAKE if case.shake else None}
    study = Study(folder)
    camera = {"scene": SCENES[scene], "path": path, "flux": case.flux, "n_frames": case.n_frames, "frame_shape": [254, 496]}
    cube = in_child(study.capture, scene, simulator(**camera)).result
    return partial(measured, study, cube, scene, case)


def measured(study: Study, cube: Path, scene: str, case: Case, variant: str = "full", **sections: Any) -> dict[str, Any]:
    """Run the pipeline on a capture in a process of its own, score it, and print a row of the table."""
    spec = packed(cube, **{"resample": groups(case.group_size), "levels": 3} | sections)
    folder = in_child(study.run, "run", spec).result
    scores, record = scores_of(folder, cube), record_of(folder)
    row = {
        "error_px": scores.trajectory.mean_px,
        "max_px": scores.trajectory.max_px,
        "within_std": scores.honest_share,
        "psnr_db": scores.panorama.psnr_db,
        "oracle_db": scores.oracle.psnr_db,
        "ssim": scores.panorama.ssim,
        "seconds": record["seconds"],
        "peak_mib": record["peak_memory_bytes"] / 2**20,
    }
    kind = f"{case.path_px} | {case.n_frames} | {case.group_size} | {case.flux} | {'yes' if case.shake else 'no'}"
    figures = "{error_px:.3f} | {max_px:.2f} | {within_std:.3f} | {psnr_db:.2f} | {oracle_db:.2f} | {ssim:.3f}"
    print(f"| {scene} | {kind} | {variant} | {(figures + ' | {seconds:.0f} | {peak_mib:.0f}').format(**row)} |", flush=True)
    errors_px = Compared.of(folder, cube).score.errors_px
    return row | {"stretches_px": [stretch.mean() for stretch in np.array_split(errors_px, STRETCHES)]}


@pytest.fixture(scope="module", autouse=True)
def header():
    print(f"\n{HEADER}\n|{'---|' * HEADER.count('| ')}")


def mean(rows: list[dict[str, float]], figure: str) -> float:
    return statistics.mean(row[figure] for row in rows)


@pytest.mark.timeout(14_400)
@pytest.mark.parametrize("case", [*CASES, FAST], ids=str)
def test_run_reaches_accuracy_bounds(tmp_path, case):
    rows = [simulated(tmp_path, scene, case)() for scene in SCENES]
    assert max(row["peak_mib"] for row in rows) < 1024
    assert min(row["within_std"] for row in rows) >= 0.95
    assert mean(rows, "error_px") < case.mean_px
    if case.worst_px is not None:
        assert mean(rows, "max_px") < case.worst_px
    if case.below_oracle_db is not None:
        assert mean(rows, "oracle_db") - mean(rows, "psnr_db") < case.below_oracle_db


@pytest.mark.timeout(14_400)
def test_loop_closures_bound_drift(tmp_path):
    measures = [simulated(tmp_path, scene, REVISITS) for scene in SCENES]
    chains = [measure("neighbours", graph=NEIGHBOURS) for measure in measures]
    closed = [measure() for measure in measures]
    for row in closed:
        assert max(row["stretches_px"]) < 2 * statistics.median(row["stretches_px"])
    assert mean(closed, "error_px") < REVISITS.mean_px
    assert mean(chains, "error_px") > 3 * mean(closed, "error_px")


@pytest.mark.timeout(7200)
def test_each_level_improves_and_ablations_are_worse(tmp_path):
    """The tremor is faster than the distance of two groups, so that level 1 cannot resolve it."""
    measure = simulated(tmp_path, "street 0", TREMBLING)
    one, two = (measure(f"{levels} levels", levels=levels) for levels in (1, 2))
    full = measure()
    naive = measure("naive average", merge={"with": {"compensate": False}})
    constant = measure("constant groups", resample={"use": "constant-groups", "with": {"group_size": TREMBLING.group_size}})
    assert full["error_px"] < two["error_px"] < one["error_px"]
    assert naive["error_px"] > 2 * full["error_px"]
    assert constant["error_px"] > 2 * full["error_px"]
