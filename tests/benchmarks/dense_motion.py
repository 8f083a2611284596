"""Compare mergers where something moves by itself or lies at another depth: the table of docs/how-to/choose-a-merger.md.

    python tests/benchmarks/dense_motion.py docs/how-to/choose-a-merger.md
    python tests/benchmarks/dense_motion.py --pictures FOLDER --only fast-0.3 --seeds 20

One group of frames of 254 x 496 pixels is merged to the instant in its middle, along the true global motion, and compared with
the sharp view at that instant. In front of the street, what moves is where the object
is at any time of the group, in the view of that instant. In scenes with depth, the global motion is that of one plane, and what
moves are the pixels of that view that move against it by more than 1 px. Elsewhere is at least 8 px away from what moves.

Each case has several seeds: of the scene, the path, the object and the photons. No parameter was chosen on the default seeds;
choose on others, such as 10 to 12. The table has the means; in brackets is the smallest of its seeds' gains over `burst`. Times
are CPU times of one thread, the shorter of two merges, one after the other. In cases with estimated motion, the group is merged
along the trajectory of a run with `local-flow`, instead of the true one. It takes ten minutes.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pages import write_tables

from photonpano import FrameSpan, Group, Merger, Source, SourceContext, parse_spec, run
from photonpano.geometry import FrameTrajectory, apply, inverse
from photonpano_core.configs import BurstConfig, LocalFlowConfig, PhotonMleConfig, RobustMergeConfig
from photonpano_core.mergers.burst import BurstMerger
from photonpano_core.mergers.local_flow import LocalFlowMerger
from photonpano_core.mergers.photon_mle import PhotonMleMerger
from photonpano_core.mergers.robust_merge import RobustMerger
from photonpano_core.sources.npy import PACKED_NPY, PackedNpyConfig
from photonpano_simulator.config import SimulatorConfig
from photonpano_simulator.source import SimulatorSource
from photonpano_simulator.travel.source import TravelSource
from photonpano_simulator.travel.truth import flow, truth_of
from photonpano_simulator.travel_config import TravelConfig

SHAPE = (254, 496)
BORDER_PX, AWAY_PX, MOVES_PX, EVERY = 12, 8, 1.0, 20
FLOW = LocalFlowMerger(LocalFlowConfig())
MERGERS: dict[str, Merger] = {
    "photon-mle, 0.5 px": PhotonMleMerger(PhotonMleConfig(tolerance_px=0.5)),
    "robust-merge": RobustMerger(RobustMergeConfig()),
    "burst": BurstMerger(BurstConfig()),
    "local-flow": FLOW,
}


@dataclass(frozen=True)
class Simulated:
    """A capture and its truth.

    Attributes:
        source: renders the capture.
        motion: the true global motion.
        group: all frames, seen from one in the middle.
        view: (H, W) flux at that instant.
        moving: (H, W) what moves.
    """

    source: Source
    motion: FrameTrajectory
    group: Group
    view: np.ndarray
    moving: np.ndarray


def crossed(
    seed: int, flux: float, shape: str = "disc", size: tuple[float, float] = (0.5, 0.7), n_frames: int = 1500, **moves: Any
) -> Simulated:
    """A pan over the street while a textured thing moves, which is in the middle of the frame in the middle of the group."""
    middle = n_frames // 2
    keys: dict[str, Any] = {
        "scene": {"kind": "street", "seed": seed},
        "path": {"kind": "pan", "length_px": 0.15 * n_frames, "angle_deg": 5 + 10 * seed},
        "n_frames": n_frames,
        "frame_shape": SHAPE,
        "flux": flux,
        "seed": seed,
    }
    thing = {"shape": shape, "size": size, "follows": 1.0, "seed": seed, **moves}
    objects = [thing] if moves else []
    if moves:
        # Where it appears, so that it is in the middle of the frame later.
        there = SimulatorSource(SimulatorConfig(**keys, objects=objects), SourceContext())._objects[0]
        away = np.array(SHAPE[::-1]) / 2 - 0.5 - there._corners[middle] - there._size / 2
        objects = [thing | {"at": tuple(0.5 + away / SHAPE[::-1])}]
    source = SimulatorSource(SimulatorConfig(**keys, objects=objects), SourceContext())
    homographies = source.truth()["homographies"]
    moving = np.zeros(SHAPE, np.float32)
    for each in SimulatorSource(SimulatorConfig(**keys, objects=objects), SourceContext())._objects:
        each._texture = np.ones_like(each._texture)
        for index in range(0, n_frames, 5):
            covered = np.zeros(SHAPE, np.float32)
            each.draw(covered, index)
            to_middle = inverse(homographies[middle]) @ homographies[index]
            moving = np.maximum(moving, cv2.warpPerspective(covered, to_middle, SHAPE[::-1], flags=cv2.INTER_LINEAR))
    group = Group(FrameSpan(0, n_frames), float(middle))
    return Simulated(source, FrameTrajectory(homographies), group, source.sharp_view(middle), moving > 0.5)


def travelled(seed: int, depth_m: float, flux: float = 0.3, kind: str = "planes", n_frames: int = 1000) -> Simulated:
    """A camera travels through a scene with depth; the global motion is that of a plane across, at a distance."""
    path = {"kind": "travel", "length_m": 0.3, "wander_deg": 0.3, "seed": seed}
    scene = {"kind": kind, "seed": seed}
    config = TravelConfig(scene=scene, path=path, n_frames=n_frames, frame_shape=SHAPE, flux=flux, seed=seed)
    source = TravelSource(config, SourceContext())
    truth = truth_of(source.truth())
    poses, middle = truth.camera_from_world, n_frames // 2
    from_plane = truth.camera_matrix @ np.stack([poses[:, :, 0], poses[:, :, 1], depth_m * poses[:, :, 2] + poses[:, :, 3]], -1)
    homographies = from_plane[0] @ inverse(from_plane)
    homographies /= homographies[:, 2:, 2:]
    pixels = np.stack(np.meshgrid(*map(np.arange, SHAPE[::-1])), axis=-1).astype(float)
    moves_px = np.zeros(SHAPE)
    for index in range(0, n_frames, EVERY):
        there = (pixels + flow(truth, middle, index).vectors).reshape(-1, 2)
        along = apply(inverse(homographies[middle]) @ homographies[index], there).reshape(pixels.shape)
        moves_px = np.maximum(moves_px, np.hypot(*np.moveaxis(along - pixels, -1, 0)))
    group = Group(FrameSpan(0, n_frames), float(middle))
    return Simulated(source, FrameTrajectory(homographies), group, source.sharp_view(middle), moves_px > MOVES_PX)


SLOW, FAST = {"moves_px": (0.04, 0.01)}, {"moves_px": (-0.12, 0.03)}
CASES: dict[str, tuple[str, Callable[[int], Simulated]]] = {
    "slow-0.1": ("disc moves by 60 px, flux 0.1", lambda seed: crossed(seed, 0.1, **SLOW)),
    "fast-0.3": ("disc moves by 185 px, flux 0.3", lambda seed: crossed(seed, 0.3, **FAST)),
    "small": ("smaller disc moves by 60 px, flux 0.3", lambda seed: crossed(seed, 0.3, size=(0.4, 0.5), **SLOW)),
    "near": (
        "rectangle nearer to the camera, flux 0.3",
        lambda seed: crossed(seed, 0.3, "rectangle", (0.4, 0.5), moves_px=(0.0, 0.0), follows=1.4),
    ),
    "planes-5": ("parallax to a plane at 5 m, flux 0.3", lambda seed: travelled(seed, 5.0)),
    "planes-10": ("parallax to the background at 10 m, flux 0.3", lambda seed: travelled(seed, 10.0)),
    "dark": ("nothing, flux 0.02", lambda seed: crossed(seed, 0.02)),
}


ESTIMATED = {"slow-0.1": "slow-estimated", "small": "small-estimated"}
"""Cases that are also measured with estimated motion, and their names."""
CASES |= {new: (f"{CASES[old][0]}, estimated motion", CASES[old][1]) for old, new in ESTIMATED.items()}


def estimated(file: Path, folder: Path) -> FrameTrajectory:
    """Return the trajectory of a run over a capture."""
    settings = {
        "version": 1,
        "source": {"use": "packed-npy", "with": {"path": str(file), "width": SHAPE[1]}},
        "resample": {"use": "midpoint", "with": {"group_size": 250}},
        "merge": {"use": "local-flow"},
        "output": {"directory": str(folder)},
    }
    run(parse_spec(settings))
    with np.load(folder / "trajectory.npz") as found:
        return FrameTrajectory(found["homographies"])


def psnr(flux: np.ndarray, capture: Simulated, where: np.ndarray) -> float:
    """Return the PSNR of some pixels, relative to the 99.9th percentile of the view."""
    known = where & np.isfinite(flux)
    error = np.mean((flux - capture.view)[known] ** 2) if known.any() else np.nan
    return float(10 * np.log10(np.percentile(capture.view, 99.9) ** 2 / error))


def measured(capture: Simulated, title: str, pictures: Path | None, estimate: bool) -> np.ndarray:
    """Return what mergers reach: PSNR where something moves and elsewhere, in dB, and CPU time in s, of each: (M, 3)."""
    inside = np.zeros(SHAPE, bool)
    inside[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = True
    near = cv2.dilate(capture.moving.astype(np.uint8), np.ones((2 * AWAY_PX + 1,) * 2, np.uint8)).astype(bool)
    moving, still = capture.moving & inside, inside & ~near
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "capture.npy"
        frames = [capture.source.frames(FrameSpan(index, index + 1))[0] for index in range(len(capture.group.span))]
        np.save(file, np.packbits(frames, axis=-1))
        with PACKED_NPY.build(PackedNpyConfig(path=file, width=SHAPE[1]), SourceContext()) as source:
            motion = estimated(file, Path(folder) / "run") if estimate else capture.motion
            found = []
            for name, merger in MERGERS.items():
                merger.merge(source, Group(FrameSpan(0, 300), 149.5), motion, 1.0)  # compiled before it is timed
                times = []
                for _ in range(2):
                    start = time.process_time()
                    flux = merger.merge(source, capture.group, motion, 1.0).flux
                    times.append(time.process_time() - start)
                found.append((psnr(flux, capture, moving), psnr(flux, capture, still), min(times)))
                if pictures:
                    high = np.percentile(capture.view, 99.7)
                    tones = [np.clip(np.nan_to_num(each) / high, 0, 1) ** (1 / 2.2) for each in (flux, capture.view)]
                    error = 0.5 + 2 * (np.nan_to_num(flux) - capture.view) / high
                    picture = np.vstack([*tones, np.clip(error, 0, 1)])
                    cv2.imwrite(str(pictures / f"{title}, {name}.png".replace(" ", "-")), np.uint8(255 * picture))
            marked = FLOW.ghost_map(source, capture.group, motion).moving & inside
    both = (marked & moving).sum()
    share = f"precision {both / max(marked.sum(), 1):.3f}, recall {both / max(moving.sum(), 1):.3f}"
    print(f"{title}: {share}, {(marked & still).sum()} of {still.sum()} still pixels", flush=True)
    for name, values in zip(MERGERS, found, strict=True):
        print(f"    {name:20}", *(f"{each:6.2f}" for each in values), flush=True)
    return np.array(found)


def rows(title: str, found: np.ndarray) -> list[str]:
    """Return the rows of a case, of seeds and mergers (S, M, 3)."""
    lines, names = [], list(MERGERS)
    for name, (there, elsewhere, seconds) in zip(names, found.mean(axis=0), strict=True):
        gain = (found[:, names.index(name), 0] - found[:, names.index("burst"), 0]).min()
        cell = "" if np.isnan(there) else f"{there:.1f} ({gain:+.1f})" if name == "local-flow" else f"{there:.1f}"
        lines.append(f"| {title} | {name} | {cell} | {elsewhere:.1f} | {seconds:.2f} s |")
    return lines


def main() -> None:
    """Measure, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("page", type=Path, nargs="?", help="the page whose table is replaced")
    parser.add_argument("--pictures", type=Path, help="folder for pictures of the exposures and their errors")
    parser.add_argument("--only", nargs="*", choices=CASES, default=list(CASES))
    parser.add_argument("--seeds", nargs="*", type=int, default=[20, 21, 22])
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    lines = ["| What moves | Merger | PSNR there, dB | elsewhere | CPU time |", "| --- | --- | --- | --- | --- |"]
    for name in arguments.only:
        title, capture_of = CASES[name]
        found = [
            measured(capture_of(seed), f"{title}, seed {seed}", arguments.pictures, name in ESTIMATED.values())
            for seed in arguments.seeds
        ]
        lines += rows(title, np.array(found))
        print(*lines[-len(MERGERS) :], sep="\n", flush=True)
    if arguments.page:
        write_tables(arguments.page, {"dense": lines})


if __name__ == "__main__":
    main()
