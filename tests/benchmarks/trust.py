"""Measure whether runs are honest: the errors of difficult captures against what the runs claim, with all defaults.

    python tests/benchmarks/trust.py [--rows tremor window] [--seeds 20] [--small] [--jobs 1] [--output trust.json]

Each row is a kind of capture, simulated with a known truth. `--rows` keeps those whose names contain one of the words. The
results are kept in the JSON file, so that an interrupted benchmark continues; the table is written beside it as Markdown.
`--small` takes frames of 128x192 px and at most 4,000 of them: a quarter of an hour on two cores.

A run is honest if it was refused, if its verdict is "doubtful", or if 95 % of its frames are within 2 `std_px` and 99 % within
3, and the mean `std_px` is at most 3 times the root mean square of the errors. A run without a verdict counts as trusted.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
from trust_captures import FULL, ROWS, SMALL, Row, Size, bases

from photonpano import PhotonpanoError, SpecError, evaluate, parse_spec, run, simulate
from photonpano.evaluation import Truth, corner_errors, load_truth

FRAME_RATE_HZ = 96_800
WITHIN_2, WITHIN_3, WIDEST = 0.95, 0.99, 3.0
"""What makes a trusted run honest: shares of the frames within 2 and 3 std_px, and the mean std_px over the rms error."""
CAUSES: dict[str, tuple[str, ...]] = {
    "tremor": ("within groups",),
    "tutorial": ("within groups",),
    "vibration": ("within groups",),
    "shake": ("within groups",),
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
Result: TypeAlias = dict[str, Any]
"""What was measured of one run; see `measured`."""


def simulated(row: Row, seed: int, size: Size, folder: Path) -> Path:
    """Write the capture of a row, with its truth beside it."""
    settings = bases(size)[row.base] | {"scene": {"kind": "street"}, "frame_shape": size.frame_shape} | row.changes(size)
    for section in ("scene", "path"):
        if settings[section]["kind"] in ("street", "random-spline"):
            settings[section] = settings[section] | {"seed": seed}
    if row.picture is not None:
        cv2.imwrite(str(folder / "scene.png"), row.picture(seed))
        settings["scene"] = {"kind": "photo", "file": str(folder / "scene.png")}
    source = {"use": "simulator", "with": settings | {"seed": seed, "frame_rate_hz": FRAME_RATE_HZ}}
    cube = simulate(parse_spec({"version": 1, "source": source}), folder / "capture.npy").path
    if row.repack is not None:
        np.save(cube, row.repack(np.load(cube), size.frame_shape[1]))
    return cube


def measured(name: str, seed: int, size: Size) -> Result:
    """Run one capture with all defaults, and score it.

    Returns:
        `exit_code`, `seconds`, `message` of an error, `warnings` and `verdict`; and, where the run ended well, the figures of
        `figures_of` and `below_oracle_db`.
    """
    row = ROWS[name]
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        cube = simulated(row, seed, size, folder)
        keys = {"path": str(cube), "frame_rate_hz": FRAME_RATE_HZ}
        document = {"version": 1, "source": {"use": "packed-npy", "with": keys}, **row.spec}
        start = time.perf_counter()
        result: Result = {"row": name, "seed": seed, "exit_code": 0, "message": "", "verdict": None, "warnings": []}
        try:
            done = run(parse_spec(document, output=folder / "run"))
        except PhotonpanoError as error:
            return result | {
                "exit_code": 2 if isinstance(error, SpecError) else 1,
                "message": str(error),
                "seconds": time.perf_counter() - start,
            }
        except Exception as error:  # a defect of photonpano is a result too
            return result | {"exit_code": None, "message": repr(error), "seconds": time.perf_counter() - start}
        result["seconds"] = time.perf_counter() - start
        result["warnings"] = list(done.record["warnings"])
        result["verdict"] = done.record.get("verdict")
        truth_file = cube.with_suffix(".truth.npz")
        with np.load(done.directory / "trajectory.npz") as found:
            result |= figures_of(dict(found), load_truth(truth_file))
        if "mean_px" in result:
            with suppress(PhotonpanoError, ValueError):
                result["below_oracle_db"] = evaluate(done.directory, truth_file).below_oracle_db
    return result


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
    for name in ROWS:
        of_row = [result for result in results if result["row"] == name]
        if of_row:
            lines.append(f"| {name} | {' | '.join(cells(of_row, results))} |")
    doubts = doubted(results)
    summary = (
        f"{sum(map(is_honest, results))} of {len(results)} runs are honest; "
        f"{sum(map(names_its_cause, doubts))} of {len(doubts)} that are doubtful or refused name the cause."
    )
    return "\n".join([*lines, "", summary, "", *notes(results)])


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
    base = ROWS[scored[0]["row"]].base
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


def measured_with_progress(task: tuple[str, int], size: Size) -> Result:
    """Measure a row and a seed."""
    result = measured(*task, size)
    error = (
        f"{result['mean_px']:.3f} px, claims {result['std_px']:.3f}"
        if "mean_px" in result
        else result["message"].partition("\n")[0]
    )
    print(f"{result['row']}, seed {result['seed']}: {status(result)}, {error}, {result['seconds']:.0f} s", flush=True)
    return result


def main() -> None:
    """Measure what is missing in the file of results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", nargs="+", default=[""], metavar="WORD", help="words in the names of the rows to measure")
    parser.add_argument("--seeds", type=int, default=1, help="number of seeds of each row")
    parser.add_argument("--small", action="store_true", help="small captures")
    parser.add_argument("--jobs", type=int, default=1, help="number of runs at once")
    parser.add_argument("--output", type=Path, default=Path("trust.json"), help="file of results; the table is beside it")
    arguments = parser.parse_args()
    size = SMALL if arguments.small else FULL
    results = remembered(arguments.output, size)
    done = {(result["row"], result["seed"]) for result in results}
    names = [name for name in ROWS if any(word in name for word in arguments.rows)]
    tasks = [(name, seed) for seed in range(arguments.seeds) for name in names if (name, seed) not in done]
    measure = partial(measured_with_progress, size=size)
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(arguments.jobs, get_context("spawn")) as pool:
        for result in (pool.map if arguments.jobs > 1 else map)(measure, tasks):
            results.append(result)
            write(arguments.output, results, size)
    print(table(results))


if __name__ == "__main__":
    main()
