"""Compare pose estimators where the true poses are known: the table of docs/how-to/poses.md.

    python tests/benchmarks/poses.py docs/how-to/poses.md --work FOLDER
    python tests/benchmarks/poses.py --work FOLDER --only room-1 --flux 0.3 --k1 -0.1

Five simulated captures of 10,000 frames of 254 x 496 pixels, held by a hand with a tremor of 2 px, at three light levels. Each
method is a run of the program as users start it; the seconds and the memory that are printed are those of its process. COLMAP
on sharp frames gets every 200th frame without noise and without blur, and is scored at these. Captures and results stay in the
folder, and what is there already is not measured again. `k1` is the distortion of a lens, which each method is given. With
captures of 160 MB, the whole table takes an hour.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from harness import Study, chosen, command, in_child, packed, simulator, table, write_tables

from photonpano import CameraGuess, PhotonpanoError, evaluate_poses, parse_spec, simulate
from photonpano.capture.writing import truth_path
from photonpano.evaluation import PoseScore, pose_errors
from photonpano.evaluation.poses import load_true_poses
from photonpano_colmap.configs import ColmapAveragesConfig
from photonpano_colmap.reconstruction import reconstruct

N_FRAMES, SHAPE, FOCAL_PX, SHARP_EVERY = 10_000, (254, 496), 450.0, 200
TREMOR = {"rms_px": 2.0, "rms_mm": 0.5, "roll_rms_deg": 0.05}
SCENES: dict[str, dict[str, Any]] = {
    "room-1": {"scene": {"kind": "room", "seed": 1}, "path": {"seed": 1, "length_m": 1.0}},
    "room-2": {"scene": {"kind": "room", "seed": 2}, "path": {"seed": 2, "length_m": 1.0}},
    "facade-3": {"scene": {"kind": "facade", "seed": 3}, "path": {"seed": 3, "length_m": 2.0}},
    "facade-4": {"scene": {"kind": "facade", "seed": 4}, "path": {"seed": 4, "length_m": 2.0}},
    "planes-5": {"scene": {"kind": "planes", "seed": 5}, "path": {"seed": 5, "length_m": 2.0}},
}
FLUXES = ("0.3", "0.1", "0.05")
SHARP, AVERAGES, STRATIFIED = "sharp frames", "colmap-averages", "stratified-pose"
METHODS = (SHARP, AVERAGES, STRATIFIED)
HEADER = (
    "Capture, flux", "COLMAP on sharp frames", "`colmap-averages`", "`stratified-pose`", "Within 2 std", "Located",
)  # fmt: skip


def simulated(scene: str, flux: str, work: Path, n_frames: int = N_FRAMES, k1: float = 0.0) -> Path:
    """Return a capture, simulated if it is not there."""
    cube = work / f"{scene}{_lens(k1)}-{flux}-{n_frames}.npy"
    if not cube.exists():
        keys = SCENES[scene]
        camera = {
            "distortion": {"k1": k1},
            "n_frames": n_frames,
            "frame_shape": list(SHAPE),
            "frame_rate_hz": 10_000 * n_frames / N_FRAMES,
        }
        path = {"kind": "travel", **keys["path"], "tremor": TREMOR}
        capture = simulator("travel-simulator", scene=keys["scene"], path=path, flux=float(flux), focal_px=FOCAL_PX, **camera)
        simulate(parse_spec(capture), cube, sharp_every=SHARP_EVERY)
    return cube


def measured(scene: str, flux: str, method: str, study: Study, n_frames: int, k1: float) -> dict[str, Any]:
    """Return the figures of a method on a capture."""
    cube = simulated(scene, flux, study.folder, n_frames, k1)
    if method == SHARP:
        return _figures(_sharp(cube, truth_path(cube), k1))
    spec = packed(cube, None, pose={"use": method}, camera={"focal_px": FOCAL_PX, "distortion": {"k1": k1}})
    try:
        folder, seconds, _, mib = in_child(study.run, f"{cube.stem}-{method}", spec)
    except PhotonpanoError as error:
        return {"failed": str(error).splitlines()[-1]}
    return _figures(evaluate_poses(folder, truth_path(cube))) | {"seconds": seconds, "mib": mib}


def _lens(k1: float) -> str:
    return f"-k1={k1:g}" if k1 else ""


def _sharp(cube: Path, truth: Path, k1: float) -> PoseScore:
    """Score COLMAP on sharp frames."""
    pictures = [cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) for file in sorted(cube.with_suffix(".sharp").glob("*.png"))]
    everywhere = np.full(SHAPE, 255, np.uint8)
    config, guess = ColmapAveragesConfig(), CameraGuess(FOCAL_PX, distortion=(k1, 0, 0, 0))
    found = reconstruct([(picture, everywhere) for picture in pictures], guess, config, 0)
    piece = found.pieces[0]
    true = load_true_poses(truth).camera_from_world[::SHARP_EVERY]
    poses, located = np.full(true.shape, np.nan), np.zeros(len(true), np.bool_)
    poses[piece.images], located[piece.images] = piece.poses, True
    return pose_errors(poses, true, located, 1)


def _figures(score: PoseScore) -> dict[str, Any]:
    return {
        "ate": 100 * score.ate_share,
        "turned": score.turns_deg,
        "located": 100 * score.located_share,
        "within": None if score.honest_shares is None else 100 * score.honest_shares[1],
    }


def row(scene: str, flux: str, of: dict[str, dict[str, Any]]) -> Iterator[str]:
    """Yield the cells of a row of the table, of the figures of each method."""
    yield f"`{scene}`, {flux}"
    for method in METHODS:
        figures = of.get(method, {"failed": ""})
        yield figures["failed"] if "failed" in figures else f"{figures['ate']:.3f} %, {figures['turned']:.3f}°"
    best = of.get(STRATIFIED, {})
    yield from (f"{best[key]:.0f} %" if "within" in best else "" for key in ("within", "located"))


def main(
    page: Path | None,
    work: Path = Path("runs/poses"),
    only: Sequence[str] = tuple(SCENES),
    flux: Sequence[str] = FLUXES,
    methods: Sequence[str] = METHODS,
    frames: int = N_FRAMES,
    k1: float = 0.0,
) -> None:
    """Measure, and write the page."""
    work.mkdir(parents=True, exist_ok=True)

    def figures(scene: str, light: str, method: str) -> dict[str, Any]:
        # Sharp frames are the same whatever the flux.
        name = f"{scene}{_lens(k1)}-{frames}" if method == SHARP else f"{scene}{_lens(k1)}-{light}-{frames}"
        file = work / f"{name}-{method.replace(' ', '-')}.json"
        if not file.exists():
            file.write_text(json.dumps(measured(scene, light, method, Study(work), frames, k1)))
        of: dict[str, Any] = json.loads(file.read_text())
        if "seconds" in of:
            print(f"{scene}, {light}, {method}: {of['seconds']:.0f} s, {of['mib']:.0f} MiB", flush=True)
        return of

    def rows() -> Iterator[Iterator[str]]:
        for scene in chosen(only, SCENES):
            for light in flux:
                yield row(scene, light, {method: figures(scene, light, method) for method in chosen(methods, METHODS)})

    write_tables(page, {"poses": table(HEADER, rows())})


if __name__ == "__main__":
    command(main, "poses")
