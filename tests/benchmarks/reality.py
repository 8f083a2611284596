"""Measure runs of what real places do at once: people, boards, lamps, cuts, rests and little light, with all defaults.

    python tests/benchmarks/reality.py [--only apart people] [--photographs FOLDER] [--frames 6000] [--captures FOLDER]
        [--jobs 1] [--output reality.json]

A camera of 254x496 px turns by 60 degrees before a street at infinity, with a lens and a sensor that have their faults; `CASES`
says what else each capture has. Photographs in the folder are scenes of further captures, along a pan. The spec of a run has a
source alone, and one thread. Errors are those of the scene through the lens that the run has found: of its true rotations.

`--only` takes names of captures, or words in them. Captures stay in their folder (up to 250 MB each), and results in the JSON
file, so that an interrupted benchmark continues; the table is beside it.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from harness import Study, chosen, command, packed, rendered, simulator
from harness import table as table_of
from trust import scored
from trust_scores import is_honest, reasons, status

from photonpano import evaluate, load_panorama, open_source, parse_spec
from photonpano.api.run_folders import opened_run
from photonpano.capture import capture_of, with_background
from photonpano.capture.writing import truth_path
from photonpano.corrections import divided_by, estimate_vignette
from photonpano.corrections.movers import showing
from photonpano.evaluation import image_score, load_run_trajectory, load_truth, true_panorama, white_flux
from photonpano.geometry import FrameTrajectory

SHAPE, HEIGHT = (254, 496), 900
BASE: dict[str, Any] = {
    "flux": 0.1,
    "frame_shape": list(SHAPE),
    "focal_length_px": 430.0,
    "distortion": {"k1": -0.11, "k2": 0.03},
    "lens": {"vignette": 0.3},
    "sensor": {"dark_rate": 0.002, "hot_fraction": 0.008, "gain_std": 0.05},
    "seed": 1,
}
TURN = {"kind": "turn", "degrees": 60, "pitch_wobble_deg": 2, "roll_wobble_deg": 1, "wobbles": 1.5}
SPOT = {"frequency_hz": 100, "depth": 0.5, "radius": 0.15}
LAMPS = {"lamps": [{**SPOT, "at": [0.5, 0.5]}, {**SPOT, "at": [0.62, 0.5], "phase_deg": 120}]}
TREMOR = {"shake": {"rms_px": 1.5, "frequencies_hz": [25, 90]}}
STEP = {"travel_m": [0.12, 0, 0.03]}
RESTS = {"rests": [[0, 0.1], [0.45, 0.55], [0.9, 1]]}
OVERLAP = {"jumps": [{"at": 0.5, "by": -0.4}]}
APART = {"degrees": 180, "wobbles": 4, "jumps": [{"at": 0.5, "by": 0.6}]}
FAULTY = {"sensor": BASE["sensor"] | {"afterpulsing": 0.01, "crosstalk": 0.005, "dead_time": 0.05}}
START, MIDDLE, END = ({"shutter": [part]} for part in ([0, 0.08], [0.45, 0.5], [0.92, 1]))
DARK = {"flux": 0.04}


def people(share: float, **keys: float) -> dict[str, Any]:
    """Return the key of people: one for each 8 % of the pixels, who walk slowly unless something else is given."""
    return {"people": {"share": share, "number": max(2, round(share / 0.08)), "speed_px": 0.05, **keys}}


def boards(share: float) -> dict[str, Any]:
    """Return the key of boards."""
    return {"clutter": {"share": share}}


def street(seed: int) -> dict[str, Any]:
    """Return the key of another street."""
    return {"scene": {"kind": "street", "seed": seed}}


FAST, STAND = {"speed_px": 0.4}, {"speed_px": 0.15, "pauses": 0.5}
CASES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "plain": ({}, {}),
    "people 10 slow, tremor": (TREMOR, people(0.10)),
    "people 10 fast, lamps": ({}, people(0.10, **FAST) | LAMPS),
    "people 25 slow, rests": (RESTS, people(0.25)),
    "people 25 fast, dark": ({}, people(0.25, **FAST) | DARK),
    "people 25 stand, street 1": ({}, people(0.25, **STAND) | street(1)),
    "people 40 slow, tremor": (TREMOR, people(0.40)),
    "people 40 fast, street 2": ({}, people(0.40, **FAST) | street(2)),
    "people 40 stand": ({}, people(0.40, **STAND)),
    "boards 10, tremor": (STEP | TREMOR, boards(0.10)),
    "boards 25, rests": (STEP | RESTS, boards(0.25)),
    "boards 25, lamps, dark": (STEP, boards(0.25) | LAMPS | DARK),
    "boards 40": (STEP, boards(0.40)),
    "boards 40, street 1, lamps": (STEP, boards(0.40) | street(1) | LAMPS),
    "people 10, boards 10, sensor": (STEP, people(0.10) | boards(0.10) | FAULTY),
    "people 14, boards 25, lamps, dark": (STEP, people(0.14) | boards(0.25) | LAMPS | DARK),
    "people 25, boards 25, tremor": (STEP | TREMOR, people(0.25, **FAST) | boards(0.25)),
    "people 25, boards 25, rests, street 3": (STEP | RESTS, people(0.25, **STAND) | boards(0.25) | street(3)),
    "shutter at first, rests, people 10": (RESTS, START | people(0.10)),
    "shutter at last, tremor, boards 10": (STEP | TREMOR, END | boards(0.10)),
    "shutter in the middle, people 10, lamps": ({}, MIDDLE | people(0.10, **FAST) | LAMPS),
    "shutter in the middle, rests, dark": (RESTS, MIDDLE | DARK),
    "overlap": (OVERLAP, {}),
    "overlap, people 25, lamps": (OVERLAP, people(0.25) | LAMPS),
    "overlap, boards 25, rests": (OVERLAP | STEP | {"rests": [[0.2, 0.3], [0.7, 0.8]]}, boards(0.25)),
    "overlap, shutter in the middle, people 10": (OVERLAP, MIDDLE | people(0.10)),
    "apart": (APART, {}),
    "apart, people 10, tremor": (APART | TREMOR, people(0.10)),
    "apart, people 25, dark, street 2": (APART, people(0.25, **FAST) | DARK | street(2)),
    "sensor, tremor, lamps, street 4": (TREMOR, FAULTY | LAMPS | street(4)),
}
"""Of each capture by its name: keys of the path, and others."""
FEWEST_FRAMES = 20  # that show the background of a place where ghosts are looked for
HEAD = ("Capture", "Mean (max)", "Claimed", "Within 2 / 3", "Located", "Cuts", "Ghosts", "Honest", "CPU s", "Says")


def settings(name: str, photographs: Path) -> dict[str, Any]:
    """Return what the simulator is told of a capture, but for the number of its frames."""
    if name in CASES:
        path, others = CASES[name]
        return BASE | {"path": TURN | path} | others
    photo = next(photographs.rglob(f"{name.removeprefix('photo ')}.jpg"))
    height, width = cv2.imread(str(photo)).shape[:2]
    scene = {"kind": "photo", "file": str(photo.resolve()), "width": round(width * HEIGHT / height)}
    return BASE | {"scene": scene, "path": {"kind": "pan", "length_px": 150, **STEP, **TREMOR}} | people(0.14) | boards(0.10)


def measured(name: str, photographs: Path, frames: int, captures: Path) -> dict[str, Any]:
    """Simulate a capture if it is not there, run it, and return the scores."""
    study, given = Study(captures), settings(name, photographs) | {"n_frames": frames}
    cube = study.capture(name.replace(",", ""), simulator(**given))
    bare = {key: value for key, value in given.items() if key not in ("people", "clutter")}
    if bare == given:
        return {"row": name, "frames": frames, **scored(cube)}
    return {"row": name, "frames": frames, **scored(cube, partial(ghosts, cube, study.capture("bare", simulator(**bare))))}


def ghosts(cube: Path, bare: Path, folder: Path) -> dict[str, float]:
    """Return by how many dB the panorama is worse than that of the capture of the background alone, where the run has seen it.

    The same photons are left out of both, and both have the motion of the run.
    """
    found, truth, panorama = load_run_trajectory(folder), load_truth(truth_path(cube)), load_panorama(folder)
    canvas, motion = found.canvas_of(panorama.flux.shape[:2]), FrameTrajectory(found.homographies)
    with opened_run(folder) as run, open_source(parse_spec(packed(bare, corrections=[]))) as other:
        alone = replace(capture_of(run.source), steps=capture_of(run.capture).steps, source=capture_of(other).source)
        vignette = estimate_vignette(with_background(alone, None), motion)
        shown, *_ = showing(alone if vignette is None else divided_by(alone, vignette), motion, found.camera, "hide")
        oracle, seen = rendered(shown, motion, canvas), rendered(run.source, motion, canvas).weight >= FEWEST_FRAMES
    around = truth.turn if truth.around else None
    alignment = evaluate(folder, truth_path(cube), oracle=False).trajectory.alignment
    assert truth.scene is not None
    scene = true_panorama(truth.scene, canvas, alignment, None if around is None else around.camera.matrix)
    best, own = (image_score(each.flux, scene, seen, white_flux(truth.scene)).psnr_db for each in (oracle, panorama))
    return {"ghosts_db": best - own}


def row(result: dict[str, Any]) -> Iterator[str]:
    """Yield the cells of a row."""
    yield result["row"]
    if "mean_px" in result:
        yield f"{result['mean_px']:.3f} ({result['max_px']:.2f})"
        yield f"{result['std_px']:.3f}"
        yield f"{result['within_2']:.0%} / {result['within_3']:.0%}"
        yield from (f"{result['located']:.0%}", str(result["cuts"]))
        yield f"{result['ghosts_db']:.2f} dB" if "ghosts_db" in result else "-"
    else:
        yield from "------"
    yield "yes" if is_honest(result) else "no"
    yield f"{result['cpu_s']:.0f}"
    yield ": ".join([status(result), *(reason.splitlines()[0] for reason in reasons(result)[:1])])


def summary(results: Sequence[dict[str, Any]]) -> str:
    """Return the line below the table."""
    ended = [each for each in results if "mean_px" in each]
    means = [each["mean_px"] for each in ended] or [np.nan]
    trusted = sum(status(each) == "trusted" for each in ended)
    return (
        f"{len(ended)} of {len(results)} runs ended, {trusted} of them trusted, with a mean error of {np.median(means):.3f} px "
        f"(median) and {max(means):.2f} px (worst). {sum(map(is_honest, results))} are honest. "
        f"{sum(each['cpu_s'] for each in results):.0f} CPU s."
    )


def main(
    only: Sequence[str] = ("",),
    photographs: Path = Path("photographs"),
    frames: int = 6000,
    captures: Path = Path("runs/reality"),
    jobs: int = 1,
    output: Path = Path("reality.json"),
) -> None:
    """Measure what is missing in the file of results."""
    for library in ("OMP", "OPENBLAS", "MKL"):  # a processor for each job
        os.environ[f"{library}_NUM_THREADS"] = "1"
    names = chosen(only, [*CASES, *(f"photo {file.stem}" for file in sorted(photographs.rglob("*.jpg")))])
    results: list[dict[str, Any]] = json.loads(output.read_text()) if output.exists() else []
    known = {each["row"] for each in results if each["frames"] == frames}
    captures.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(jobs, get_context("spawn"), max_tasks_per_child=1) as pool:

        def rows() -> Iterator[Iterator[str]]:
            yield from map(row, results)
            measure = partial(measured, photographs=photographs, frames=frames, captures=captures)
            for result in pool.map(measure, [name for name in names if name not in known]):
                results.append(result)
                output.write_text(json.dumps(results, indent=1))
                yield row(result)

        lines = [*table_of(HEAD, rows()), "", summary(results)]
    print(lines[-1])
    output.with_suffix(".md").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    command(main)
