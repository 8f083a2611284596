"""How far the motion and the panorama are from the truth, on simulated captures of 10,000 frames of 254x496.

`make bench` prints the tables. Scenes are two streets that are built in; photographs can be added, separated by colons:

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

import pytest

SCENES: dict[str, dict[str, Any]] = {"street 0": {"kind": "street", "seed": 0}, "street 1": {"kind": "street", "seed": 1}}
for photo in filter(None, os.environ.get("PHOTONPANO_BENCH_PHOTOS", "").split(":")):
    SCENES[Path(photo).stem] = {"kind": "photo", "file": str(Path(photo).resolve()), "width": 2048}


@dataclass(frozen=True)
class Case:
    """A kind of capture, and what must be reached on it on average over the scenes."""

    path_px: int
    group_size: int
    flux: float
    max_error_px: float
    max_below_oracle_db: float | None = None

    def __str__(self) -> str:
        return f"{self.path_px}px-m{self.group_size}-flux{self.flux}"


CASES = [
    Case(750, 250, 0.5, 0.6, 2.0),
    Case(750, 250, 0.1, 1.0, 3.0),
    Case(750, 250, 0.02, 3.0),
    Case(1500, 125, 0.5, 1.0),
    Case(1500, 125, 0.1, 2.0),
]
HEADER = "| scene | path px | group | flux | variant | mean px | max px | PSNR dB | oracle dB | SSIM | s | peak MiB |"


def photonpano(*arguments: str) -> str:
    """Run the program as a user would, and return what it prints."""
    command = [sys.executable, "-c", "from photonpano.cli import main; main()", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def simulate(folder: Path, scene: str, case: Case, **path_keys: Any) -> Path:
    """Write a capture, with the truth beside it."""
    path = {"kind": "random-spline", "length_px": case.path_px} | path_keys
    simulator = {"scene": SCENES[scene], "path": path, "flux": case.flux, "n_frames": 10_000, "frame_shape": [254, 496]}
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
        "psnr_db": scores["panorama"]["psnr_db"],
        "oracle_db": scores["oracle"]["psnr_db"],
        "ssim": scores["panorama"]["ssim"],
        "seconds": record["seconds"],
        "peak_mib": record["peak_memory_bytes"] / 2**20,
    }
    figures = "{error_px:.3f} | {max_px:.2f} | {psnr_db:.2f} | {oracle_db:.2f} | {ssim:.3f} | {seconds:.0f} | {peak_mib:.0f}"
    print(f"| {scene} | {case.path_px} | {case.group_size} | {case.flux} | {variant} | {figures.format(**row)} |", flush=True)
    return row


@pytest.fixture(scope="module", autouse=True)
def header():
    print(f"\n{HEADER}\n|{'---|' * HEADER.count('| ')}")


@pytest.mark.timeout(7200)
@pytest.mark.parametrize("case", CASES, ids=str)
def test_three_levels_of_sift_locate_every_frame(tmp_path, case):
    rows = []
    for scene in SCENES:
        folder = tmp_path / scene
        folder.mkdir()
        cube = simulate(folder, scene, case)
        rows.append(measure(cube, scene, case))
        cube.unlink()
    assert statistics.mean(row["error_px"] for row in rows) < case.max_error_px
    assert max(row["peak_mib"] for row in rows) < 1024
    if case.max_below_oracle_db is not None:
        assert statistics.mean(row["oracle_db"] - row["psnr_db"] for row in rows) < case.max_below_oracle_db


@pytest.mark.timeout(7200)
def test_each_level_improves_and_both_ablations_are_clearly_worse(tmp_path):
    """A hand that trembles within the distance of two groups: what is between them must be seen to be known."""
    case = Case(750, 250, 0.5, 0.6)
    cube = simulate(tmp_path, "street 0", case, shake={"rms_px": 1.0, "frequencies_hz": [25.0, 90.0, 180.0]})
    one, two = (measure(cube, "street 0", case, f"{levels} levels", levels=levels) for levels in (1, 2))
    full = measure(cube, "street 0", case)
    naive = measure(cube, "street 0", case, "naive average", merge={"with": {"compensate": False}})
    midpoint = {"with": {"group_size": case.group_size, "densify": False}}
    constant = measure(cube, "street 0", case, "constant groups", resample=midpoint)
    assert full["error_px"] < two["error_px"] < one["error_px"]
    assert naive["error_px"] > 2 * full["error_px"]
    assert constant["error_px"] > 2 * full["error_px"]
