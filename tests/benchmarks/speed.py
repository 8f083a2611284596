"""Measure the time of each stage of a run, and its limits: the tables and the plot of docs/explanation/speed.md.

    python tests/benchmarks/speed.py docs/explanation/speed.md [--frames 10000 30000 100000]

Sums of frames are compared with `numpy.unpackbits`, merging with unpacking and warping every frame, both in the same process,
so that ratios hold on any machine. Whole runs have three levels of groups of 500 frames and a panorama of scale 1. Simulating
100,000 frames takes some minutes, and 2 GB of disk.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import matplotlib.pyplot as plt
import numpy as np
from pages import write_tables

from photonpano import FrameSpan, SourceContext
from photonpano.evaluation import load_truth
from photonpano.geometry import FrameTrajectory, inverse
from photonpano.protocols import Source
from photonpano_core.configs import MidpointConfig, PhotonMleConfig
from photonpano_core.mergers.photon_mle import PhotonMleMerger
from photonpano_core.resamplers import MidpointResampler
from photonpano_core.sources.npy import PACKED_NPY, PackedNpyConfig

SHAPE = (254, 496)
PX_A_FRAME = 0.02
GROUP_SIZE = 500
BLOCK_BYTES = 2**20
THREADS = 2
PROGRAM = [sys.executable, "-c", "from photonpano.cli import main; main()"]


def simulate(folder: Path, n_frames: int) -> Path:
    """Write a capture that moves by 0.02 px per frame, with its truth beside it."""
    cube = folder / f"{n_frames}.npy"
    length_px = PX_A_FRAME * n_frames
    width = max(2048, round(length_px))
    simulator = {
        "scene": {"kind": "street", "width": width, "height": width * 2 // 3},
        "path": {"kind": "random-spline", "length_px": length_px},
        "flux": 0.3,
        "n_frames": n_frames,
        "frame_shape": SHAPE,
    }
    spec = cube.with_suffix(".yaml")
    # JSON is YAML.
    spec.write_text(json.dumps({"version": 1, "source": {"use": "simulator", "with": simulator}}))
    subprocess.run([*PROGRAM, "simulate", str(spec), "--output", str(cube)], check=True, stdout=subprocess.DEVNULL)
    return cube


def seconds(work: Callable[[], object], repeats: int = 3) -> float:
    """Return the minimum time of several repetitions."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)


def spread(work: Callable[[int], object], items: range, threads: int) -> None:
    """Do work on all items in several threads."""
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, items))


def sums(cube: Path) -> list[str]:
    """Return the rows of the table of sums: GB of packed frames per second."""
    frame_bytes = SHAPE[0] * SHAPE[1] // 8
    rows = ["| Frames in a sum | unpackbits | one thread | two threads |", "| --- | --- | --- | --- |"]
    with PACKED_NPY.build(PackedNpyConfig(path=cube), SourceContext()) as source:
        source.counts(FrameSpan(0, 600))
        packed = np.load(cube, mmap_mode="r")
        for length in (8, 16, 32, 64, 250, 500):
            count = min(6400, source.info.n_frames) // length
            size = count * length * frame_bytes / 1e9

            def total(index: int, length: int = length) -> object:
                return source.counts(FrameSpan(index * length, (index + 1) * length))

            def unpacked(length: int = length) -> object:
                return np.add.reduce(np.unpackbits(packed[:length], axis=-1), axis=0, dtype=np.uint16)

            rates = [size / seconds(partial(spread, total, range(count), threads)) for threads in (1, THREADS)]
            naive = length * frame_bytes / 1e9 / seconds(unpacked)
            rows.append(f"| {length} | {naive:.2f} GB/s | {rates[0]:.1f} GB/s | {rates[1]:.1f} GB/s |")
    return rows


