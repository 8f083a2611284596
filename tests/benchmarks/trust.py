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
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
from harness import RATE_HZ, Study, chosen, command, middles, packed, passing, record_of, scores_of, simulator
from harness import table as table_of
from joint_bound import lens_at_corners
from trust_captures import CUT_ROWS, FULL, ROWS, SMALL, STREET_SHAPE, TINY, Row, Size, bases, before_photographs

from photonpano import InputError, PhotonpanoError, SpecError
from photonpano.capture.writing import truth_path
from photonpano.evaluation import Truth, corner_errors, load_run_trajectory, load_truth
from photonpano.geometry import inverse

WITHIN_2, WITHIN_3, WIDEST = 0.95, 0.99, 3.0
"""What makes a trusted run honest: shares of the frames within 2 and 3 std_px, and the mean std_px over the rms error."""
# A run is wrong if its mean error exceeds this, and its mean std_px as many times; or if a smaller share is within 2 std_px.
WRONG_PX, WRONG_TIMES, WRONG_WITHIN_2 = 0.3, 3.0, 0.9
NEAR = 2  # frames between a jump and a cut that counts as found
SMALLEST_PX = 1.0  # smaller jumps are not counted as missed
CAUSES: dict[str, tuple[str, ...]] = {
    "tremor": ("within groups",),
    "tutorial": ("within groups",),
    "vibration": ("within groups",),
    "shake": ("within groups",),
    "shaking": ("shake",),
    **dict.fromkeys(("acceleration", "jerks", "kicks", "taps", "sine"), ("within groups", "shake", "expected error")),
    **dict.fromkeys(("sudden stop", "drops"), ("within groups", "shake", "jump", "missing")),
    "horizon": ("one direction", "repeat"),
    **dict.fromkeys(("afterpulsing", "crosstalk"), ("does not explain the photons",)),
    "half black": ("expected error",),
    "turn": ("lens", "expected error"),
    "in reverse": (),
    "gain 5 %": ("the sensor", "still", "a sensor"),
    "out of order": ("order",),
    "any order": ("order",),
    "every frame doubled": ("copies", "doubled"),
    "first ": ("frames", "short"),
    "sensitivity": ("the sensor",),
    "lamp": ("light",),
    "night": ("expected error", "no texture", "light"),
    "travel": ("depth", "turn", "near"),
    "people": ("move by themselves",),
    "shutter": ("jump", "show nothing"),
    "nearer": ("depth", "near"),
    "ends without texture": ("expected error", "one direction"),
    "pan of 1.5": ("within groups", "expected error", "contradict"),
    "hot pixels": ("single pixels", "still"),
    "dirt": ("the sensor", "still"),
    "window": ("the sensor", "still", "stand"),
    "lens k1": ("lens",),
    "vignette": ("the sensor",),
    "missing": ("missing",),
    "jump": ("missing", "jump"),
    "doubled": ("doubled",),
    "object": ("move by themselves",),
    "light": ("light",),
    "parallax": ("depth",),
    "repeat": ("repeat",),
    "checkerboard": ("repeat",),
    "stripes": ("repeat", "no texture"),
    "unpacked": ("not packed",),
    "lowest bit": ("bit",),
    "along the height": ("axis", "height", "packed"),
}
"""For words in the names of rows: words of which a right reason of a doubt or a refusal has one."""
Result: TypeAlias = dict[str, Any]  # what was measured of one run; see `measured`


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
    lens = np.eye(3) if found.camera is None else lens_at_corners(found.camera, found.frame_shape)
    estimated = {name: getattr(found, name) for name in ("frame_shape", "located", "std_px")}
    return figures_of(estimated | {"homographies": found.homographies @ lens}, truth)


def scored(cube: Path, more: Callable[[Path], Result] = lambda _: {}) -> Result:
    """Run a capture with a source alone, and one thread; return its scores, and more of its folder, or why there are none."""
    result: Result = {"exit_code": 0, "message": "", "verdict": None}
    with passing() as study:
        start = time.process_time()
        try:
            folder = study.run("run", packed(cube, run={"threads": 1}))
        except Exception as error:  # a defect of photonpano is a result too
            code, message = (1, str(error)) if isinstance(error, PhotonpanoError) else (None, repr(error))
            return result | {"exit_code": code, "message": message, "cpu_s": time.process_time() - start}
        result["cpu_s"] = time.process_time() - start
        record = record_of(folder)
        result |= {"verdict": record.get("verdict"), "warnings": list(record["warnings"]), "decisions": record["decisions"]}
        result["cuts"] = sum(each["what"] == "cut" for each in record["decisions"])
        return result | figures_of_run(folder, load_truth(truth_path(cube))) | more(folder)


def status(result: Result) -> str:
    """Return what a run says of itself: trusted, doubtful, refused, crashed, or - without a verdict."""
    if result["exit_code"] is None:
        return "crashed"
    if result["exit_code"]:
        return "refused"
    return result["verdict"]["status"] if result["verdict"] else "-"


def is_honest(result: Result) -> bool:
    """Return whether a run that is not doubtful or refused claims the errors that it has."""
    says = status(result)
    if says in ("doubtful", "refused", "crashed") or "mean_px" not in result:
        return says in ("doubtful", "refused")
    narrow = result["std_px"] <= WIDEST * result["rms_px"]
    return bool(result["within_2"] >= WITHIN_2 and result["within_3"] >= WITHIN_3 and narrow)


