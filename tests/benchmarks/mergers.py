"""Compare mergers: the tables of docs/how-to/choose-a-merger.md.

    python tests/benchmarks/mergers.py docs/how-to/choose-a-merger.md [--tables psnr times dense]
    python tests/benchmarks/mergers.py --tables dense --only fast-0.3 --seeds 20

`psnr` and `times`: all merge the same groups along the true motion. Times are CPU times of one thread, the minimum of several;
frames are unpacked and summed from a file in the page cache. PSNR compares the flux of an exposure with the scene at the
reference. These take a minute or two.

`dense` compares them where something moves by itself or lies at another depth, in ten minutes. One group of frames of 254 x 496
pixels is merged to the instant in its middle, along the true global motion, and compared with the sharp view at that instant.
In front of the street, what moves is where the object is at any time of the group, in the view of that instant. In scenes with
depth, the global motion is that of one plane, and what moves are the pixels of that view that move against it by more than
1 px. Elsewhere is at least 8 px away from what moves.

Each case has several seeds: of the scene, the path, the object and the photons. No parameter was chosen on the default seeds;
choose on others, such as 10 to 12. The table has the means; in brackets is the smallest of its seeds' gains over `burst`. Times
are CPU times of one thread, the shorter of two merges, one after the other. In cases with estimated motion, the group is merged
along the trajectory of a run with `local-flow`, instead of the true one.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from harness import Study, chosen, command, groups, least, packed, passing, seen, table, write_tables

from photonpano import FrameSpan, Group, Merger, Source, SourceContext, load_trajectory
from photonpano.geometry import FrameTrajectory, inverse, transform_points, translation
from photonpano_baselines.burst import BurstMerger
from photonpano_baselines.configs import BurstConfig
from photonpano_core.configs import LocalFlowConfig, PhotonMleConfig
from photonpano_core.local_flow import LocalFlowMerger
from photonpano_core.mergers import PhotonMleMerger, SplatMerger
from photonpano_core.sources import PACKED_NPY, PackedNpyConfig
from photonpano_simulator.config import SimulatorConfig, StreetScene
from photonpano_simulator.scenes import scene_flux
from photonpano_simulator.source import SimulatorSource
from photonpano_simulator.travel import TravelSource, flow, truth_of
from photonpano_simulator.travel_config import TravelConfig

SHAPE = (254, 496)
SPEEDS_PX = (0.02, 0.15, 0.6)
FLUXES = (0.005, 0.02, 0.1, 0.5)
TIMED_FRAMES = 200
SEEN_FRAMES = 500
MERGERS: dict[str, Merger] = {
    "photon-mle, 1 px": PhotonMleMerger(PhotonMleConfig()),
    "photon-mle, 0.25 px": PhotonMleMerger(PhotonMleConfig(tolerance_px=0.25)),
    "splat": SplatMerger(),
}
BORDER_PX, AWAY_PX, MOVES_PX, EVERY = 12, 8, 1.0, 20
FLOW = LocalFlowMerger(LocalFlowConfig())
DENSE: dict[str, Merger] = {
    "photon-mle, 0.5 px": PhotonMleMerger(PhotonMleConfig(tolerance_px=0.5)),
    "burst": BurstMerger(BurstConfig()),
    "local-flow": FLOW,
}
SEEDS = (20, 21, 22)


def panning(speed_px: float, n_frames: int) -> FrameTrajectory:
    """A pan to the right, and slightly down."""
    return FrameTrajectory(np.array([translation(speed_px * frame, 0.1 * speed_px * frame) for frame in range(n_frames)]))


def opened(folder: Path, frames: Any, name: str = "cube") -> Source:
    """Write frames as a capture, and open it."""
    file = folder / f"{name}.npy"
    np.save(file, np.packbits(frames, axis=-1))
    return PACKED_NPY.build(PackedNpyConfig(path=file, width=SHAPE[1]), SourceContext())


def psnr_db(flux: np.ndarray, view: np.ndarray, where: Any, quantile: float = 1.0) -> float:
    """Return the PSNR of some pixels, relative to a quantile of the view."""
    error = np.mean((flux - view)[where] ** 2) if np.any(where) else np.nan
    return float(10 * np.log10(np.quantile(view, quantile) ** 2 / error))


def times(folder: Path) -> Iterator[Sequence[str]]:
    """Yield the rows of the table of times: per frame."""
    rng = np.random.default_rng(0)
    group = Group(FrameSpan(0, TIMED_FRAMES), (TIMED_FRAMES - 1) / 2)
    for flux in FLUXES:
        with opened(folder, rng.random((TIMED_FRAMES, *SHAPE), np.float32) < -np.expm1(-flux)) as source:
            for speed_px in SPEEDS_PX:
                given = source, group, panning(speed_px, TIMED_FRAMES), 1.0
                costs = [least(merger.merge, *given, times=7, clock=time.thread_time) for merger in MERGERS.values()]
                cells = (f"{1e6 * cost.processor_s / TIMED_FRAMES:.0f} us" for cost in costs)
                yield f"{flux:g}", f"{speed_px:g} px", *cells


def psnrs(folder: Path) -> Iterator[Sequence[str]]:
    """Yield the rows of the table of PSNR."""
    to_scene = translation(200, 150)
    motion = panning(0.15, SEEN_FRAMES)
    group = Group(FrameSpan(0, SEEN_FRAMES), (SEEN_FRAMES - 1) / 2)
    inside = np.s_[10:-10, 50:-50]
    for flux in FLUXES[1:]:
        scene, rng = scene_flux(StreetScene(width=1024, height=682), flux), np.random.default_rng(1)
        views = (seen(scene, to_scene @ homography, SHAPE) for homography in motion.at(np.arange(SEEN_FRAMES)))
        frames = np.array([rng.random(SHAPE, np.float32) < -np.expm1(-view) for view in views])
        true = seen(scene, to_scene @ motion.at([group.reference])[0], SHAPE)[inside]
        with opened(folder, frames) as source:
            merged = (merger.merge(source, group, motion, 1.0).flux[inside] for merger in MERGERS.values())
            yield f"{flux:g}", *(f"{psnr_db(each, true, np.s_[:]):.1f} dB" for each in merged)


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
    from_plane = truth.camera.matrix @ np.stack([poses[:, :, 0], poses[:, :, 1], depth_m * poses[:, :, 2] + poses[:, :, 3]], -1)
    homographies = from_plane[0] @ inverse(from_plane)
    homographies /= homographies[:, 2:, 2:]
    pixels = np.stack(np.meshgrid(*map(np.arange, SHAPE[::-1])), axis=-1).astype(float)
    moves_px = np.zeros(SHAPE)
    for index in range(0, n_frames, EVERY):
        there = (pixels + flow(truth, middle, index).vectors).reshape(-1, 2)
        along = transform_points(inverse(homographies[middle]) @ homographies[index], there).reshape(pixels.shape)
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


def measured(study: Study, capture: Simulated, title: str, estimate: bool) -> np.ndarray:
    """Return what mergers reach: PSNR where something moves and elsewhere, in dB, and CPU time in s, of each: (M, 3)."""
    inside = np.zeros(SHAPE, bool)
    inside[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = True
    near = cv2.dilate(capture.moving.astype(np.uint8), np.ones((2 * AWAY_PX + 1,) * 2, np.uint8)).astype(bool)
    moving, still = capture.moving & inside, inside & ~near
    frames = [capture.source.frames(FrameSpan(index, index + 1))[0] for index in range(len(capture.group.span))]
    with opened(study.folder, frames, title) as source:
        motion = capture.motion
        if estimate:
            spec = packed(study.folder / f"{title}.npy", None, resample=groups(250), merge={"use": "local-flow"})
            motion = FrameTrajectory(load_trajectory(study.run("run", spec)).homographies)
        found = []
        for merger in DENSE.values():
            merger.merge(source, Group(FrameSpan(0, 300), 149.5), motion, 1.0)  # compiled before it is timed
            cost = least(merger.merge, source, capture.group, motion, 1.0, times=2)
            flux = cost.result.flux
            both = (psnr_db(flux, capture.view, where & np.isfinite(flux), 0.999) for where in (moving, still))
            found.append((*both, cost.processor_s))
        marked = FLOW.ghost_map(source, capture.group, motion).moving & inside
    both = (marked & moving).sum()
    share = f"precision {both / max(marked.sum(), 1):.3f}, recall {both / max(moving.sum(), 1):.3f}"
    print(f"{title}: {share}, {(marked & still).sum()} of {still.sum()} still pixels", flush=True)
    return np.array(found)


def moved(study: Study, names: Sequence[str], seeds: Sequence[int]) -> Iterator[Sequence[str]]:
    """Yield the rows of the table of what moves by itself: of each case, the mergers."""
    for case in names:
        title, capture_of = CASES[case]
        given = [(capture_of(seed), f"{title}, seed {seed}", case in ESTIMATED.values()) for seed in seeds]
        found = np.array([measured(study, *each) for each in given])  # of seeds and mergers
        for index, (name, (there, elsewhere, took_s)) in enumerate(zip(DENSE, found.mean(axis=0), strict=True)):
            gain = (found[:, index, 0] - found[:, list(DENSE).index("burst"), 0]).min()
            cell = "" if np.isnan(there) else f"{there:.1f} ({gain:+.1f})" if name == "local-flow" else f"{there:.1f}"
            yield title, name, cell, f"{elsewhere:.1f}", f"{took_s:.2f} s"


TABLES = {
    "psnr": ("Flux", *MERGERS),
    "times": ("Flux", "Speed", *MERGERS),
    "dense": ("What moves", "Merger", "PSNR there, dB", "elsewhere", "CPU time"),
}


def main(
    page: Path | None,
    tables: Sequence[str] = tuple(TABLES),
    only: Sequence[str] = tuple(CASES),
    seeds: Sequence[int] = SEEDS,
) -> None:
    """Measure the tables, and write the page."""
    cv2.setNumThreads(1)
    with passing() as study:
        rows = {"psnr": psnrs(study.folder), "times": times(study.folder)}
        rows["dense"] = moved(study, chosen(only, CASES), seeds)
        write_tables(page, {name: table(TABLES[name], rows[name]) for name in chosen(tables, TABLES)})


if __name__ == "__main__":
    command(main, *TABLES)
