"""Measure the time of runs and of their parts: the tables and the plot of docs/explanation/speed.md.

    python tests/benchmarks/speed.py docs/explanation/speed.md [--frames 1000 10000 100000]

Sums of frames are compared with `numpy.unpackbits`, warps with OpenCV's, merging with unpacking and warping every frame, and
whole runs with a pass of numpy over the bytes of the capture, all on the same machine, so that ratios hold on any. Runs have
all defaults. 100,000 frames take 2 GB of disk.
"""

from __future__ import annotations

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
from photonpano.geometry import Camera, FrameTrajectory, inverse, rotation_matrices, translation
from photonpano.merging.panorama import View, plan_canvas
from photonpano.merging.warping import Grid, Texture, add_warped, footprints_of
from photonpano.values import FloatArray
from photonpano_core.configs import MidpointConfig, PhotonMleConfig
from photonpano_core.mergers import PhotonMleMerger
from photonpano_core.resamplers import MidpointResampler
from photonpano_core.sources import PACKED_NPY, PackedNpyConfig

SHAPE = (254, 496)
PX_A_FRAME = 0.02
LONGEST_PX = 900  # of a path
GROUP_SIZE = 500
BLOCK_BYTES = 2**20
THREADS = 2
CAPTURES: dict[str, dict[str, Any]] = {"smooth": {}, "trembling": {"shake": {"rms_px": 3.0}}}


def simulated(study: Study, n_frames: int, kind: str) -> Path:
    """Write a capture that moves by 0.02 px per frame or less, with its truth beside it."""
    capture = simulator(
        scene={"kind": "street", "width": 2048, "height": 1365},
        path={"kind": "random-spline", "length_px": min(PX_A_FRAME * n_frames, LONGEST_PX), **CAPTURES[kind]},
        flux=0.3,
        n_frames=n_frames,
        frame_shape=SHAPE,
    )
    return in_child(study.capture, f"{kind}-{n_frames}", capture).result


def spread(work: Callable[[int], object], items: range, threads: int) -> None:
    """Do work on all items in several threads."""
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, items))


def repeated(work: Callable[[], object], number: int) -> None:
    """Do work some times."""
    for _ in range(number):
        work()


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


def summed_bytes(cube: Path) -> int:
    """Return the sum of the bytes of a capture: a pass of numpy over them."""
    frames = np.load(cube, mmap_mode="r").reshape(-1)
    return sum(int(frames[start : start + BLOCK_BYTES].sum()) for start in range(0, len(frames), BLOCK_BYTES))


