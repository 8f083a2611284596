"""Measure where runs cut the motion: jumps that are missed, and cuts where the image does not jump.

    python tests/benchmarks/cuts.py [--rows tremor] [--seeds 30]

Each row is a kind of capture of 96x144 px and 1,600 frames with a known truth, simulated with another scene, path and noise for
each seed. A cut is right if the camera left out, or repeated, frames within two frames of it; jumps that are smaller than 1 px
are not counted as missed. A run takes about ten seconds on two cores.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from photonpano import evaluate, parse_spec, run, simulate
from photonpano.geometry import apply, inverse

Settings: TypeAlias = dict[str, Any]
SHAPE, N_FRAMES, FRAME_RATE_HZ = (96, 144), 1600, 96_800
SPLINE = {"kind": "random-spline", "length_px": 240}
RASTER = {"kind": "scan", "rows": 3, "row_spacing_px": 24, "length_px": 480}
NEAR = 2
"""Frames between a jump and a cut that counts as found."""
SMALLEST_PX = 1.0
"""Smaller jumps are not counted as missed."""


def shaken(rms_px: float, *frequencies_hz: float) -> Settings:
    """Return a random path with tremor."""
    return {"path": SPLINE | {"shake": {"rms_px": rms_px, "roll_rms_deg": 0, "frequencies_hz": list(frequencies_hz)}}}


TREMOR = shaken(1, 223, 590, 1270)
ROWS: dict[str, Settings] = {
    "clean, flux 0.5": {"path": SPLINE, "flux": 0.5},
    "clean, flux 0.1": {"path": SPLINE, "flux": 0.1},
    "clean, flux 0.02": {"path": SPLINE, "flux": 0.02},
    "clean, fast turns": {"path": SPLINE | {"length_px": 900, "knots": 12}, "flux": 0.5},
    "clean raster": {"path": RASTER, "flux": 0.5},
    "clean, tremor of 1 px": TREMOR | {"flux": 0.2},
    "clean, vibration of 3 px": shaken(3, 1000) | {"flux": 0.5},
    "clean, strong shake": shaken(10, 25, 90, 210) | {"flux": 0.5},
    "20 frames missing": {"path": SPLINE, "flux": 0.5, "drops": [{"at": 700, "frames": 20}]},
    "60 frames missing, flux 0.1": {"path": SPLINE, "flux": 0.1, "drops": [{"at": 700, "frames": 60}]},
    "60 frames missing twice, tremor": TREMOR | {"flux": 0.2, "drops": [{"at": at, "frames": 60} for at in (500, 1000)]},
    "50 frames doubled": {"path": SPLINE, "flux": 0.5, "repeats": [{"at": 700, "frames": 50}]},
}


def jumps_of(truth: dict[str, np.ndarray]) -> dict[int, float]:
    """Return the frames before which frames are missing or repeated, and how far the image jumps there, in px."""
    taken = truth.get("taken", np.arange(len(truth["homographies"])))
    frames = np.flatnonzero(np.diff(taken) != 1) + 1
    middle = (np.array([[SHAPE[1], SHAPE[0]]]) - 1) / 2
    motions = inverse(truth["homographies"][frames]) @ truth["homographies"][frames - 1]
    return {
        int(frame): float(np.linalg.norm(apply(motion, middle) - middle)) for frame, motion in zip(frames, motions, strict=True)
    }


def measured(settings: Settings, seed: int) -> tuple[list[int], list[int], list[float], float]:
    """Return the cuts that are right, those that are not, the sizes of the jumps that are missed, and the mean error."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        path = settings["path"] | ({"seed": seed} if settings["path"]["kind"] == "random-spline" else {})
        scene = {"kind": "street", "seed": seed}
        known = {"frame_shape": SHAPE, "n_frames": N_FRAMES, "frame_rate_hz": FRAME_RATE_HZ, "seed": seed, "scene": scene}
        source = {"use": "simulator", "with": settings | known | {"path": path}}
        cube = simulate(parse_spec({"version": 1, "source": source}), folder / "capture.npy").path
        capture = {"use": "packed-npy", "with": {"path": str(cube), "frame_rate_hz": FRAME_RATE_HZ}}
        done = run(parse_spec({"version": 1, "source": capture}, output=folder / "run"))
        with np.load(cube.with_suffix(".truth.npz")) as truth:
            jumps = jumps_of(dict(truth))
        error_px = evaluate(done.directory, cube.with_suffix(".truth.npz")).trajectory.mean_px
    cuts = [int(each["value"]) for each in done.record["decisions"] if each["what"] == "cut"]
    found = [cut for cut in cuts if any(abs(cut - frame) <= NEAR for frame in jumps)]
    large = {frame: size for frame, size in jumps.items() if size >= SMALLEST_PX}
    missed = [size for frame, size in large.items() if not any(abs(cut - frame) <= NEAR for cut in cuts)]
    return found, [cut for cut in cuts if cut not in found], missed, error_px


def main() -> None:
    """Print a row of Markdown for each kind of capture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", nargs="+", default=[""], metavar="WORD", help="words in the names of the rows to measure")
    parser.add_argument("--seeds", type=int, default=3, help="number of seeds of each row")
    arguments = parser.parse_args()
    print("| Capture | Runs | Jumps found | Missed, px | False cuts | Mean error, px |\n" + "| --- " * 6 + "|", flush=True)
    for name, settings in ROWS.items():
        if not any(word in name for word in arguments.rows):
            continue
        results = [measured(settings, seed) for seed in range(arguments.seeds)]
        found, false = (sum(len(each[part]) for each in results) for part in (0, 1))
        missed = ", ".join(f"{size:.1f}" for each in results for size in each[2]) or "-"
        error_px = float(np.mean([each[3] for each in results]))
        print(f"| {name} | {len(results)} | {found} | {missed} | {false} | {error_px:.3f} |", flush=True)


if __name__ == "__main__":
    main()