def reading(cube: Path) -> float:
    """Return the rate at which all threads read a cube from the page cache, in bytes per second: the physical limit."""
    size = cube.stat().st_size
    blocks = range(size // BLOCK_BYTES)

    def read(index: int) -> object:
        buffer = bytearray(BLOCK_BYTES)
        with cube.open("rb", buffering=0) as file:
            return os.preadv(file.fileno(), [buffer], index * BLOCK_BYTES)

    return len(blocks) * BLOCK_BYTES / seconds(partial(spread, read, blocks, THREADS))


def warped_one_by_one(source: Source, span: FrameSpan, to_grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unpack and warp every frame of a span by itself, and return counts and weights."""
    counts, weight = np.zeros(SHAPE, np.float32), np.zeros(SHAPE, np.float32)
    ones = np.ones(SHAPE, np.float32)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    for index, frame in enumerate(range(span.start, span.stop)):
        image = source.frames(FrameSpan(frame, frame + 1))[0].astype(np.float32)
        to_frame = inverse(to_grid[index])
        counts += cv2.warpPerspective(image, to_frame, SHAPE[::-1], flags=flags)
        weight += cv2.warpPerspective(ones, to_frame, SHAPE[::-1], flags=flags)
    return counts, weight


def merging(cube: Path) -> list[str]:
    """Return the rows of the table of merging, for groups of the third level, and what chunks cost in accuracy."""
    truth = load_truth(cube.with_suffix(".truth.npz"))
    trajectory = FrameTrajectory(truth.homographies)
    rows = [
        "| Moves within a chunk | 100,000 frames, two threads | against frame by frame | PSNR lost |",
        "| --- | --- | --- | --- |",
    ]
    with PACKED_NPY.build(PackedNpyConfig(path=cube), SourceContext()) as source:
        groups = MidpointResampler(MidpointConfig(group_size=GROUP_SIZE)).groups(source.info.n_frames, 3)
        scene, response = truth.scene, source.response
        assert scene is not None
        group = groups[len(groups) // 2]
        reference = trajectory.at([group.reference])[0]
        to_grid = inverse(reference) @ trajectory.at(np.arange(group.span.start, group.span.stop))
        naive = seconds(lambda: warped_one_by_one(source, group.span, to_grid), 1) / len(group.span)
        counts, weight = warped_one_by_one(source, group.span, to_grid)
        view = cv2.warpPerspective(scene, reference, SHAPE[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        inside = weight > 0.9 * len(group.span)

        def psnr_db(flux: np.ndarray) -> float:
            return float(10 * np.log10(float(view[inside].max()) ** 2 / np.mean((flux[inside] - view[inside]) ** 2)))

        exact = psnr_db(response.flux(counts / np.maximum(weight, 1), weight))
        for tolerance_px in (0.25, 0.5, 1.0):
            merger = PhotonMleMerger(PhotonMleConfig(tolerance_px=tolerance_px))
            lost = exact - psnr_db(merger.merge(source, group, trajectory, 1.0).flux)

            def all_of(merger: PhotonMleMerger = merger) -> None:
                spread(lambda index: merger.merge(source, groups[index], trajectory, 1.0), range(len(groups)), THREADS)

            level = seconds(all_of) / source.info.n_frames * 100_000
            # Most frames are in four groups.
            ratio = naive * 100_000 * sum(len(each.span) for each in groups) / source.info.n_frames / THREADS / level
            rows.append(f"| {tolerance_px:g} px | {level:.1f} s | {ratio:.0f} times | {lost:.3f} dB |")
    return rows


def whole(cube: Path) -> dict[str, Any]:
    """Run the pipeline in a process of its own, and return its record."""
    spec = cube.with_suffix(".run.yaml")
    document = {
        "version": 1,
        "source": {"use": "packed-npy", "with": {"path": str(cube), "frame_rate_hz": 96_800}},
        "resample": {"with": {"group_size": GROUP_SIZE}},
        "run": {"threads": THREADS},
    }
    spec.write_text(json.dumps(document))
    folder = cube.with_suffix(".run")
    subprocess.run([*PROGRAM, "run", str(spec), "--output", str(folder)], check=True, stdout=subprocess.DEVNULL)
    scores = subprocess.run(
        [*PROGRAM, "evaluate", str(folder), "--truth", str(cube.with_suffix(".truth.npz")), "--json"],
        check=True,
        capture_output=True,
        text=True,
    )
    record: dict[str, Any] = json.loads((folder / "run.json").read_text())
    return record | {"scores": json.loads(scores.stdout)}


def stages(record: dict[str, Any]) -> dict[str, float]:
    """Return the seconds of a run by stage."""
    names = ("merge", "locate", "interpolate")
    found = {name: sum(level["seconds"].get(name, 0.0) for level in record["levels"]) for name in names}
    found["panorama"] = record["panorama"]["seconds"]
    found["other"] = record["seconds"] - sum(found.values())
    return found


def runs(records: dict[int, dict[str, Any]], rate: float) -> list[str]:
    """Return the rows of the table of whole runs; `rate` is that of reading, in bytes per second, for comparison."""
    rows = [
        "| Frames | Whole | merge | locate | panorama | other | Peak memory | Mean error |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for n_frames, record in records.items():
        by_stage = stages(record)
        shares = " | ".join(f"{by_stage[name]:.1f} s" for name in ("merge", "locate", "panorama"))
        other = by_stage["other"] + by_stage["interpolate"]
        rows.append(
            f"| {n_frames:,} | {record['seconds']:.0f} s | {shares} | {other:.1f} s | "
            f"{record['peak_memory_bytes'] / 2**20:.0f} MiB | {record['scores']['corner_error_px']['mean']:.3f} px |"
        )
    longest = max(records)
    passes = len(records[longest]["levels"]) + 1
    once = longest * SHAPE[0] * SHAPE[1] / 8 / rate
    rows.append(
        f"\nTo read the frames once in each of {passes} passes, {passes - 1} levels and the panorama, "
        f"takes {passes * once:.1f} s of {longest:,} frames ({rate / 1e9:.1f} GB/s, two threads, from the page cache): "
        f"the run takes {records[longest]['seconds'] / passes / once:.0f} times that."
    )
    if len(records) > 1:
        exponent = np.polyfit(np.log(list(records)), np.log([record["seconds"] for record in records.values()]), 1)[0]
        rows.append(f"\nTime grows with the number of frames to the power of {exponent:.2f}.")
    return rows


def plot(records: dict[int, dict[str, Any]], file: Path) -> None:
    """Draw the time of each stage."""
    figure, axes = plt.subplots(figsize=(7, 3.2), layout="constrained")
    left = np.zeros(len(records))
    labels = [f"{n_frames:,} frames" for n_frames in records]
    colours = ("#1f5a94", "#8fb0cf", "#c8a26b", "#a8641e", "#999999")
    for name, colour in zip(("merge", "locate", "interpolate", "panorama", "other"), colours, strict=True):
        width = np.array([stages(record)[name] for record in records.values()])
        axes.barh(labels, width, left=left, label=name, color=colour)
        left += width
    axes.invert_yaxis()
    axes.set_xlabel("seconds, two threads")
    axes.legend(frameon=False, ncols=5, loc="lower center", bbox_to_anchor=(0.45, 1.0))
    figure.savefig(file, dpi=110)


def main() -> None:
    """Measure everything, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("page", type=Path, help="the page whose tables are replaced")
    parser.add_argument("--frames", type=int, nargs="+", default=[10_000, 30_000, 100_000], help="lengths of the captures")
    arguments = parser.parse_args()
    page: Path = arguments.page
    records: dict[int, dict[str, Any]] = {}
    tables: dict[str, list[str]] = {}
    rate = 0.0
    with tempfile.TemporaryDirectory() as folder:
        for n_frames in arguments.frames:
            cube = simulate(Path(folder), n_frames)
            if not tables:
                cv2.setNumThreads(1)
                tables |= {"sums": sums(cube), "merging": merging(cube)}
                rate = reading(cube)
            records[n_frames] = whole(cube)
            print(n_frames, f"{records[n_frames]['seconds']:.0f} s", file=sys.stderr, flush=True)
            cube.unlink()
    tables["runs"] = runs(records, rate)
    write_tables(page, tables)
    plot(records, page.parent.parent / "images" / "speed.png")


if __name__ == "__main__":
    main()
