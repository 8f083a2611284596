"""Measure runs that follow a capture: delay, rate and memory; the tables of docs/how-to/as-it-arrives.md.

    python tests/benchmarks/following.py docs/how-to/as-it-arrives.md [--frames 60000] [--long 1000000] [--rates 1000 3000]

A writer, a process of its own, passes frames through a pipe at a rate. It reads a simulated capture to and fro. Each run is
ended when all frames have arrived, but one, which is compared with a run of the same frames without `--follow`. Simulating
takes a minute, and the spools 1.6 GB for each 100,000 frames of 254 x 496 px, one after the other.
"""

from __future__ import annotations

import json
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import psutil
from harness import HELD_FRAMES, Study, command, groups, hand_held, passing, table, write_tables

PROGRAM = [sys.executable, "-m", "photonpano"]
RESULTS = ("panorama.tiff", "coverage.tiff", "trajectory.npz", "panorama.png")
BATCH = 64  # frames that the writer writes at once
STARTED_S = 15.0  # the writer waits for the program to start; a camera is started after it, too


class Measured(NamedTuple):
    """A run that was followed: the last `live.json` while frames came; frames that had arrived, and MiB of its memory, (N, 2);
    and seconds of all cores."""

    figures: dict[str, Any]
    memory: np.ndarray
    cpu_s: float


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
    spec.write_text(json.dumps({"version": 1, "source": source, "resample": groups(250), "levels": 3}))
    return spec


def follow(folder: Path, cube: Path, rate: float, n_frames: int, to_the_end: bool = False) -> Measured:
    """Follow a writer."""
    shape = np.load(cube, mmap_mode="r").shape[1], 8 * np.load(cube, mmap_mode="r").shape[2]
    live = folder / "run.live" / "live.json"
    shutil.rmtree(live.parent, ignore_errors=True)
    command = [*PROGRAM, "run", str(spec_for(folder, shape)), "--follow", "--overwrite", "--output", str(folder / "run")]
    written = [sys.executable, __file__, "--write", str(cube), str(rate), str(n_frames)]
    memory, figures, cpu_s = [], {"state": "waiting"}, float("nan")
    with (
        subprocess.Popen(written, stdout=subprocess.PIPE) as writer,
        subprocess.Popen(command, stdin=writer.stdout, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as program,
    ):
        assert writer.stdout is not None
        writer.stdout.close()
        process = psutil.Process(program.pid)
        while program.poll() is None:
            time.sleep(0.25)
            seen = json.loads(live.read_text()) if live.exists() else {"state": "waiting"}
            if seen["state"] in ("following", "finishing"):
                figures, cpu_s = seen, sum(process.cpu_times()[:2])
            if seen["state"] == "following":
                memory.append((seen["frames"], resident_mib(program.pid)))
            elif seen["state"] == "finishing":
                break
        if not to_the_end:
            program.send_signal(signal.SIGINT)
        errors = program.communicate()[1].decode()
    if to_the_end and program.returncode:
        raise SystemExit(errors)
    return Measured(figures, np.array(memory), cpu_s)


def resident_mib(process: int) -> float:
    """Return the memory of a process, its pages of files left out."""
    status = Path(f"/proc/{process}/status").read_text()
    return int(re.search(r"^RssAnon:\s+(\d+)", status, re.MULTILINE)[1]) / 1024


def row(shape: str, rate: float, measured: Measured) -> Sequence[str]:
    """Return a row of the table of delays."""
    figures = measured.figures
    return (
        shape,
        f"{rate:,.0f}" if rate else "as many as come",
        f"{figures['frames']:,}",
        f"{figures['located']:,}",
        *(f"{figures[key]:.2f} s" for key in ("delay_mean_s", "delay_95_s", "delay_longest_s")),
        f"{figures['behind_s']:.1f} s",
        f"{1e3 * measured.cpu_s / figures['frames'] * 1e3:,.0f} ms",
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


DELAYS = (
    "Frames of", "a second", "arrived", "located", "mean delay", "95 %", "greatest", "behind at the end", "CPU time of 1,000",
)  # fmt: skip


def memory_of(study: Study, n_frames: int) -> Iterator[Sequence[str]]:
    """Yield the rows of the table of memory: after a hundredth, a tenth, a half and all of a long capture of small frames."""
    measured = follow(study.folder, study.capture("hand", hand_held((64, 96))), 6000, n_frames)
    print(*row("64x96", 6000, measured), sep=", ")
    for share in (0.01, 0.1, 0.5, 1):
        frames, memory_mib = measured.memory[np.abs(measured.memory[:, 0] - share * n_frames).argmin()]
        yield f"{frames:,.0f}", f"{memory_mib:.0f} MiB"


def main(
    page: Path | None, frames: int = 60_000, long: int = 1_000_000, rates: Sequence[float] = (1000.0, 3000.0, 5000.0, 0.0)
) -> None:
    """Measure, and write the tables into a page."""
    with passing() as study:
        large = study.capture("hand", hand_held((254, 496)))
        lines = table(DELAYS, (row("254x496", rate, follow(study.folder, large, rate, frames)) for rate in rates))
        lines += ["", compared(study.folder, large, HELD_FRAMES)]
        print(lines[-1], flush=True)
        if long:
            lines += ["", *table(("Frames of 64x96 so far", "memory of the process"), memory_of(study, long))]
    write_tables(page, {"delays": lines})


if __name__ == "__main__":
    if sys.argv[1:2] == ["--write"]:
        write(Path(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4]))
    else:
        command(main, "delays")
