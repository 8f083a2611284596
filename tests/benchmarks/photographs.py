"""Measure runs of ordinary photographs against the least error that the photons of a capture allow, with all defaults.

    python tests/benchmarks/photographs.py --photographs FOLDER [--only sign dunes] [--fluxes 0.3 0.1 0.03] [--paths pan]
        [--motions shift-roll f430-lens] [--captures FOLDER] [--jobs 2] [--output photographs.json]

Photographs in the folder, and in folders in it, are scaled to a height of 900 px. Frames of 254x496 px of a perfect sensor see
them along two smooth paths of 500 px, or of what there is room for: a diagonal ("pan"), and a random spline. `shift-roll` moves
frames by shifts and rolls; f430 and f2000 turn a camera of this focal length in px, with or without a lens of k1 = -0.1 and
k2 = 0.03. The spec of a run has a source alone, and one thread. The bound is that of `joint_bound` for the numbers that moved:
shift and roll; or a rotation, the focal length and, with a lens, k1 and k2. In brackets is that of homographies.

Captures with their bounds stay in their folder (63 MB each), and results in the JSON file, so that an interrupted benchmark
continues; the table is beside it.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from harness import Study, chosen, command, simulator
from harness import table as table_of
from joint_bound import Model, joint_bound
from trust import scored
from trust_scores import reasons, status

from photonpano import InputError, open_source, parse_spec
from photonpano.capture.writing import truth_path
from photonpano.evaluation import load_truth
from photonpano.geometry import Camera

HEIGHT, SHAPE = 900, (254, 496)
LENGTHS_PX = (500, 400, 300, 250, 200, 150, 100)
TREMBLE = {"rms_px": 6.0, "roll_rms_deg": 0.4, "frequencies_hz": [12.0, 30.0, 50.0]}  # 0.5 to 2 periods in 4,000 frames
PATHS = {"pan": 0, "spline": 1}
NO_LENS: dict[str, float] = {}
LENS = {"k1": -0.1, "k2": 0.03}
MOTIONS: dict[str, tuple[float, dict[str, float]]] = {"f2000": (2e3, NO_LENS), "f430": (430.0, NO_LENS)}
MOTIONS |= {"f2000-lens": (2e3, LENS), "f430-lens": (430.0, LENS), "shift-roll": (1e6, NO_LENS)}
"""Focal length in px, at last so long that a rotation is a shift or a roll; and distortion."""
HEAD = (
    "Photograph", "Path", "Flux", "Motion", "Bound (8)", "Mean (max)", "/ bound", "Claimed", "Within 2", "std / rms", "Cuts",
    "Located", "CPU s", "Says",
)  # fmt: skip


def simulated(photo: Path, path: str, flux: float, motion: str, frames: int, study: Study) -> Path:
    """Return a capture along the longest path that stays in the photograph."""
    height, width = cv2.imread(str(photo)).shape[:2]
    width = round(width * HEIGHT / height)
    angle = float(np.rad2deg(np.arctan2(HEIGHT - SHAPE[0], width - SHAPE[1])))
    focal_px, distortion = MOTIONS[motion]
    way = {"kind": "pan", "angle_deg": angle} if path == "pan" else {"kind": "random-spline", "knots": 6, "seed": PATHS[path]}
    scene = {"kind": "photo", "file": str(photo.resolve()), "width": width}
    camera = {"focal_length_px": focal_px, "distortion": distortion, "frame_shape": list(SHAPE), "n_frames": frames}
    for length in LENGTHS_PX:
        along = {**way, "length_px": length, "shake": TREMBLE}
        spec = simulator(scene=scene, path=along, flux=flux, seed=PATHS[path], **camera)
        try:
            with open_source(parse_spec(spec)):
                return study.capture(f"{photo.stem}-{path}-{flux}-{motion}", spec)
        except InputError as error:
            if "leaves the scene" not in str(error):
                raise
    raise SystemExit(f"{photo} has no room for the {path} of {motion}")


def bounds_of(cube: Path, motion: str) -> dict[str, float]:
    """Return the bounds of a capture in px, which stay beside it.

    They are `bound_px` of what moved, `strict_px` as if noise left all of the gradient, and `homography_px`.
    """
    file = cube.with_suffix(".bounds.json")
    if not file.exists():
        truth, (focal_px, distortion) = load_truth(truth_path(cube)), MOTIONS[motion]
        camera = Camera.of(focal_px, SHAPE, [*distortion.values(), 0, 0, 0, 0][:4])
        turning = Model.of("rotation", SHAPE, camera, 3 if camera.distorts else 1)
        model = Model.of("euclidean", SHAPE) if motion == "shift-roll" else turning
        of_scene = partial(joint_bound, truth.scene)
        bound, strict = (of_scene(truth.ideal_homographies, model, limited=limited) for limited in (True, False))
        free = of_scene(truth.homographies, Model.of("homography", SHAPE))
        bounds = {"bound_px": bound.mean_px, "strict_px": strict.mean_px, "homography_px": free.mean_px}
        file.write_text(json.dumps(bounds | {"spacing": bound.spacing}))
    found: dict[str, float] = json.loads(file.read_text())
    return found


def measured(task: tuple[Path, str, float, str], frames: int, captures: Path) -> dict[str, Any]:
    """Simulate a capture if it is not there, run it, and return the scores."""
    photo, path, flux, motion = task
    cube = simulated(*task, frames, Study(captures))
    task_of = {"photograph": photo.stem, "path": path, "flux": flux, "motion": motion, "frames": frames}
    return task_of | bounds_of(cube, motion) | scored(cube)


def row(result: dict[str, Any]) -> Iterator[str]:
    """Yield the cells of a row."""
    yield from (str(result[key]) for key in ("photograph", "path", "flux", "motion"))
    yield f"{result['bound_px']:.3f} ({result['homography_px']:.3f})"
    if "mean_px" in result:
        yield f"{result['mean_px']:.3f} ({result['max_px']:.2f})"
        yield f"{result['mean_px'] / result['bound_px']:.1f}"
        yield from (f"{result['std_px']:.3f}", f"{result['within_2']:.0%}", f"{result['std_px'] / result['rms_px']:.2f}")
        yield from (str(result["cuts"]), f"{result['located']:.0%}")
    else:
        yield from "-------"
    yield f"{result['cpu_s']:.0f}"
    yield ": ".join([status(result), *(reason.splitlines()[0] for reason in reasons(result)[:1])])


def summary(results: Sequence[dict[str, Any]]) -> str:
    """Return the line below the table."""
    ended = [each for each in results if "mean_px" in each]
    ratios = [each["mean_px"] / each["bound_px"] for each in ended] or [np.nan]
    honest, right = sum(each["within_2"] >= 0.95 for each in ended), [status(each) for each in ended if each["mean_px"] < 0.2]
    return (
        f"{len(ended)} of {len(results)} runs ended, at {np.median(ratios):.2f} (median) and {max(ratios):.1f} times (worst) "
        f"the bound. {honest} have 95 % of the frames within 2 std_px. {right.count('trusted')} of {len(right)} below 0.2 px "
        f"are trusted. {sum(each['cuts'] for each in ended)} false cuts. {sum(each['cpu_s'] for each in results):.0f} CPU s."
    )


def main(
    photographs: Path = Path("photographs"),
    only: Sequence[str] = ("",),
    fluxes: Sequence[float] = (0.3, 0.1, 0.03),
    paths: Sequence[str] = tuple(PATHS),
    motions: Sequence[str] = ("shift-roll",),
    frames: int = 4000,
    captures: Path = Path("runs/photographs"),
    jobs: int = 1,
    output: Path = Path("photographs.json"),
) -> None:
    """Measure what is missing in the file of results."""
    for library in ("OMP", "OPENBLAS", "MKL"):  # a processor for each job
        os.environ[f"{library}_NUM_THREADS"] = "1"
    files = {file.stem: file for file in sorted(photographs.rglob("*.jpg"))}
    photos = [files[name] for name in chosen(only, files)]
    tasks = list(product(photos, chosen(paths, PATHS), fluxes, [name for name in MOTIONS if name in motions]))
    results: list[dict[str, Any]] = json.loads(output.read_text()) if output.exists() else []
    known = {tuple(each[key] for key in ("photograph", "path", "flux", "motion", "frames")) for each in results}
    tasks = [task for task in tasks if (task[0].stem, *task[1:], frames) not in known]
    captures.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(jobs, get_context("spawn"), max_tasks_per_child=1) as pool:

        def rows() -> Iterator[Iterator[str]]:
            yield from map(row, results)
            for result in pool.map(partial(measured, frames=frames, captures=captures), tasks):
                results.append(result)
                output.write_text(json.dumps(results, indent=1))
                yield row(result)

        lines = [*table_of(HEAD, rows()), "", summary(results)]
    print(lines[-1])
    output.with_suffix(".md").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    command(main)
