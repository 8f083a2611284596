"""Measure runs that follow a capture: delay, rate and memory; the tables of docs/how-to/as-it-arrives.md.

    python tests/benchmarks/following.py docs/how-to/as-it-arrives.md [--frames 60000] [--long 1000000]

A writer, a process of its own, passes frames through a pipe at a rate. It reads a simulated capture to and fro. Each run is
ended when all frames have arrived, but one, which is compared with a run of the same frames without `--follow`. Simulating
takes a minute, and the spools 1.6 GB for each 100,000 frames of 254 x 496 px, one after the other.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pages import write_tables

PROGRAM = [sys.executable, "-m", "photonpano"]
SIMULATED = 10_000
RESULTS = ("panorama.tiff", "coverage.tiff", "trajectory.npz", "panorama.png")
BATCH = 64
"""Frames that the writer writes at once."""
STARTED_S = 15.0
"""The writer waits for the program to start; a camera is started after it, too."""


@dataclass(frozen=True)
class Measured:
    """A run that was followed.

    Attributes:
        figures: the last of `live.json` while frames came.
        memory: (N, 2) of frames that had arrived, and the memory of the process, in MiB.
        waiting: (N, 2) of seconds since the first frame, and how long the first frame that was not located had waited.
        cpu_s: time of all cores that the process has used.
    """

    figures: dict[str, Any]
    memory: np.ndarray
    waiting: np.ndarray
    cpu_s: float


def simulate(folder: Path, shape: tuple[int, int]) -> Path:
    """Write a capture of a trembling hand."""
    cube = folder / f"{shape[0]}.npy"
    shake = {"rms_px": 2.0, "frequencies_hz": [25, 120, 400]}
    simulator = {
        "scene": {"kind": "street", "width": 2048, "height": 1365},
        "path": {"kind": "random-spline", "length_px": 200, "shake": shake},
        "flux": 0.3,
        "n_frames": SIMULATED,
        "frame_shape": list(shape),
    }
    spec = folder / "simulate.yaml"
    spec.write_text(json.dumps({"version": 1, "source": {"use": "simulator", "with": simulator}}))
    subprocess.run([*PROGRAM, "simulate", str(spec), "--output", str(cube)], check=True, stdout=subprocess.DEVNULL)
    return cube


def write(cube: Path, rate: float, n_frames: int) -> None:
    """Write frames to standard output at a rate, the capture to and fro; as fast as possible for a rate of 0."""
    frames = np.load(cube, mmap_mode="r")
    to_and_fro = np.concatenate([frames, frames[-2:0:-1]])
    time.sleep(STARTED_S)
    start, written = time.monotonic(), 0
    while written < n_frames:
        due = written + BATCH if not rate else min(n_frames, int((time.monotonic() - start) * rate))
        if due - written < min(BATCH, n_frames - written):
            time.sleep(0.001)
            continue
        first = written % len(to_and_fro)
        part = to_and_fro[first : first + min(BATCH, n_frames - written)]
        sys.stdout.buffer.write(part.tobytes())
        written += len(part)
    sys.stdout.buffer.flush()


def spec_for(folder: Path, shape: tuple[int, int], path: str = "-") -> Path:
    """Write a spec."""
    spec = folder / "spec.yaml"
    source = {"use": "packed-raw", "with": {"path": path, "height": shape[0], "width": shape[1], "frame_rate_hz": 96_800}}
    spec.write_text(json.dumps({"version": 1, "source": source, "resample": {"with": {"group_size": 250}}, "levels": 3}))
    return spec


def follow(folder: Path, cube: Path, rate: float, n_frames: int, to_the_end: bool = False) -> Measured:
    """Follow a writer."""
    shape = np.load(cube, mmap_mode="r").shape[1], 8 * np.load(cube, mmap_mode="r").shape[2]
    live = folder / "run.live" / "live.json"
    shutil.rmtree(live.parent, ignore_errors=True)
    command = [*PROGRAM, "run", str(spec_for(folder, shape)), "--follow", "--overwrite", "--output", str(folder / "run")]
    written = [sys.executable, __file__, "--write", str(cube), str(rate), str(n_frames)]
    memory, waiting, figures = [], [], {"state": "waiting"}
    with (
        subprocess.Popen(written, stdout=subprocess.PIPE) as writer,
        subprocess.Popen(command, stdin=writer.stdout, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as program,
    ):
        assert writer.stdout is not None
        writer.stdout.close()
        start = None
        while program.poll() is None:
            time.sleep(0.25)
            seen = json.loads(live.read_text()) if live.exists() else {"state": "waiting"}
            if seen["state"] == "following":
                start = start or time.monotonic()
                figures = seen
                memory.append((seen["frames"], resident_mib(program.pid)))
                waiting.append((time.monotonic() - start, seen["behind_s"]))
            elif seen["state"] == "finishing":
                figures = seen
                break
        cpu_s = cpu_seconds(program.pid) if program.poll() is None else float("nan")
        if not to_the_end:
            program.send_signal(signal.SIGINT)
        errors = program.communicate()[1].decode()
    if to_the_end and program.returncode:
        raise SystemExit(errors)
    return Measured(figures, np.array(memory), np.array(waiting), cpu_s)


def resident_mib(process: int) -> float:
    """Return the memory of a process, its pages of files left out."""
    status = Path(f"/proc/{process}/status").read_text()
    return int(re.search(r"^RssAnon:\s+(\d+)", status, re.MULTILINE)[1]) / 1024


def cpu_seconds(process: int) -> float:
    """Return the time of all cores that a process has used."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def row(shape: str, rate: float, measured: Measured) -> str:
    """Return a row of the table of delays."""
    figures = measured.figures
    asked = f"{rate:,.0f}" if rate else "as many as come"
    return (
        f"| {shape} | {asked} | {figures['frames']:,} | {figures['located']:,} | {figures['delay_mean_s']:.2f} s | "
        f"{figures['delay_95_s']:.2f} s | {figures['delay_longest_s']:.2f} s | {figures['behind_s']:.1f} s | "
        f"{1e3 * measured.cpu_s / figures['frames'] * 1e3:,.0f} ms |"
    )


