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
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np

from photonpano import PhotonpanoError, SpecError, evaluate, parse_spec, run, simulate
from photonpano.evaluation import Truth, corner_errors, load_truth

Settings: TypeAlias = dict[str, Any]
FRAME_RATE_HZ = 96_800
WITHIN_2, WITHIN_3, WIDEST = 0.95, 0.99, 3.0
"""What makes a trusted run honest: shares of the frames within 2 and 3 std_px, and the mean std_px over the rms error."""


@dataclass(frozen=True)
class Size:
    """How large the captures are.

    Attributes:
        frame_shape: (height, width) of a frame, in px.
        long: number of frames, and length of the path in px, of captures along a random spline.
    """

    frame_shape: tuple[int, int]
    long: tuple[int, float]


FULL, SMALL = Size((254, 496), (10_000, 1500.0)), Size((128, 192), (4000, 600.0))


@dataclass(frozen=True)
class Row:
    """A kind of capture.

    Attributes:
        base: name of the undisturbed capture, of `bases`.
        changes: of the size of frames, what else the simulator is told.
        spec: sections of the run's spec, where they are not the defaults.
        picture: paints the scene with a seed, where it is not the street: uint8 or uint16.
        repack: writes the frames of a packed capture as somebody else might have.
    """

    base: str
    changes: Callable[[Size], Settings] = lambda _: {}
    spec: Settings = field(default_factory=dict)
    picture: Callable[[int], np.ndarray] | None = None
    repack: Callable[[np.ndarray, int], np.ndarray] | None = None


def bases(size: Size) -> dict[str, Settings]:
    """Return the captures that nothing disturbs."""
    n_frames, length_px = size.long
    pan = {"kind": "pan", "angle_deg": 17}
    spline = {"kind": "random-spline", "length_px": length_px}
    return {
        "clean pan": {"path": {**pan, "length_px": 300}, "n_frames": 2000, "flux": 0.5},
        "clean pan, flux 0.01": {"path": {**pan, "length_px": 150}, "n_frames": 2000, "flux": 0.01},
        "pan of 1.5 px a frame": {"path": {**pan, "angle_deg": 10, "length_px": 1500}, "n_frames": 1000, "flux": 0.5},
        "clean, flux 0.5": {"path": spline, "n_frames": n_frames, "flux": 0.5},
        "clean, flux 0.1": {"path": spline, "n_frames": n_frames, "flux": 0.1},
        "clean, flux 0.02": {"path": spline, "n_frames": n_frames, "flux": 0.02},
        "clean tutorial": {"path": {**spline, "length_px": 300}, "n_frames": 3000, "flux": 0.2},
    }


def shaken(size: Size, base: str, rms_px: float, frequencies_hz: Sequence[float]) -> Settings:
    """Return a base with tremor."""
    shake = {"rms_px": rms_px, "roll_rms_deg": 0, "frequencies_hz": list(frequencies_hz)}
    return {"path": bases(size)[base]["path"] | {"shake": shake}}


def standing(share: float) -> Settings:
    """Return an object that stands in the frame and covers a share of it."""
    return {"objects": [{"size": [share**0.5] * 2, "seed": 1}]}


def moving(share: float, size: Size) -> Settings:
    """Return an object that covers a share of the frame, and moves through a fifth of it, against the scene."""
    travel = 0.2 * size.frame_shape[1]
    moves = [travel / 2000, travel / 6000]
    return {"objects": [{"size": [share**0.5] * 2, "at": [0.4, 0.45], "moves_px": moves, "seed": 1}]}


def crossing(size: Size) -> Settings:
    """Return an object as high as the frame and half as wide, which crosses it from left to right."""
    return {"objects": [{"size": [0.5, 1.0], "at": [-0.25, 0.5], "moves_px": [1.5 * size.frame_shape[1] / 2000, 0], "seed": 1}]}


def panels(seed: int) -> np.ndarray:
    """Paint a facade of equal panels, which differ by 2 % only."""
    rng = np.random.default_rng(seed)
    panel = np.full((80, 60), 0.7)
    panel[8:60, 8:52] = 0.15
    panel[12:56, 12:29] = 0.3 + 0.1 * rng.random()
    panel[12:56, 32:48] = 0.5
    facade = np.tile(panel, (18, 35))
    noise = cv2.GaussianBlur(rng.standard_normal(facade.shape), (0, 0), 3)
    return np.uint8(255 * np.clip(facade * (1 + 0.02 * noise / noise.std()), 0, 1))