def reasons(result: Result) -> list[str]:
    """Return why a run is doubtful, or was refused."""
    found = [str(reason.get("what", reason)) for reason in (result["verdict"] or {}).get("reasons", ())]
    return [*found, *filter(None, [result["message"]])]


def names_its_cause(result: Result) -> bool:
    """Return whether one of the reasons of a run is the right one: see `CAUSES`."""
    words = [word for part, of_part in CAUSES.items() if part in result["row"] for word in of_part]
    return any(word in reason for reason in reasons(result) for word in words)


def table(results: Sequence[Result]) -> str:
    """Return one row of Markdown for each kind of capture, over its seeds."""
    header = (
        "| Capture | Mean (max) | Claimed | Within 2 / 3 std | std / rms | / clean | Below oracle | Says | Right reason "
        "| Honest | Time |"
    )
    lines = [header, "| --- " * 11 + "|"]
    for name in dict.fromkeys(result["row"] for result in results):
        of_row = [result for result in results if result["row"] == name]
        if of_row:
            lines.append(f"| {name} | {' | '.join(cells(of_row, results))} |")
    summary = " ".join(summary_of(results))
    return "\n".join([*lines, "", summary, "", *notes(results)])


def summary_of(results: Sequence[Result]) -> Iterator[str]:
    """Yield sentences on all runs."""
    doubts = doubted(results)
    right = f"{sum(map(names_its_cause, doubts))} of {len(doubts)} that are doubtful or refused name the cause"
    yield f"{sum(map(is_honest, results))} of {len(results)} runs are honest; {right}."
    scored = [result for result in results if "mean_px" in result]
    for says in ("trusted", "doubtful"):
        said = [result for result in scored if status(result) == says]
        if said:
            shares = " / ".join(f"{np.mean([each[key] for each in said]):.1%}" for key in ("within_2", "within_3"))
            ratio = np.median([each["std_px"] / each["rms_px"] for each in said])
            wrong = [result["row"] for result in said if is_wrong(result)]
            named = f" ({', '.join(wrong)})" if wrong and says == "trusted" else ""
            within = f"{shares} of their frames are within 2 / 3 std_px, which is {ratio:.2f} times the rms error (median)"
            yield f"{len(said)} are {says}, {len(wrong)} of them wrong{named}; {within}."


def is_wrong(result: Result) -> bool:
    """Return whether errors are far larger than those that a run claims."""
    far = result["mean_px"] > max(WRONG_PX, WRONG_TIMES * result["std_px"])
    return bool(far or result["within_2"] < WRONG_WITHIN_2)


def doubted(results: Sequence[Result]) -> list[Result]:
    """Return the runs that are doubtful or were refused."""
    return [result for result in results if status(result) in ("doubtful", "refused")]


def cells(of_row: Sequence[Result], results: Sequence[Result]) -> Iterator[str]:
    """Yield the cells of a row: means over its seeds, the largest error, and the smallest shares."""
    scored = [result for result in of_row if "mean_px" in result]
    if scored:
        mean_px, std_px, rms_px = (np.mean([each[key] for each in scored]) for key in ("mean_px", "std_px", "rms_px"))
        yield f"{mean_px:.3f} ({max(each['max_px'] for each in scored):.2f})"
        yield f"{std_px:.3f}"
        yield " / ".join(f"{min(each[key] for each in scored):.0%}" for key in ("within_2", "within_3"))
        yield f"{std_px / rms_px:.2f}"
        yield of_clean(scored, results)
        losses = [each["below_oracle_db"] for each in scored if each.get("below_oracle_db") is not None]
        yield f"{np.mean(losses):.2f} dB" if losses else "-"
    else:
        yield from "------"
    says = [status(each) for each in of_row]
    yield ", ".join(word if len(says) == 1 else f"{says.count(word)} {word}" for word in dict.fromkeys(says))
    doubts = doubted(of_row)
    yield f"{sum(map(names_its_cause, doubts))} of {len(doubts)}" if doubts else "-"
    yield f"{sum(map(is_honest, of_row))} of {len(of_row)}"
    yield f"{np.mean([each['seconds'] for each in of_row]):.0f} s"


def of_clean(scored: Sequence[Result], results: Sequence[Result]) -> str:
    """Return the error of a row divided by that of its undisturbed captures of the same seeds."""
    base = ROWS[scored[0]["row"].rpartition(": ")[2]].base
    clean = {each["seed"]: each["mean_px"] for each in results if each["row"] == base and "mean_px" in each}
    ratios = [each["mean_px"] / clean[each["seed"]] for each in scored if each["seed"] in clean]
    return f"{np.mean(ratios):.2f}" if ratios and scored[0]["row"] != base else "-"


def notes(results: Sequence[Result]) -> Iterator[str]:
    """Yield, for each run, what it said: reasons of a doubt or a refusal, and warnings."""
    for result in results:
        said = [each.splitlines()[0] for each in (*reasons(result), *result["warnings"])]
        if said:
            yield f"- {result['row']}, seed {result['seed']}: {'; '.join(said)}"


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
