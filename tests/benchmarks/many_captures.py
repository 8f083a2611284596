"""Run a batch of 50 small captures, 5 of which are broken, and repeat it.

    python tests/benchmarks/many_captures.py [--jobs 2]

It prints how long both took, and why runs failed. It exits with 1 unless all others are done, and none of them is run again.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from photonpano import parse_spec, simulate

GOOD = 45
BROKEN = ("absent", "black", "cut", "empty", "text")
SPEC = "version: 1\nsource: {use: auto}\nresample: {with: {group_size: 25}}\nlevels: 2\n"


def make_captures(folder: Path) -> None:
    """Simulate good captures of 200 frames of 64x96 px, and write the broken ones; one is absent."""
    for number in range(GOOD):
        simulator = {
            "n_frames": 200,
            "frame_shape": [64, 96],
            "seed": number,
            "flux": 0.5,
            "scene": {"kind": "street", "seed": number, "width": 512, "height": 341},
            "path": {"kind": "pan", "length_px": 20 + number % 20},
        }
        plan = parse_spec({"version": 1, "source": {"use": "simulator", "with": simulator}})
        simulate(plan, folder / f"scan-{number:02d}.npy")
    whole = (folder / "scan-00.npy").read_bytes()
    (folder / "cut.npy").write_bytes(whole[: len(whole) // 2])
    (folder / "empty.npy").touch()
    (folder / "text.npy").write_text("a text, and no capture\n", encoding="utf-8")
    np.save(folder / "black.npy", np.zeros((200, 64, 12), np.uint8))


def run_batch(folder: Path, jobs: int) -> tuple[float, subprocess.CompletedProcess[str]]:
    """Run the command; return its duration in seconds, and what it printed."""
    command = [sys.executable, "-m", "photonpano", "batch", "scan.yaml", "captures/*.npy", "captures/absent.npy"]
    start = time.perf_counter()
    done = subprocess.run([*command, "-o", "out", "--jobs", str(jobs)], cwd=folder, capture_output=True, text=True, check=False)
    return time.perf_counter() - start, done


def main() -> None:
    """Run and repeat the batch."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--jobs", type=int, default=2)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        (folder / "captures").mkdir()
        make_captures(folder / "captures")
        (folder / "scan.yaml").write_text(SPEC, encoding="utf-8")
        good = True
        for what, again in (("first", 0), ("repeated", GOOD)):
            seconds, done = run_batch(folder, arguments.jobs)
            lines = done.stderr.splitlines()
            failed = sorted(line.split()[1].rstrip(":") for line in lines if ": failed: " in line)
            finished = sum(line.endswith(", finished before") for line in lines)
            print(f"{what}: {seconds:.1f} s, exit code {done.returncode}, {finished} finished before, {len(failed)} failed")
            good &= (done.returncode, failed, finished) == (1, list(BROKEN), again)
        print(*(line for line in lines if ": failed: " in line), sep="\n")
    sys.exit(not good)


if __name__ == "__main__":
    main()
