"""Measure whether runs are honest: the errors of difficult captures against what the runs claim, with all defaults.

    python tests/benchmarks/trust.py [--rows tremor window] [--seeds 20] [--small] [--jobs 1] [--photographs FOLDER]
        [--output trust.json]
    python tests/benchmarks/trust.py --cuts [--rows tremor] [--seeds 30]

Each row is a kind of capture, simulated with a known truth. `--rows` keeps those whose names contain one of the words. The
results are kept in the JSON file, so that an interrupted benchmark continues; the table is written beside it as Markdown.
`--small` takes frames of 128x192 px and at most 4,000 of them: a quarter of an hour on two cores. With a folder of photographs,
captures show these in turn, instead of the street, where there is room for the path.

A run is honest if it was refused, if its verdict is "doubtful", or if 95 % of its frames are within 2 `std_px` and 99 % within
3, and the mean `std_px` is at most 3 times the root mean square of the errors. A run without a verdict counts as trusted.

`--cuts` measures where runs cut the motion, on captures of 96x144 px and 1,600 frames: jumps that are missed, and cuts where
the image does not jump. A cut is right if the camera left out, or repeated, frames within two frames of it; jumps that are
smaller than 1 px are not counted as missed. A run takes about ten seconds on two cores.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from harness import RATE_HZ, Study, chosen, command, middles, packed, passing, record_of, scores_of, simulator
from harness import table as table_of
from trust_captures import CUT_ROWS, FULL, SMALL, STREET_SHAPE, TINY, Row, Size, bases, before_photographs
from trust_scores import Result, status, table

from photonpano import InputError, PhotonpanoError, SpecError
from photonpano.capture.writing import truth_path
from photonpano.evaluation import Truth, corner_errors, load_run_trajectory, load_truth
from photonpano.geometry import inverse

NEAR = 2  # frames between a jump and a cut that counts as found
SMALLEST_PX = 1.0  # smaller jumps are not counted as missed


def simulated(row: Row, seed: int, size: Size, study: Study) -> Path:
    """Write the capture of a row, with its truth beside it."""
    settings = bases(size)[row.base] | {"scene": {"kind": "street"}, "frame_shape": size.frame_shape} | row.changes(size)
    scene_shape = STREET_SHAPE
    for section in ("scene", "path"):
        if settings[section]["kind"] in ("street", "night", "random-spline"):
            settings[section] = settings[section] | {"seed": seed}
    if row.picture is not None:
        picture = row.picture(seed)
        cv2.imwrite(str(study.folder / "scene.png"), picture)
        settings["scene"] = {"kind": "photo", "file": str(study.folder / "scene.png")}
        scene_shape = picture.shape[:2]
    if row.way is not None:
        homographies = np.tile(np.eye(3), (settings["n_frames"], 1, 1))
        homographies[:, :2, 2] = row.way(settings["n_frames"]) + (np.array(scene_shape[::-1]) - size.frame_shape[::-1]) / 2
        np.save(study.folder / "way.npy", homographies)
        settings["path"] = {"kind": "file", "file": str(study.folder / "way.npy")}
    try:
        cube = study.capture("capture", simulator(**settings | {"seed": seed, "frame_rate_hz": RATE_HZ}))
    except InputError as error:
        if row.picture is None or "leaves the scene" not in str(error):
            raise
        return simulated(replace(row, picture=None), seed, size, study)
    if row.order is not None:
        order = row.order(settings["n_frames"])
        np.save(cube, np.load(cube)[order])
        with np.load(truth_path(cube)) as truth:
            of_frames = {name: each[order] for name, each in truth.items() if each.shape[:1] == (settings["n_frames"],)}
            np.savez(truth_path(cube), **dict(truth) | of_frames)
    if row.repack is not None:
        np.save(cube, row.repack(np.load(cube), size.frame_shape[1]))
    return cube


def measured(row: Row, name: str, seed: int, size: Size) -> Result:
    """Run one capture with all defaults, and score it.

    Returns:
        `exit_code`, `seconds`, `message` of an error, `warnings` and `verdict`; and, where the run ended well, the figures of
        `figures_of` and of `cuts_of`, and `below_oracle_db`.
    """
    with passing() as study:
        cube = simulated(row, seed, size, study)
        result: Result = {"row": name, "seed": seed, "exit_code": 0, "message": "", "verdict": None, "warnings": []}
        start = time.perf_counter()
        try:
            folder = study.run("run", packed(cube, **row.spec))
        except PhotonpanoError as error:
            result |= {"exit_code": 2 if isinstance(error, SpecError) else 1, "message": str(error)}
        except Exception as error:  # a defect of photonpano is a result too
            result |= {"exit_code": None, "message": repr(error)}
        result["seconds"] = time.perf_counter() - start
        if result["exit_code"] != 0:
            return result
        record = record_of(folder)
        result |= {"warnings": list(record["warnings"]), "verdict": record.get("verdict")}
        with np.load(truth_path(cube)) as truth:
            result |= figures_of_run(folder, load_truth(truth_path(cube)))
            if "mean_px" in result:
                result |= cuts_of([int(each["value"]) for each in record["decisions"] if each["what"] == "cut"], dict(truth))
        if "mean_px" in result:
            with suppress(PhotonpanoError, ValueError):
                result["below_oracle_db"] = scores_of(folder, cube).below_oracle_db
    return result


def cuts_of(cuts: list[int], truth: dict[str, np.ndarray]) -> Result:
    """Return how many `cuts` are right and how many `false_cuts`, and the sizes of the `missed` jumps, in px."""
    homographies = truth["homographies"]
    jumps = np.flatnonzero(np.diff(truth.get("taken", np.arange(len(homographies)))) != 1) + 1  # the frames after them
    shape = (int(truth["frame_shape"][0]), int(truth["frame_shape"][1]))
    sizes = middles(inverse(homographies[jumps]) @ homographies[jumps - 1], shape) - middles(np.eye(3)[None], shape)
    right = [cut for cut in cuts if np.any(np.abs(jumps - cut) <= NEAR)]
    missed = [
        float(size)
        for jump, size in zip(jumps, np.linalg.norm(sizes, axis=-1), strict=True)
        if size >= SMALLEST_PX and not any(abs(cut - jump) <= NEAR for cut in cuts)
    ]
    return {"cuts": len(right), "false_cuts": len(cuts) - len(right), "missed": missed}


def row_of_cuts(name: str, results: Sequence[Result]) -> Sequence[object]:
    """Return the cells of a row of the table of cuts."""
    ended = [each for each in results if "cuts" in each]
    found, false = (sum(each[key] for each in ended) for key in ("cuts", "false_cuts"))
    missed = ", ".join(f"{size:.1f}" for each in ended for size in each["missed"]) or "-"
    return name, len(ended), found, missed, false, f"{np.mean([each['mean_px'] for each in ended]):.3f}"


def figures_of(estimated: dict[str, np.ndarray], truth: Truth) -> Result:
    """Compare the trajectory of a run, and the errors that it claims, with the truth.

    Args:
        estimated: content of `trajectory.npz`.
        truth: of the capture.

    Returns:
        `mean_px`, `max_px` and `rms_px` of the corner errors of the located frames, the mean `std_px`, the shares
        `within_2` and `within_3` of the frames whose error is at most 2 and 3 of their std_px, and the share `located`.
        Nothing if the run took the frames for others than they are.
    """
    if len(estimated["homographies"]) != len(truth.homographies) or tuple(estimated["frame_shape"]) != truth.frame_shape:
        return {}
    located = estimated["located"].astype(bool)
    score = corner_errors(estimated["homographies"], truth.homographies, truth.frame_shape, located)
    errors, std = score.errors_px[located], estimated["std_px"][located]
    return {
        "mean_px": score.mean_px,
        "max_px": score.max_px,
        "rms_px": float(np.sqrt(np.mean(errors**2))),
        "std_px": float(np.mean(std)),
        "within_2": float(np.mean(errors <= 2 * std)),
        "within_3": float(np.mean(errors <= 3 * std)),
        "located": score.located_share,
    }


def figures_of_run(folder: Path, truth: Truth) -> Result:
    """Return the figures of a run, of where the corners of frames lie through the lens that it has found."""
    found = load_run_trajectory(folder)
    estimated = {name: getattr(found, name) for name in ("frame_shape", "located", "std_px")}
    return figures_of(estimated | {"homographies": found.corner_homographies}, truth)


def scored(cube: Path, more: Callable[[Path], Result] = lambda _: {}, **sections: Any) -> Result:
    """Run a capture with a source alone, and one thread; return its scores, and more of its folder, or why there are none.

    The spec may have other `sections`.
    """
    result: Result = {"exit_code": 0, "message": "", "verdict": None}
    with passing() as study:
        start = time.process_time()
        try:
            folder = study.run("run", packed(cube, run={"threads": 1}, **sections))
        except Exception as error:  # a defect of photonpano is a result too
            code, message = (1, str(error)) if isinstance(error, PhotonpanoError) else (None, repr(error))
            return result | {"exit_code": code, "message": message, "cpu_s": time.process_time() - start}
        result["cpu_s"] = time.process_time() - start
        record = record_of(folder)
        result |= {"verdict": record.get("verdict"), "warnings": list(record["warnings"]), "decisions": record["decisions"]}
        result["cuts"] = sum(each["what"] == "cut" for each in record["decisions"])
        return result | figures_of_run(folder, load_truth(truth_path(cube))) | more(folder)


def remembered(file: Path, size: Size) -> list[Result]:
    """Read the results of an earlier call."""
    if not file.exists():
        return []
    kept = json.loads(file.read_text(encoding="utf-8"))
    if tuple(kept["frame_shape"]) != size.frame_shape:
        raise SystemExit(f"{file} holds results of frames of {kept['frame_shape']} px; choose another --output")
    return list(kept["results"])


def write(file: Path, results: Sequence[Result], size: Size) -> None:
    """Write the results, and the table beside them."""
    part = file.with_suffix(".part")
    part.write_text(json.dumps({"frame_shape": size.frame_shape, "results": list(results)}, indent=1), encoding="utf-8")
    part.replace(file)
    file.with_suffix(".md").write_text(table(results) + "\n", encoding="utf-8")


def measured_with_progress(task: tuple[str, int], size: Size, photographs: Sequence[Path]) -> Result:
    """Measure a row and a seed."""
    name, seed = task
    result = measured(before_photographs(photographs, size)[name], name, seed, size)
    scored = "mean_px" in result
    error = f"{result['mean_px']:.3f} px, claims {result['std_px']:.3f}" if scored else result["message"].partition("\n")[0]
    print(f"{name}, seed {seed}: {status(result)}, {error}, {result['seconds']:.0f} s", flush=True)
    return result


def main(
    rows: Sequence[str] = ("",),
    seeds: int = 1,
    small: bool = False,
    jobs: int = 1,
    cuts: bool = False,
    photographs: Path | None = None,
    output: Path = Path("trust.json"),
) -> None:
    """Measure what is missing in the file of results."""
    if cuts:
        head = ("Capture", "Runs", "Jumps found", "Missed, px", "False cuts", "Mean error, px")
        names = chosen(rows, CUT_ROWS)
        every = ((name, [measured(CUT_ROWS[name], name, seed, TINY) for seed in range(seeds)]) for name in names)
        table_of(head, (row_of_cuts(*each) for each in every))
        return
    size = SMALL if small else FULL
    results = remembered(output, size)
    done = {(result["row"], result["seed"]) for result in results}
    files = sorted(photographs.rglob("*.jpg")) if photographs else []
    names = chosen(rows, before_photographs(files, size))
    tasks = [(name, seed) for seed in range(seeds) for name in names if (name, seed) not in done]
    measure = partial(measured_with_progress, size=size, photographs=files)
    output.parent.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        for result in (pool.map if jobs > 1 else map)(measure, tasks):
            results.append(result)
            write(output, results, size)
    print(table(results))


if __name__ == "__main__":
    command(main)
