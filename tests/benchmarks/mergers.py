"""Measure speed and accuracy of every merger: the tables of docs/how-to/choose-a-merger.md.

    python tests/benchmarks/mergers.py docs/how-to/choose-a-merger.md

All merge the same groups along the true motion. Times are CPU times of one thread, the minimum of several; frames are
unpacked and summed from a file in the page cache. PSNR compares the flux of an exposure with the scene at the reference.
It takes a minute or two.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
from pages import write_tables

from photonpano import FrameSpan, Group, Merger, Source, SourceContext
from photonpano.geometry import FrameTrajectory, translation
from photonpano_core.configs import PhotonMleConfig, RobustMergeConfig
from photonpano_core.mergers.photon_mle import PhotonMleMerger
from photonpano_core.mergers.robust_merge import RobustMerger
from photonpano_core.mergers.splat import SplatMerger
from photonpano_core.sources.npy import PACKED_NPY, PackedNpyConfig
from photonpano_simulator.config import StreetScene
from photonpano_simulator.scenes import scene_flux

SHAPE = (254, 496)
SPEEDS_PX = (0.02, 0.15, 0.6)
FLUXES = (0.005, 0.02, 0.1, 0.5)
TIMED_FRAMES = 200
SEEN_FRAMES = 500
SIDE_PX, WAY_PX = 40, 100
"""Size of the moving object, and its path within a group."""
MERGERS: dict[str, Merger] = {
    "photon-mle, 1 px": PhotonMleMerger(PhotonMleConfig()),
    "photon-mle, 0.25 px": PhotonMleMerger(PhotonMleConfig(tolerance_px=0.25)),
    "splat": SplatMerger(),
    "robust-merge, 0.5 px": RobustMerger(RobustMergeConfig()),
}


def panning(speed_px: float, n_frames: int) -> FrameTrajectory:
    """A pan to the right, and slightly down."""
    return FrameTrajectory(np.array([translation(speed_px * frame, 0.1 * speed_px * frame) for frame in range(n_frames)]))


def opened(folder: Path, frames: np.ndarray) -> Source:
    """Write frames as a capture, and open it."""
    file = folder / "cube.npy"
    np.save(file, np.packbits(frames, axis=-1))
    return PACKED_NPY.build(PackedNpyConfig(path=file), SourceContext())


def seconds(merger: Merger, source: Source, motion: FrameTrajectory) -> float:
    """Return the CPU time per frame."""
    group = Group(FrameSpan(0, TIMED_FRAMES), (TIMED_FRAMES - 1) / 2)
    times = []
    for _ in range(7):
        start = time.thread_time()
        merger.merge(source, group, motion, 1.0)
        times.append(time.thread_time() - start)
    return min(times) / TIMED_FRAMES


def times(folder: Path) -> list[str]:
    """Return the rows of the table of times."""
    rows = [f"| Flux | Speed | {' | '.join(MERGERS)} |", "| --- " * (2 + len(MERGERS)) + "|"]
    rng = np.random.default_rng(0)
    for flux in FLUXES:
        frames = rng.random((TIMED_FRAMES, *SHAPE), np.float32) < -np.expm1(-flux)
        with opened(folder, frames) as source:
            for speed_px in SPEEDS_PX:
                motion = panning(speed_px, TIMED_FRAMES)
                cells = [f"{1e6 * seconds(merger, source, motion):.0f} us" for merger in MERGERS.values()]
                rows.append(f"| {flux:g} | {speed_px:g} px | {' | '.join(cells)} |")
    return rows


def view(scene: np.ndarray, to_scene: np.ndarray, instant: float, moving: bool) -> np.ndarray:
    """Return the flux in a frame, with or without a bright square that moves by itself."""
    seen = cv2.warpPerspective(scene, to_scene, SHAPE[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    if moving:
        left = round(150 + WAY_PX * instant / SEEN_FRAMES)
        seen[100 : 100 + SIDE_PX, left : left + SIDE_PX] = 2.5 * scene.mean()
    return seen


def psnrs(folder: Path) -> list[str]:
    """Return the rows of the table of PSNR."""
    rows = ["| Flux | Merger | Static scene | Moving square |", "| --- | --- | --- | --- |"]
    to_scene = translation(200, 150)
    motion = panning(0.15, SEEN_FRAMES)
    group = Group(FrameSpan(0, SEEN_FRAMES), (SEEN_FRAMES - 1) / 2)
    passed = (slice(90, 110 + SIDE_PX), slice(110, 190 + WAY_PX + SIDE_PX))
    inside = (slice(10, -10), slice(50, -50))
    for flux in FLUXES[1:]:
        scene = scene_flux(StreetScene(width=1024, height=682), flux)
        found: dict[str, list[float]] = {name: [] for name in MERGERS}
        for moving, where in ((False, inside), (True, passed)):
            rng = np.random.default_rng(1)
            frames = np.empty((SEEN_FRAMES, *SHAPE), bool)
            for index, homography in enumerate(motion.at(np.arange(SEEN_FRAMES))):
                lit = -np.expm1(-view(scene, to_scene @ homography, index, moving))
                frames[index] = rng.random(SHAPE, np.float32) < lit
            true = view(scene, to_scene @ motion.at([group.reference])[0], group.reference, moving)[where]
            with opened(folder, frames) as source:
                for name, merger in MERGERS.items():
                    exposure = merger.merge(source, group, motion, 1.0)
                    error = np.mean((exposure.flux[where] - true) ** 2)
                    found[name].append(float(10 * np.log10(true.max() ** 2 / error)))
        rows += [f"| {flux:g} | {name} | {still:.1f} dB | {moved:.1f} dB |" for name, (still, moved) in found.items()]
    return rows


def main() -> None:
    """Measure everything, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("page", type=Path, help="the page whose tables are replaced")
    page: Path = parser.parse_args().page
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as folder:
        tables = {"psnr": psnrs(Path(folder)), "times": times(Path(folder))}
    write_tables(page, tables)


if __name__ == "__main__":
    main()