def checkerboard(_: int) -> np.ndarray:
    """Paint a board of squares of 8 px."""
    return np.uint8(200 * ((np.indices((1365, 2048)) // 8).sum(axis=0) % 2) + 30)


def stripes(_: int) -> np.ndarray:
    """Paint upright stripes of 6 px."""
    return np.uint8(200 * (np.indices((1365, 2048))[1] // 6 % 2) + 30)


def changed(settings: Settings) -> Callable[[Size], Settings]:
    """Return changes that do not depend on the size."""
    return lambda _: settings


PAN, DIM, LONG = "clean pan", "clean pan, flux 0.01", "clean, flux 0.1"
ROWS: dict[str, Row] = {
    **{name: Row(name) for name in bases(FULL)},
    "tremor of 1 px": Row(LONG, lambda size: shaken(size, LONG, 1, (223, 590, 1270))),
    "tutorial": Row("clean tutorial", lambda size: shaken(size, "clean tutorial", 2, (25, 120, 400))),
    "vibration of 3 px": Row(PAN, lambda size: shaken(size, PAN, 3, (1000,))),
    "strong shake": Row(PAN, lambda size: shaken(size, PAN, 10, (25, 90, 210))),
    "hot pixels 5 %": Row(DIM, changed({"sensor": {"hot_fraction": 0.05, "dark_rate": 0.001}})),
    "hot pixels 20 %": Row(DIM, changed({"sensor": {"hot_fraction": 0.2, "dark_rate": 0.001}})),
    "hot pixels, lens covered": Row(DIM, changed({"flux": 1e-9, "sensor": {"hot_fraction": 0.05, "dark_rate": 0.001}})),
    "gain 5 %, dirt": Row(PAN, changed({"sensor": {"gain_std": 0.05, "dirt": {}}})),
    **{f"window over {share:.0%}": Row(PAN, changed(standing(share))) for share in (0.3, 0.5, 0.7, 0.9)},
    **{f"lens k1 {k1:.1%}": Row(PAN, changed({"lens": {"k1": k1}})) for k1 in (-0.005, -0.01, -0.03, -0.1)},
    **{f"vignette {loss:.0%}": Row(PAN, changed({"lens": {"vignette": loss}})) for loss in (0.6, 0.8)},
    **{f"{n} frames missing": Row(PAN, changed({"drops": [{"at": 1000, "frames": n}]})) for n in (20, 50, 200)},
    "jump of 60 px behind black frames": Row(
        PAN,
        changed({"objects": [{"size": [2, 2], "flux": 0, "first": 800, "frames": 450}], "drops": [{"at": 825, "frames": 400}]}),
    ),
    "50 frames doubled": Row(PAN, changed({"repeats": [{"at": at, "frames": 50} for at in (600, 1400)]})),
    "every tenth frame doubled": Row(PAN, changed({"repeats": [{"at": at} for at in range(5, 2000, 10)]})),
    **{
        f"moving object over {share:.0%}": Row(PAN, partial(moving, share))  # the size comes last
        for share in (0.15, 0.3, 0.5, 0.6, 0.7)
    },
    "object that crosses the frame": Row(PAN, crossing),
    "light that falls to an eighth": Row(PAN, changed({"drift": 0.125})),
    "two layers with parallax": Row(
        PAN,
        changed({"objects": [{"size": [4, 0.5], "at": [0.5, 0.75], "follows": 1.5, "seed": 1}]}),
        spec={"resample": {"with": {"group_size": 50}}},
    ),
    "panels that repeat": Row(LONG, lambda size: shaken(size, LONG, 0.5, (60, 223, 590, 1270)) | {"flux": 0.2}, picture=panels),
    "checkerboard": Row(PAN, picture=checkerboard),
    "stripes": Row(PAN, picture=stripes),
    "unpacked zeros and ones": Row(PAN, repack=lambda packed, width: np.unpackbits(packed, axis=-1, count=width)),
    "lowest bit first": Row(
        PAN, repack=lambda packed, _: np.packbits(np.unpackbits(packed, axis=-1), axis=-1, bitorder="little")
    ),
    "packed along the height": Row(
        PAN, repack=lambda packed, width: np.packbits(np.unpackbits(packed, axis=-1, count=width), axis=1)
    ),
}
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
