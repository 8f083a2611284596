"""Measure the time of each stage of a run, and its limits: the tables and the plot of docs/explanation/speed.md.

    python tests/benchmarks/speed.py docs/explanation/speed.md [--frames 10000 30000 100000]

Sums of frames are compared with `numpy.unpackbits`, merging with unpacking and warping every frame, both in the same process,
so that ratios hold on any machine. Whole runs have three levels of groups of 500 frames and a panorama of scale 1. Simulating
100,000 frames takes some minutes, and 2 GB of disk.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import matplotlib.pyplot as plt
import numpy as np
from harness import (
    IMAGES,
    Study,
    command,
    in_child,
    least,
    packed,
    passing,
    record_of,
    scores_of,
    seen,
    simulator,
    table,
    write_tables,
)

from photonpano import FrameSpan, SourceContext
from photonpano.capture.writing import truth_path
from photonpano.contracts.protocols import Source
from photonpano.evaluation import load_truth
from photonpano.geometry import FrameTrajectory, inverse
from photonpano_core.configs import MidpointConfig, PhotonMleConfig
from photonpano_core.mergers.photon_mle import PhotonMleMerger
from photonpano_core.resamplers import MidpointResampler
from photonpano_core.sources.npy import PACKED_NPY, PackedNpyConfig

SHAPE = (254, 496)
PX_A_FRAME = 0.02
GROUP_SIZE = 500
BLOCK_BYTES = 2**20
THREADS = 2


def simulated(study: Study, n_frames: int) -> Path:
    """Write a capture that moves by 0.02 px per frame, with its truth beside it."""
    length_px = PX_A_FRAME * n_frames
    width = max(2048, round(length_px))
    capture = simulator(
        scene={"kind": "street", "width": width, "height": width * 2 // 3},
        path={"kind": "random-spline", "length_px": length_px},
        flux=0.3,
        n_frames=n_frames,
        frame_shape=SHAPE,
    )
    return in_child(study.capture, f"{n_frames}", capture).result


def spread(work: Callable[[int], object], items: range, threads: int) -> None:
    """Do work on all items in several threads."""
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, items))


def sums(cube: Path) -> list[str]:
    """Return the table of sums: GB of packed frames per second."""
    frame_bytes = SHAPE[0] * SHAPE[1] // 8
    packed_frames = np.load(cube, mmap_mode="r")

    def row(source: Source, length: int) -> Sequence[str]:
        count = min(6400, source.info.n_frames) // length

        def total(index: int) -> object:
            return source.counts(FrameSpan(index * length, (index + 1) * length))

        def unpacked() -> object:
            return np.add.reduce(np.unpackbits(packed_frames[:length], axis=-1), axis=0, dtype=np.uint16)

        naive = length * frame_bytes / 1e9 / least(unpacked).seconds
        times = [least(spread, total, range(count), threads).seconds for threads in (1, THREADS)]
        return f"{length}", f"{naive:.2f} GB/s", *(f"{count * length * frame_bytes / 1e9 / each:.1f} GB/s" for each in times)

    with PACKED_NPY.build(PackedNpyConfig(path=cube), SourceContext()) as source:
        source.counts(FrameSpan(0, 600))
        rows = (row(source, length) for length in (8, 16, 32, 64, 250, 500))
        return table(("Frames in a sum", "unpackbits", "one thread", "two threads"), rows)


def reading(cube: Path) -> float:
    """Return the rate at which all threads read a cube from the page cache, in bytes per second: the physical limit."""
    size = cube.stat().st_size
    blocks = range(size // BLOCK_BYTES)

    def read(index: int) -> object:
        buffer = bytearray(BLOCK_BYTES)
        with cube.open("rb", buffering=0) as file:
            return os.preadv(file.fileno(), [buffer], index * BLOCK_BYTES)

    return len(blocks) * BLOCK_BYTES / least(spread, read, blocks, THREADS).seconds


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
    """Return the table of merging, for groups of the third level, and what chunks cost in accuracy."""
    truth = load_truth(truth_path(cube))
    trajectory = FrameTrajectory(truth.homographies)
    with PACKED_NPY.build(PackedNpyConfig(path=cube), SourceContext()) as source:
        groups = MidpointResampler(MidpointConfig(group_size=GROUP_SIZE)).groups(source.info.n_frames, 3)
        scene, response = truth.scene, source.response
        assert scene is not None
        group = groups[len(groups) // 2]
        reference = trajectory.at([group.reference])[0]
        to_grid = inverse(reference) @ trajectory.at(np.arange(group.span.start, group.span.stop))
        (counts, weight), naive, *_ = least(warped_one_by_one, source, group.span, to_grid, times=1)
        view = seen(scene, reference, SHAPE)
        inside = weight > 0.9 * len(group.span)

        def psnr_db(flux: np.ndarray) -> float:
            return float(10 * np.log10(float(view[inside].max()) ** 2 / np.mean((flux[inside] - view[inside]) ** 2)))

        exact = psnr_db(response.flux(counts / np.maximum(weight, 1), weight))

        def row(tolerance_px: float) -> Sequence[str]:
            merger = PhotonMleMerger(PhotonMleConfig(tolerance_px=tolerance_px))
            lost = exact - psnr_db(merger.merge(source, group, trajectory, 1.0).flux)
            work = partial(
                spread, lambda index: merger.merge(source, groups[index], trajectory, 1.0), range(len(groups)), THREADS
            )
            level = least(work).seconds / source.info.n_frames * 100_000
            # Most frames are in four groups.
            frames = sum(len(each.span) for each in groups) / source.info.n_frames
            ratio = naive / len(group.span) * 100_000 * frames / THREADS / level
            return f"{tolerance_px:g} px", f"{level:.1f} s", f"{ratio:.0f} times", f"{lost:.3f} dB"

        head = ("Moves within a chunk", "100,000 frames, two threads", "against frame by frame", "PSNR lost")
        return table(head, map(row, (0.25, 0.5, 1.0)))


def whole(study: Study, cube: Path) -> dict[str, Any]:
    """Run the pipeline in a process of its own, and return its record."""
    spec = packed(cube, resample={"with": {"group_size": GROUP_SIZE}}, run={"threads": THREADS})
    folder = in_child(study.run, "run", spec).result
    return record_of(folder) | {"mean_px": scores_of(folder, cube).trajectory.mean_px}


def stages(record: dict[str, Any]) -> dict[str, float]:
    """Return the seconds of a run by stage."""
    names = ("merge", "locate", "interpolate")
    found = {name: sum(level["seconds"].get(name, 0.0) for level in record["levels"]) for name in names}
    found["panorama"] = record["panorama"]["seconds"]
    found["other"] = record["seconds"] - sum(found.values())
    return found


def row_of_run(record: dict[str, Any], n_frames: int) -> Sequence[str]:
    """Return a row of the table of whole runs."""
    by_stage = stages(record)
    shares = [f"{by_stage[name]:.1f} s" for name in ("merge", "locate", "panorama")]
    other, memory_mib = by_stage["other"] + by_stage["interpolate"], record["peak_memory_bytes"] / 2**20
    figures = f"{other:.1f} s", f"{memory_mib:.0f} MiB", f"{record['mean_px']:.3f} px"
    return f"{n_frames:,}", f"{record['seconds']:.0f} s", *shares, *figures


def limits(records: dict[int, dict[str, Any]], rate: float) -> list[str]:
    """Return what the longest run is compared with, at a rate of reading in bytes per second, and how the time grows."""
    longest = max(records)
    passes = len(records[longest]["levels"]) + 1
    once = longest * SHAPE[0] * SHAPE[1] / 8 / rate
    lines = [
        f"\nTo read the frames once in each of {passes} passes, {passes - 1} levels and the panorama, "
        f"takes {passes * once:.1f} s of {longest:,} frames ({rate / 1e9:.1f} GB/s, two threads, from the page cache): "
        f"the run takes {records[longest]['seconds'] / passes / once:.0f} times that."
    ]
    if len(records) > 1:
        exponent = np.polyfit(np.log(list(records)), np.log([record["seconds"] for record in records.values()]), 1)[0]
        lines.append(f"\nTime grows with the number of frames to the power of {exponent:.2f}.")
    print(*lines, sep="\n")
    return lines


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


RUNS = ("Frames", "Whole", "merge", "locate", "panorama", "other", "Peak memory", "Mean error")


def main(page: Path | None, frames: Sequence[int] = (10_000, 30_000, 100_000)) -> None:
    """Measure everything on captures of several lengths, and write the page."""
    records: dict[int, dict[str, Any]] = {}
    tables: dict[str, list[str]] = {}
    rate = 0.0
    with passing() as study:
        for n_frames in frames:
            cube = simulated(study, n_frames)
            if not tables:
                cv2.setNumThreads(1)
                tables |= {"sums": sums(cube), "merging": merging(cube)}
                rate = reading(cube)
            records[n_frames] = whole(study, cube)
            cube.unlink()
    tables["runs"] = table(RUNS, (row_of_run(record, n_frames) for n_frames, record in records.items())) + limits(records, rate)
    write_tables(page, tables)
    if page:
        plot(records, IMAGES / "speed.png")


if __name__ == "__main__":
    command(main, "sums", "merging", "runs")