def warps() -> list[str]:
    """Return the table of warps of one frame, one thread, and of OpenCV's for the same map."""
    counts = np.random.default_rng(0).poisson(1, SHAPE).astype(np.uint8)
    lens = Camera.of(430, SHAPE, (-0.11, 0.03, 0, 0))

    def homography(degrees: float) -> FloatArray:
        middle = translation((SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2)
        return np.asarray(middle @ rotation_matrices(np.array([0, 0, np.radians(degrees)])) @ np.linalg.inv(middle))

    def row(name: str, projection: str, degrees: float, camera: Camera | None = None, *, masked: bool = False) -> Sequence[str]:
        moved = homography(degrees)
        view = View(projection, camera=camera or Camera.of(430, SHAPE), turns=True)
        canvas = plan_canvas(FrameTrajectory(moved[None]), FrameSpan(0, 1), SHAPE, 1.0, 2**30, view=view)
        (at,) = footprints_of(canvas, camera, moved[None], SHAPE)
        grid = Grid.zeros(canvas, 1)
        mask = np.ones(SHAPE, np.uint8)
        seen_by = Texture.of(mask) if masked else None

        def ours() -> object:
            return add_warped(Texture.of(counts * mask if masked else counts), seen_by, np.ones(1), at, grid)

        y, x = np.mgrid[: canvas.height, : canvas.width].astype(np.float32)
        image = counts.astype(np.float32)

        def remap() -> object:
            return cv2.remap(image, x, y, cv2.INTER_LINEAR)

        def warp() -> object:
            return cv2.warpPerspective(image, moved, canvas.shape[::-1])

        opencv = remap if camera or not canvas.planar else warp
        times = [least(repeated, work, 100, times=5).seconds / 100 for work in (ours, opencv)]
        rates = [f"{1e6 * each:.0f} us, {image.size / each / 1e6:.0f} Mpx/s" for each in times]
        return name, rates[0], f"{rates[1]} (`{'remap' if opencv is remap else 'warpPerspective'}`)"

    cv2.setNumThreads(1)
    cases = [
        ("homography, turned by 1 degree", "planar", 1.0),
        ("homography, turned by 30 degrees", "planar", 30.0),
        ("cylinder", "cylindrical", 1.0),
        ("sphere, through a lens", "spherical", 1.0, lens),
    ]
    rows = [row(*case) for case in cases] + [row("homography, pixels masked", "planar", 1.0, masked=True)]
    return table(("Warp of 254 x 496 px", "ours, counts and weights", "OpenCV, one image"), rows)


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


def row_of_run(study: Study, n_frames: int, kind: str, seconds: dict[str, dict[int, tuple[float, float]]]) -> Sequence[str]:
    """Run all defaults in a process of its own, and return a row of the table of whole runs."""
    cube = simulated(study, n_frames, kind)
    once = least(summed_bytes, cube).processor_s
    folder, whole, cpu_s, _ = in_child(study.run, kind, packed(cube, run={"threads": THREADS}))
    record, error = record_of(folder), scores_of(folder, cube).trajectory.mean_px
    seconds[kind][n_frames] = whole, cpu_s
    cube.unlink()
    figures = f"{whole:.1f} s", f"{cpu_s:.1f} s", f"{cpu_s / once:.0f}", f"{record['peak_memory_bytes'] / 2**20:.0f} MiB"
    return f"{n_frames:,}", kind, *figures, f"{error:.3f} px", record["verdict"]["status"]


def growth(seconds: dict[str, dict[int, tuple[float, float]]]) -> list[str]:
    """Return how the time of the processor grows."""
    if any(len(found) < 2 for found in seconds.values()):
        return []
    exponents = [
        f"{np.polyfit(np.log(list(found)), np.log([cpu_s for _, cpu_s in found.values()]), 1)[0]:.2f} ({kind})"
        for kind, found in seconds.items()
    ]
    lines = [f"\nCPU seconds grow with the number of frames to the power of {' and '.join(exponents)}."]
    print(*lines, sep="\n")
    return lines


def plot(seconds: dict[str, dict[int, tuple[float, float]]], file: Path) -> None:
    """Draw the time of runs against the number of frames."""
    figure, axes = plt.subplots(figsize=(7, 3.2), layout="constrained")
    for (kind, found), colour in zip(seconds.items(), ("#1f5a94", "#a8641e"), strict=True):
        for (name, style), times in zip(
            (("seconds", "-"), ("CPU seconds", "--")), zip(*found.values(), strict=True), strict=True
        ):
            axes.plot(list(found), times, style, marker="o", color=colour, label=f"{kind}: {name}")
    axes.set(xscale="log", yscale="log", xlabel="frames of 254 x 496 px", ylabel="s, two threads")
    axes.set_xticks(list(seconds["smooth"]), [f"{n_frames:,}" for n_frames in seconds["smooth"]])
    axes.set_yticks([3, 5, 10, 20, 50, 100], ["3", "5", "10", "20", "50", "100"])
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    figure.savefig(file, dpi=110)
    plt.close(figure)


RUNS = ("Frames", "Capture", "Seconds", "CPU seconds", "of a pass of numpy", "Peak memory", "Mean error", "Verdict")


def main(page: Path | None, frames: Sequence[int] = (1_000, 10_000, 100_000)) -> None:
    """Measure everything on captures of several lengths, and write the page."""
    seconds: dict[str, dict[int, tuple[float, float]]] = {kind: {} for kind in CAPTURES}
    tables = {"warps": warps()}
    with passing() as study:
        cube = simulated(study, min(10_000, max(frames)), "smooth")
        tables |= {"sums": sums(cube), "merging": merging(cube)}
        rows = (row_of_run(study, n_frames, kind, seconds) for n_frames in frames for kind in CAPTURES)
        tables["runs"] = table(RUNS, rows)
    tables["runs"] += growth(seconds)
    write_tables(page, tables)
    if page:
        plot(seconds, IMAGES / "speed.png")


if __name__ == "__main__":
    command(main, "warps", "sums", "merging", "runs")
