"""Measure runs of every kind of motion by default, against runs that are told the model, and the least error that is possible.

    python tests/benchmarks/motions.py --photographs FOLDER [--only sign lantern] [--motions zoom f430] [--paths smooth]
        [--fluxes 0.3 0.1 0.03] [--frames 4000] [--seed 0] [--captures FOLDER] [--jobs 2] [--output motions.json]
    python tests/benchmarks/motions.py --small [--motions keystone shear]

`MOTIONS` of motion_paths.py says which there are: 4,000 frames of 254x496 px of a perfect sensor, on a way of 500 px, or of
what there is room for, over a photograph that is scaled to a height of 900 px. A smooth path is a spline; a trembling one has
sines of 1 px in addition. `--small` takes 900 frames of 96x128 px, the first flux, and a height of 400 px: seconds for each
run. Without photographs the scene is a texture of a seed.

Each capture is run twice, with one thread: by default, with a source alone; and told, with `motion.model`, and with a lens that
is to be found where there is one. Errors are those of corners after the best alignment of the planes. "Ends" is the mean error
of the outermost 3 % of the frames over that of all. The bound is that of `joint_bound` for the model, and for rotations of the
focal length and, with a lens, of k1 and k2. A run is wrong if it is trusted, and its mean error exceeds 0.3 px and 3 times what
it claims, or fewer than 90 % of its frames are within 3 std_px.

Captures are removed after their runs, unless they have a folder (63 MB each). Results stay in the JSON file, so that an
interrupted benchmark continues; the table is beside it.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from harness import Study, chosen, command, passing, simulator
from harness import table as table_of
from joint_bound import Model, joint_bound
from motion_paths import LENGTHS_PX, MOTIONS, WIDTH, Motion, path_of
from trust import scored
from trust_scores import WRONG_PX, WRONG_TIMES, Result, reasons, status

from photonpano import InputError, open_source, parse_spec
from photonpano.capture.writing import truth_path
from photonpano.evaluation import corner_errors, load_run_trajectory, load_truth
from photonpano.geometry import Camera
from photonpano.testing.captures import textured

PATHS = ("smooth", "trembling")
ENDS = 0.03  # share of the frames, half of them at each end
RIGHT_PX = 0.15  # a run whose mean error is smaller should be trusted
WRONG_WITHIN_3 = 0.9
TEXTURE, ASPECT = "texture", 1.5
KEY = ("photograph", "motion", "path", "flux", "frames", "height", "seed")
HEAD = (
    "Photograph", "Motion", "Path", "Flux", "Bound", "Mean (max)", "Told", "/ told", "/ bound", "Within 2 / 3", "std / rms",
    "Ends", "Model", "CPU s (told)", "Says", "Told says",
)  # fmt: skip


class Size(NamedTuple):
    """How large captures are: (height, width) of frames, their number, and the height of the scene."""

    frame_shape: tuple[int, int]
    frames: int
    height: int


FULL, SMALL = Size((254, WIDTH), 4000, 900), Size((96, 128), 900, 400)


class Task(NamedTuple):
    """A capture; without a photograph, the scene is a texture."""

    photo: Path | None
    motion: str
    path: str
    flux: float
    size: Size
    seed: int

    @property
    def key(self) -> dict[str, Any]:
        """What tells its result from others, by the names of `KEY`."""
        name = self.photo.stem if self.photo else TEXTURE
        shape, frames, _ = self.size
        return dict(zip(KEY, (name, self.motion, self.path, self.flux, frames, shape[0], self.seed), strict=True))


def simulated(task: Task, study: Study) -> Path:
    """Return a capture along the longest path that stays in the scene."""
    (shape, frames, height), motion = task.size, MOTIONS[task.motion]
    photo, width = scene_of(task, study)
    scene = {"kind": "photo", "file": str(photo.resolve()), "width": width}
    camera: dict[str, Any] = {"frame_shape": list(shape), "n_frames": frames, "flux": task.flux, "seed": task.seed}
    if motion.lens:
        camera |= {"focal_length_px": motion.focal_px * shape[1] / WIDTH, "distortion": motion.lens}
    for length_px in LENGTHS_PX:
        way = path_of(motion, shape, frames, (height, width), task.seed, length_px, task.path == "trembling")
        file = study.folder / f"way-{hashlib.sha256(way.tobytes()).hexdigest()[:12]}.npy"
        np.save(file, way)
        spec = simulator(scene=scene, path={"kind": "file", "file": str(file.resolve())}, **camera)
        try:
            with open_source(parse_spec(spec)):
                return study.capture(f"{photo.stem}-{task.motion}-{task.path}-{task.flux}", spec)
        except InputError as error:
            file.unlink()
            if "leaves the scene" not in str(error):
                raise
    raise SystemExit(f"{photo} has no room for {task.motion}")


def scene_of(task: Task, study: Study) -> tuple[Path, int]:
    """Return the file of the scene, and the width of the scene in px."""
    if task.photo:
        picture = cv2.imread(str(task.photo))
        if picture is None:
            raise SystemExit(f"{task.photo} is not a picture that OpenCV reads")
        return task.photo, round(picture.shape[1] * task.size.height / picture.shape[0])
    shape = task.size.height, round(task.size.height * ASPECT)
    file = study.folder / f"{TEXTURE}-{task.size.height}-{task.seed}.png"
    if not file.exists():
        flux = textured(shape, seed=task.seed)
        cv2.imwrite(str(file), (65535 * (flux / flux.max()) ** (1 / 2.2)).astype(np.uint16))  # about sRGB
    return file, shape[1]


def bound_of(cube: Path, motion: Motion) -> float:
    """Return the least mean error of a capture in px, which stays beside it."""
    file = cube.with_suffix(".bound.json")
    if not file.exists():
        truth = load_truth(truth_path(cube))
        assert truth.scene is not None
        shape = truth.frame_shape
        camera = Camera.of(motion.focal_px * shape[1] / WIDTH or 1, shape, [*motion.lens.values(), 0, 0, 0, 0][:4])
        n_shared = (3 if motion.lens else 1) if motion.model == "rotation" else 0
        model = Model.of(motion.model, shape, camera if n_shared else None, n_shared)
        file.write_text(json.dumps(joint_bound(truth.scene, truth.ideal_homographies, model).mean_px))
    return float(json.loads(file.read_text()))


def told(motion: Motion) -> dict[str, Any]:
    """Return the sections of a spec that says what moves."""
    lens = {"camera": {"distortion": dict.fromkeys(motion.lens, "find")}} if motion.lens else {}
    return {"motion": {"model": motion.model}, **lens}


def ends(cube: Path, folder: Path) -> Result:
    """Return the mean error of the outermost frames, over that of all."""
    found, truth = load_run_trajectory(folder), load_truth(truth_path(cube))
    score = corner_errors(found.corner_homographies, truth.homographies, truth.frame_shape, found.located)
    errors = score.errors_px[found.located]
    n = max(1, round(len(errors) * ENDS / 2))
    return {"ends": float(np.concatenate([errors[:n], errors[-n:]]).mean() / score.mean_px)}


def measured(task: Task, captures: Path | None) -> Result:
    """Simulate a capture if it is not there, run it by default and told, and return the scores of both."""
    if captures is None:
        with passing() as study:
            return measured(task, study.folder)
    cube, motion = simulated(task, Study(captures)), MOTIONS[task.motion]
    both = {"default": scored(cube, partial(ends, cube)), "told": scored(cube, partial(ends, cube), **told(motion))}
    return {**task.key, "bound_px": bound_of(cube, motion), **both}


def row(result: Result) -> Iterator[str]:
    """Yield the cells of a row."""
    default, other = result["default"], result["told"]
    yield from (str(result[key]) for key in KEY[:4])
    yield f"{result['bound_px']:.3f}"
    mean, least = (each.get("mean_px", np.nan) for each in (default, other))
    numbers = f"{mean:.3f} ({default.get('max_px', np.nan):.2f})", f"{least:.3f}", f"{mean / least:.2f}"
    yield from ("-" if "nan" in each else each for each in (*numbers, f"{mean / result['bound_px']:.1f}"))
    if "mean_px" in default:
        yield f"{default['within_2']:.0%} / {default['within_3']:.0%}"
        yield from (f"{default['std_px'] / default['rms_px']:.2f}", f"{default['ends']:.1f}", model_of(default))
    else:
        yield from "----"
    yield f"{default['cpu_s']:.0f} ({other['cpu_s']:.0f})"
    yield from (": ".join([says(each), *(reason.splitlines()[0] for reason in reasons(each)[:1])]) for each in (default, other))


def model_of(run: Result) -> str:
    """Return the model that a run has taken."""
    return next((str(each["value"]) for each in run["decisions"] if each["what"] == "motion_model"), "-")


def says(run: Result) -> str:
    """Return what a run says of itself, and whether that is wrong."""
    return f"{status(run)}, WRONG" if is_wrong(run) else status(run)


def is_wrong(run: Result) -> bool:
    """Return whether a run is trusted, and far from the truth or from its claim."""
    if status(run) != "trusted" or "mean_px" not in run:
        return False
    return bool(run["mean_px"] > max(WRONG_PX, WRONG_TIMES * run["std_px"]) or run["within_3"] < WRONG_WITHIN_3)


def summary(results: Sequence[Result]) -> Iterator[str]:
    """Yield the sentences below the table: on the two runs of each capture, and on each kind of run."""
    ended = [each for each in results if "mean_px" in each["default"] and "mean_px" in each["told"]]
    if ended:
        ratios = [each["default"]["mean_px"] / each["told"]["mean_px"] for each in ended]
        worst = ended[int(np.argmax(ratios))]
        named = ", ".join(str(worst[key]) for key in KEY[:4])
        yield (
            f"Of {len(ended)} captures of which both runs ended, the error by default is {np.median(ratios):.2f} (median) and "
            f"{max(ratios):.1f} times (worst: {named}) that of the run that is told the model."
        )
    for kind in ("default", "told"):
        runs = [each[kind] for each in results]
        scores = [each for each in runs if "mean_px" in each]
        right = [status(each) for each in scores if each["mean_px"] < RIGHT_PX]
        trusted = sum(status(each) == "trusted" for each in runs)
        ratio = np.median([each["std_px"] / each["rms_px"] for each in scores] or [np.nan])
        yield (
            f"{kind.capitalize()}: {len(scores)} of {len(runs)} runs ended, {trusted} are trusted, {sum(map(is_wrong, runs))} "
            f"of them wrong. {right.count('trusted')} of {len(right)} below {RIGHT_PX} px are trusted. std_px is {ratio:.2f} "
            f"times the rms error (median). {sum(each['cpu_s'] for each in runs):.0f} CPU s."
        )


def main(
    photographs: Path | None = None,
    only: Sequence[str] = ("sign", "dunes", "lantern", "tower"),
    motions: Sequence[str] = tuple(MOTIONS),
    paths: Sequence[str] = PATHS,
    fluxes: Sequence[float] = (0.3, 0.1, 0.03),
    small: bool = False,
    frames: int = 0,
    seed: int = 0,
    captures: Path | None = None,
    jobs: int = 1,
    output: Path = Path("motions.json"),
) -> None:
    """Measure what is missing in the file of results."""
    for library in ("OMP", "OPENBLAS", "MKL"):  # a processor for each job
        os.environ[f"{library}_NUM_THREADS"] = "1"
    files = {file.stem: file for file in sorted(photographs.rglob("*.jpg"))} if photographs else {}
    photos = [files[name] for name in chosen(only, files)] if photographs else [None]
    size = SMALL if small else FULL
    size = size._replace(frames=frames or size.frames)
    which = chosen(motions, MOTIONS), chosen(paths, PATHS), fluxes[:1] if small else fluxes
    results: list[Result] = json.loads(output.read_text()) if output.exists() else []
    known = [{key: each[key] for key in KEY} for each in results]
    tasks = [Task(*each, size, seed) for each in product(photos, *which)]
    if captures is not None:
        captures.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(jobs, get_context("spawn"), max_tasks_per_child=1) as pool:

        def rows() -> Iterator[Iterator[str]]:
            yield from map(row, results)
            for result in pool.map(partial(measured, captures=captures), [each for each in tasks if each.key not in known]):
                results.append(result)
                output.write_text(json.dumps(results, indent=1))
                yield row(result)

        lines = [*table_of(HEAD, rows()), "", *summary(results)]
    print("", *summary(results), sep="\n")
    output.with_suffix(".md").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    command(main)