def compared(folder: Path, cube: Path, n_frames: int) -> str:
    """Return a sentence on a run that was followed to its end, and a run of the same frames."""
    start = time.monotonic()
    follow(folder, cube, 0, n_frames, to_the_end=True)
    followed_s = time.monotonic() - start - STARTED_S
    spool, shape = folder / "run.live" / "frames.raw", (254, 496)
    start = time.monotonic()
    command = [*PROGRAM, "run", str(spec_for(folder, shape, str(spool))), "--output", str(folder / "again")]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    again_s = time.monotonic() - start
    same = all((folder / "run" / name).read_bytes() == (folder / "again" / name).read_bytes() for name in RESULTS)
    assert same, "the results differ"
    return (
        f"{n_frames:,} frames that came as fast as the pipe takes them: the run took {followed_s:.0f} s from the first frame, "
        f"and a run of the same frames without `--follow` {again_s:.0f} s. The results are the same to the last byte."
    )


def main() -> None:
    """Measure, and write the tables into a page."""
    if sys.argv[1:2] == ["--write"]:
        write(Path(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4]))
        return
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("page", type=Path)
    parser.add_argument("--frames", type=int, default=60_000)
    parser.add_argument("--long", type=int, default=1_000_000)
    given = parser.parse_args()
    lines = [
        "| Frames of | a second | arrived | located | mean delay | 95 % | greatest | behind at the end | CPU time of 1,000 |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        large = simulate(folder, (254, 496))
        for rate in (1000, 3000, 5000, 0):
            lines.append(row("254x496", rate, follow(folder, large, rate, given.frames)))
            print(lines[-1], flush=True)
        lines += ["", compared(folder, large, SIMULATED)]
        print(lines[-1], flush=True)
        if given.long:
            small = simulate(folder, (64, 96))
            measured = follow(folder, small, 6000, given.long)
            at = [np.abs(measured.memory[:, 0] - share * given.long).argmin() for share in (0.01, 0.1, 0.5, 1)]
            lines += ["", "| Frames of 64x96 so far | memory of the process |", "| --- | --- |"]
            lines += [f"| {measured.memory[index, 0]:,.0f} | {measured.memory[index, 1]:.0f} MiB |" for index in at]
            print("\n".join(lines[-4:]), row("64x96", 6000, measured), flush=True)
    write_tables(given.page, {"delays": lines})


if __name__ == "__main__":
    main()
