"""Compare pose estimators where the true poses are known: the tables of docs/how-to/poses.md.

    python tests/benchmarks/poses.py docs/how-to/poses.md --work FOLDER
    python tests/benchmarks/poses.py --work FOLDER --only room-1 --flux 0.3 --k1 -0.1
    python tests/benchmarks/poses.py docs/how-to/poses.md --work FOLDER --seeds 20 21 22 23 24

Five simulated captures of 10,000 frames of 254 x 496 pixels, held by a hand with a tremor of 2 px, at three light levels. Each
method is a run of the program as users start it; the seconds and the memory that are printed are those of its process. COLMAP
on sharp frames gets every 200th frame without noise and without blur, and is scored at these. Captures and results stay in the
folder, and what is there already is not measured again. `k1` is the distortion of a lens, which each method is given. With
captures of 160 MB, the whole table takes an hour.

With `--seeds`, the table is that of the verdicts on a room and a facade of each seed, at five light levels in turn; the last
line counts the trusted and the doubtful runs, right and wrong. Ten captures take half an hour.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from harness import Study, chosen, command, in_child, packed, record_of, simulator, table, write_tables

from photonpano import PhotonpanoError, parse_spec, simulate
from photonpano.capture.writing import truth_path
from photonpano_colmap.hooks import ColmapAveragesConfig
from photonpano_colmap.reconstruction import reconstruct
from photonpano_poses import CameraGuess, PoseScore, evaluate_poses, pose_errors
from photonpano_poses.scores import load_run_poses, load_true_poses

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

SMALL = {"n_frames": 6000, "frame_shape": [256, 256], "frame_rate_hz": 6000, "focal_px": 260.0}
SMALL_FLUXES = (0.02, 0.05, 0.1, 0.2, 0.3)
LENGTHS_M = {"room": 1.0, "facade": 2.0}
VERDICTS_HEADER = (
    "Capture, flux", "`colmap-averages`: error", "expected", "verdict", "`stratified-pose`: error", "expected", "verdict",
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
    true = load_true_poses(truth)[0][::SHARP_EVERY]
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


def judged(kind: str, seed: int, flux: float, method: str, study: Study) -> tuple[str, str, str]:
    """Return the error of a small capture, the expected one, and the verdict."""
    path = {"kind": "travel", "seed": seed, "length_m": LENGTHS_M[kind], "tremor": {**TREMOR, "rms_px": 1.0}}
    spec = simulator("travel-simulator", scene={"kind": kind, "seed": seed}, path=path, flux=flux, **SMALL)
    name = f"{kind}-{seed}-{flux}"
    cube = study.capture(name, spec)
    camera = {"focal_px": SMALL["focal_px"]}
    try:
        folder = study.run(f"{name}-{method}", {**spec, "pose": {"use": method}, "camera": camera}, cube)
    except PhotonpanoError:
        return "", "", "refused"
    score, poses = evaluate_poses(folder, truth_path(cube)), load_run_poses(folder)
    errors = 100 * score.ate_share, score.rotation_deg
    stds = [float(np.sqrt(np.nanmean(std**2))) for std in (100 * poses.std_position, poses.std_rotation_deg)]
    within = score.honest_shares[1] if score.honest_shares else 0
    # 0.3 % of the path, and 0.3 degrees, are right whatever is expected.
    is_wrong = within < 0.9 or any(error > max(0.3, 3 * std) for error, std in zip(errors, stds, strict=True))
    shown = (f"{position:.2f} %, {rotation:.2f}°" for position, rotation in (errors, stds))
    return *shown, record_of(folder)["verdict"]["status"] + (", wrong" if is_wrong else "")


def verdicts(seeds: Sequence[int], study: Study) -> list[str]:
    """Return the table of the verdicts, and print how many are right."""
    found: list[str] = []

    def cells(kind: str, number: int) -> Iterator[str]:
        flux = SMALL_FLUXES[number % len(SMALL_FLUXES)]
        yield f"`{kind}-{seeds[number]}`, {flux}"
        for method in (AVERAGES, STRATIFIED):
            row = judged(kind, seeds[number], flux, method, study)
            found.append(row[-1])
            yield from row

    lines = table(VERDICTS_HEADER, (cells(kind, number) for number in range(len(seeds)) for kind in LENGTHS_M))
    print(f"{len(found)} runs: {', '.join(f'{times} {each}' for each, times in Counter(found).items())}")
    return lines


def main(
    page: Path | None,
    work: Path = Path("runs/poses"),
    only: Sequence[str] = tuple(SCENES),
    flux: Sequence[str] = FLUXES,
    methods: Sequence[str] = METHODS,
    frames: int = N_FRAMES,
    k1: float = 0.0,
    seeds: Sequence[str] = (),
) -> None:
    """Measure, and write the page."""
    work.mkdir(parents=True, exist_ok=True)
    if seeds:
        write_tables(page, {"verdicts": verdicts([int(seed) for seed in seeds], Study(work))})
        return

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
    command(main, "poses", "verdicts")
