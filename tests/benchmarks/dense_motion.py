"""Compare mergers where something moves by itself: the table of docs/how-to/choose-a-merger.md.

    python tests/benchmarks/dense_motion.py docs/how-to/choose-a-merger.md
    python tests/benchmarks/dense_motion.py --pictures FOLDER --only fast-0.3

One group of frames of 254 x 496 pixels is merged to the instant in its middle, along the true global motion and along the one
that a run estimates, and compared with the sharp view at that instant. What moves is where the object is at any time of the
group, in the view of that instant; elsewhere is at least 8 px away from it. Times are CPU times of one thread, of merges one
after the other. It takes a few minutes.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from photonpano import FrameSpan, Group, Merger, Source, SourceContext, parse_spec, run
from photonpano.geometry import FrameTrajectory, inverse
from photonpano_core.configs import BurstConfig, LocalFlowConfig, PhotonMleConfig, RobustMergeConfig
from photonpano_core.dense_motion.burst import BurstMerger
from photonpano_core.dense_motion.local_flow import LocalFlowMerger
from photonpano_core.packed_npy import PACKED_NPY, PackedNpyConfig
from photonpano_core.photon_mle import PhotonMleMerger
from photonpano_core.robust_merge import RobustMerger
from photonpano_simulator.config import SimulatorConfig
from photonpano_simulator.source import SimulatorSource

SHAPE = (254, 496)
BORDER_PX, AWAY_PX = 12, 8
FLOW = LocalFlowMerger(LocalFlowConfig())
MERGERS: dict[str, Merger] = {
    "photon-mle, 0.5 px": PhotonMleMerger(PhotonMleConfig(tolerance_px=0.5)),
    "robust-merge": RobustMerger(RobustMergeConfig()),
    "burst": BurstMerger(BurstConfig()),
    "local-flow": FLOW,
}


def thing(size: tuple[float, float], moves_px: tuple[float, float], follows: float = 1.0) -> dict[str, Any]:
    """An object that is in the middle of the frame in the middle of the group."""
    return {"size": size, "moves_px": moves_px, "follows": follows, "seed": 3}


@dataclass(frozen=True)
class Case:
    """A capture of one group.

    Attributes:
        title: its row of the table.
        flux: mean flux of the scene.
        objects: what moves.
        n_frames: of the group.
        length_px: of the pan.
    """

    title: str
    flux: float
    objects: list[dict[str, Any]] = field(default_factory=list)
    n_frames: int = 1500
    length_px: float = 225.0


SLOW = [thing((0.45, 0.45), (0.04, 0.01))]
FAST = [thing((0.45, 0.45), (-0.12, 0.03))]
NEAR = [thing((0.4, 0.5), (0.0, 0.0), follows=1.4)]
CASES = {
    "slow-0.5": Case("60 px, flux 0.5", 0.5, SLOW),
    "slow-0.1": Case("60 px, flux 0.1", 0.1, SLOW),
    "fast-0.3": Case("185 px, flux 0.3", 0.3, FAST),
    "fast-0.1": Case("185 px, flux 0.1", 0.1, FAST),
    "near-0.3": Case("nearer to the camera, flux 0.3", 0.3, NEAR),
    "dark": Case("still, flux 0.02", 0.02),
}


@dataclass(frozen=True)
class Simulated:
    """A capture and its truth.

    Attributes:
        file: the packed capture.
        motion: the true global motion.
        group: all frames, seen from one in the middle.
        view: (H, W) flux at that instant.
        moving: (H, W) where an object is at any time.
    """

    file: Path
    motion: FrameTrajectory
    group: Group
    view: np.ndarray
    moving: np.ndarray


def simulated(case: Case, folder: Path) -> Simulated:
    """Render and store a capture."""
    path = {"kind": "pan", "length_px": case.length_px, "angle_deg": 5}
    keys = {"n_frames": case.n_frames, "frame_shape": SHAPE, "flux": case.flux, "path": path, "seed": 0}
    middle = case.n_frames // 2
    objects = []
    for each in case.objects:
        # Where it appears, so that it is in the middle of the frame later.
        there = SimulatorSource(SimulatorConfig(**keys, objects=[each]), SourceContext())._objects[0]
        away = np.array(SHAPE[::-1]) / 2 - 0.5 - there._corners[middle] - there._size / 2
        objects.append(each | {"at": tuple(0.5 + away / SHAPE[::-1])})
    source = SimulatorSource(SimulatorConfig(**keys, objects=objects), SourceContext())
    frames = [np.packbits(source.frames(FrameSpan(index, index + 1))[0], axis=-1) for index in range(case.n_frames)]
    file = folder / "capture.npy"
    np.save(file, np.array(frames))
    homographies = source.truth()["homographies"]
    view, moving = source._lit_view(middle, homographies[middle]), np.zeros(SHAPE, np.float32)
    for each in source._objects:
        each.draw(view, middle)
        each._texture = np.ones_like(each._texture)
        for index in range(0, case.n_frames, 5):
            covered = np.zeros(SHAPE, np.float32)
            each.draw(covered, index)
            to_middle = inverse(homographies[middle]) @ homographies[index]
            moving = np.maximum(moving, cv2.warpPerspective(covered, to_middle, SHAPE[::-1], flags=cv2.INTER_LINEAR))
    group = Group(FrameSpan(0, case.n_frames), float(middle))
    return Simulated(file, FrameTrajectory(homographies), group, view, moving > 0.5)


def estimated(capture: Simulated, folder: Path) -> FrameTrajectory:
    """Return the motion that a run with defaults finds."""
    spec = {"version": 1, "source": {"use": "packed-npy", "with": {"path": str(capture.file), "width": SHAPE[1]}}}
    run(parse_spec(spec, output=folder / "run"))
    with np.load(folder / "run" / "trajectory.npz") as stored:
        return FrameTrajectory(stored["homographies"])


def psnr(flux: np.ndarray, capture: Simulated, where: np.ndarray) -> float:
    """Return the PSNR of some pixels, relative to the 99.9th percentile of the view."""
    known = where & np.isfinite(flux)
    error = np.mean((flux - capture.view)[known] ** 2)
    return float(10 * np.log10(np.percentile(capture.view, 99.9) ** 2 / error)) if known.any() else float("nan")


def rows(case: Case, folder: Path, pictures: Path | None) -> Iterator[str]:
    """Measure one case."""
    capture = simulated(case, folder)
    inside = np.zeros(SHAPE, bool)
    inside[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = True
    near = cv2.dilate(capture.moving.astype(np.uint8), np.ones((2 * AWAY_PX + 1,) * 2, np.uint8)).astype(bool)
    moving, still = capture.moving & inside, inside & ~near
    source: Source = PACKED_NPY.build(PackedNpyConfig(path=capture.file, width=SHAPE[1]), SourceContext())
    with source:
        motions = {"true": capture.motion, "estimated": estimated(capture, folder)}
        for merger in MERGERS.values():  # compiled before it is timed
            merger.merge(source, Group(FrameSpan(0, 300), 149.5), capture.motion, 1.0)
        for name, merger in MERGERS.items():
            cells = []
            for motion in motions.values():
                start = time.process_time()
                flux = merger.merge(source, capture.group, motion, 1.0).flux
                seconds = time.process_time() - start
                cells += [f"{psnr(flux, capture, where):.1f}" if where.any() else "" for where in (moving, still)]
            yield f"| {case.title} | {name} | {' | '.join(cells)} | {seconds:.1f} s |"
            if pictures:
                high = np.percentile(capture.view, 99.7)
                tones = [np.clip(np.nan_to_num(each) / high, 0, 1) ** (1 / 2.2) for each in (flux, capture.view)]
                error = 0.5 + 2 * (np.nan_to_num(flux) - capture.view) / high
                picture = np.vstack([*tones, np.clip(error, 0, 1)])
                cv2.imwrite(str(pictures / f"{case.title}, {name}.png".replace(" ", "-")), np.uint8(255 * picture))
        for name, motion in motions.items():
            found = FLOW.ghost_map(source, capture.group, motion).moving & inside
            both = (found & moving).sum()
            share = f"precision {both / max(found.sum(), 1):.3f}, recall {both / max(moving.sum(), 1):.3f}, "
            print(f"{case.title}, {name} motion: {share}{(found & still).sum()} of {still.sum()} still pixels", flush=True)


def main() -> None:
    """Measure, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("page", type=Path, nargs="?", help="the page whose table is replaced")
    parser.add_argument("--pictures", type=Path, help="folder for pictures of the exposures and their errors")
    parser.add_argument("--only", nargs="*", choices=CASES, default=list(CASES))
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    lines = [
        "| What moves | Merger | PSNR there, dB | elsewhere | there, estimated motion | elsewhere | CPU time |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for name in arguments.only:
        with tempfile.TemporaryDirectory() as folder:
            for line in rows(CASES[name], Path(folder), arguments.pictures):
                print(line, flush=True)
                lines.append(line)
    if arguments.page:
        text = arguments.page.read_text(encoding="utf-8")
        before, rest = text.split("<!-- dense: begin -->")
        page = (
            "\n".join([f"{before}<!-- dense: begin -->", *lines, "<!-- dense: end -->"]) + rest.split("<!-- dense: end -->")[1]
        )
        arguments.page.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
