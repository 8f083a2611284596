"""Compare pose estimators where the true poses are known: the table of docs/how-to/poses.md.

    python tests/benchmarks/poses.py docs/how-to/poses.md --work FOLDER
    python tests/benchmarks/poses.py --work FOLDER --only room-1 --flux 0.3

Five simulated captures of 10,000 frames of 254 x 496 pixels, held by a hand with a tremor of 2 px, at three light levels. Each
method is a run of the program as users start it; the seconds and the memory that are printed are those of its process. COLMAP
on sharp frames gets every 200th frame without noise and without blur, and is scored at these. Captures and results stay in the
folder, and what is there already is not measured again. With captures of 160 MB, the whole table takes an hour.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pages import write_tables

from photonpano import CameraGuess, evaluate_poses
from photonpano.evaluation.poses import PoseScore, load_true_poses, pose_errors
from photonpano_colmap.configs import ColmapAveragesConfig
from photonpano_colmap.reconstruction import reconstruct

N_FRAMES, SHAPE, FOCAL_PX, SHARP_EVERY = 10_000, (254, 496), 450.0, 200
TREMOR = {"rms_px": 2.0, "rms_mm": 0.5, "roll_rms_deg": 0.05}
SCENES: dict[str, dict[str, Any]] = {
    "room-1": {"scene": {"kind": "room", "seed": 1}, "path": {"seed": 1, "length_m": 1.0}},
    "room-2": {"scene": {"kind": "room", "seed": 2}, "path": {"seed": 2, "length_m": 1.0}},
    "facade-3": {"scene": {"kind": "facade", "seed": 3}, "path": {"seed": 3, "length_m": 2.0}},
    "facade-4": {"scene": {"kind": "facade", "seed": 4}, "path": {"seed": 4, "length_m": 2.0}},
    "planes-5": {"scene": {"kind": "planes", "seed": 5}, "path": {"seed": 5, "length_m": 2.0}},
}
FLUXES = ("0.3", "0.1", "0.05")
SHARP, AVERAGES, STRATIFIED = "sharp frames", "colmap-averages", "stratified-pose"
METHODS = (SHARP, AVERAGES, STRATIFIED)
HEADER = [
    "| Capture, flux | COLMAP on sharp frames | `colmap-averages` | `stratified-pose` | Within 2 std | Located |",
    "| --- | --- | --- | --- | --- | --- |",
]


def simulated(scene: str, flux: str, work: Path, n_frames: int = N_FRAMES) -> Path:
    """Return a capture, simulated if it is not there."""
    cube = work / f"{scene}-{flux}-{n_frames}.npy"
    if not cube.exists():
        keys = SCENES[scene]
        source = {
            "use": "travel-simulator",
            "with": {
                "scene": keys["scene"],
                "path": {"kind": "travel", **keys["path"], "tremor": TREMOR},
                "flux": float(flux),
                "n_frames": n_frames,
                "frame_shape": list(SHAPE),
                "frame_rate_hz": 10_000 * n_frames / N_FRAMES,
                "focal_px": FOCAL_PX,
            },
        }
        spec = work / f"{cube.stem}.yaml"
        spec.write_text(json.dumps({"version": 1, "source": source}))
        command = ["simulate", str(spec), "--output", str(cube)]
        _program(*command, "--sharp-every", str(SHARP_EVERY))
    return cube


def _program(*arguments: str) -> tuple[int, float, float, str]:
    """Run the program; return its exit status, seconds, memory in MiB, and what it printed."""
    start = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "photonpano", *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    assert process.stdout is not None
    text = process.stdout.read()
    _, status, used = os.wait4(process.pid, 0)
    return os.waitstatus_to_exitcode(status), time.perf_counter() - start, used.ru_maxrss / 1024, text


def measured(scene: str, flux: str, method: str, work: Path, n_frames: int = N_FRAMES) -> dict[str, Any]:
    """Return the figures of a method on a capture."""
    cube = simulated(scene, flux, work, n_frames)
    truth = cube.with_suffix(".truth.npz")
    if method == SHARP:
        return _figures(_sharp(cube, truth))
    folder = work / f"{cube.stem}-{method}"
    spec = work / f"{folder.name}.yaml"
    source = {"use": "packed-npy", "with": {"path": str(cube), "width": SHAPE[1]}}
    spec.write_text(json.dumps({"version": 1, "source": source, "pose": {"use": method}, "camera": {"focal_px": FOCAL_PX}}))
    status, seconds, memory, text = _program("run", str(spec), "--output", str(folder), "--overwrite")
    if status not in (0, 3):
        return {"failed": text.strip().splitlines()[-1] if text.strip() else f"exit status {status}"}
    return _figures(evaluate_poses(folder, truth)) | {"seconds": seconds, "mib": memory}


def _sharp(cube: Path, truth: Path) -> PoseScore:
    """Score COLMAP on sharp frames."""
    pictures = [cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) for file in sorted(cube.with_suffix(".sharp").glob("*.png"))]
    everywhere = np.full(SHAPE, 255, np.uint8)
    config = ColmapAveragesConfig()
    found = reconstruct([(picture, everywhere) for picture in pictures], CameraGuess(focal_px=FOCAL_PX), config, 0)
    piece = found.pieces[0]
    true = load_true_poses(truth).camera_from_world[::SHARP_EVERY]
    poses, located = np.full(true.shape, np.nan), np.zeros(len(true), np.bool_)
    poses[piece.images], located[piece.images] = piece.poses, True
    return pose_errors(poses, true, located, 1)


def _figures(score: PoseScore) -> dict[str, Any]:
    return {
        "ate": 100 * score.ate_share,
        "rotation": score.rotation_deg,
        "turned": score.turns_deg,
        "rpe": score.rpe_deg,
        "located": 100 * score.located_share,
        "within": None if score.honest_shares is None else 100 * score.honest_shares[1],
        "ratio": score.std_ratio,
    }


def row(scene: str, flux: str, of: dict[str, dict[str, Any]]) -> str:
    """Return a row of the table, of the figures of each method."""
    cells = [f"`{scene}`, {flux}"]
    for method in METHODS:
        figures = of.get(method)
        if figures is None:
            cells.append("")
        elif "failed" in figures:
            cells.append(figures["failed"])
        else:
            cells.append(f"{figures['ate']:.3f} %, {figures['turned']:.3f}°")
    best = of.get(STRATIFIED, {})
    cells += ["", ""] if "within" not in best else [f"{best['within']:.0f} %", f"{best['located']:.0f} %"]
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Measure, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("page", type=Path, nargs="?", help="the page whose table is replaced")
    parser.add_argument("--work", type=Path, required=True, help="folder for captures and results")
    parser.add_argument("--only", nargs="*", choices=SCENES, default=list(SCENES))
    parser.add_argument("--flux", nargs="*", choices=FLUXES, default=list(FLUXES))
    parser.add_argument("--methods", nargs="*", choices=METHODS, default=list(METHODS))
    parser.add_argument("--frames", type=int, default=N_FRAMES, help="frames of the captures, of the same paths")
    parser.add_argument("--again", action="store_true", help="measure also what was measured before")
    arguments = parser.parse_args()
    arguments.work.mkdir(parents=True, exist_ok=True)
    lines = []
    for scene in arguments.only:
        for flux in arguments.flux:
            figures = {}
            for method in arguments.methods:
                # Sharp frames are the same whatever the flux.
                name = f"{scene}-{arguments.frames}" if method == SHARP else f"{scene}-{flux}-{arguments.frames}"
                file = arguments.work / f"{name}-{method.replace(' ', '-')}.json"
                if arguments.again or not file.exists():
                    file.write_text(json.dumps(measured(scene, flux, method, arguments.work, arguments.frames)))
                figures[method] = json.loads(file.read_text())
            lines.append(row(scene, flux, figures))
            costs = [f"{name}: {of['seconds']:.0f} s, {of['mib']:.0f} MiB" for name, of in figures.items() if "seconds" in of]
            print(lines[-1], *costs, sep="\n  ", flush=True)
    if arguments.page:
        write_tables(arguments.page, {"poses": [*HEADER, *lines]})


if __name__ == "__main__":
    main()
