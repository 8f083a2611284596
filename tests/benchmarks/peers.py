"""Measure other programs on the captures that photonpano gets: the tables and the picture of docs/explanation/peers.md.

    python tests/benchmarks/peers.py docs/explanation/peers.md [--quantaodometry FOLDER] [--cqbpy FOLDER] [--spano PROGRAM]
        [--quantaodometry-python PYTHON] [--cqbpy-python PYTHON] [--folder runs/peers] [--only flat dark] [--limit-s 900]

Each program runs in a process of its own, on one thread: see peer_programs.py. Those whose code is not given have a row that
says so. Motion is scored as `photonpano evaluate` does. A picture is aligned to the true scene by one homography, and its
brightness by one factor, whatever made it, and then scored as `photonpano evaluate` does. Results stay in the folder, motion
and picture as CAPTURE-PROGRAM.npz, so that an interrupted benchmark continues. Numbers go to peers.json beside the page.
"""

from __future__ import annotations

import datetime
import json
import os
import platform
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from harness import IMAGES, Study, chosen, command, simulator, table, write_tables
from numpy.typing import NDArray
from open.pictures import alignment_of

from photonpano.capture.writing import truth_path
from photonpano.evaluation import Truth, corner_errors, image_score, load_truth, true_panorama, white_flux
from photonpano.geometry import Canvas, corners, transform_points
from photonpano.photometry import tone_mapped

SHAPE, N_FRAMES = (128, 192), 2000
PAN = {"kind": "pan", "length_px": 150, "angle_deg": 20}
CAPTURES: dict[str, tuple[int, dict[str, Any]]] = {
    "flat": (100, {"path": {**PAN, "length_px": 60}}),
    "dark": (250, {"path": {**PAN, "length_px": 60}, "flux": 0.02, "sensor": {"dark_rate": 0.001}}),
    "darker": (400, {"path": {**PAN, "length_px": 60}, "flux": 0.005, "sensor": {"dark_rate": 0.00025}}),
    "fast": (50, {"path": {"kind": "random-spline", "length_px": 500}}),
    "trembling": (50, {"path": {"kind": "hand-shake", "shake": {"rms_px": 5.0}}}),
    "lens": (100, {"path": PAN, "lens": {"k1": -0.05}}),
    "people": (100, {"path": PAN, "people": {"share": 0.1, "number": 2, "speed_px": 0.08}}),
}
"""Frames in a group of the programs that need to be told, and what differs from 0.3 photons in a pixel of each frame."""


class Peer(NamedTuple):
    """A row: a program of peer_programs.py, and whether its defects are mended."""

    program: str
    mended: bool = False

    @property
    def slug(self) -> str:
        return f"{self.program}-mended" if self.mended else self.program


PEERS = {
    "photonpano": Peer("photonpano"),
    "quantaodometry": Peer("quantaodometry"),
    "quantaodometry, mended": Peer("quantaodometry", True),
    "spano": Peer("spano"),
    "cQBPy": Peer("cqbpy"),
    "cQBPy, mended": Peer("cqbpy", True),
    "OpenCV's Stitcher": Peer("stitcher"),
    "COLMAP's SIFT": Peer("colmap"),
}
GIVEN = ("quantaodometry", "spano", "cqbpy")  # whose code stays outside the tree
SHOWN = {"fast": (430, 270), "trembling": (512, 341), "people": (512, 341)}  # middle of what is shown, (x, y) in the scene
SHOWN_SHAPE, TIMES = (80, 120), 2
MIN_SHARE = 0.8  # of frames located, or of the scene shown, below which a score is not the best of its capture


def result_of(peer: Peer, cube: Path, group: int, code: Path | None, python: Path | None, limit_s: float) -> Path | str:
    """Run a program unless its result is there; return that, or why there is none."""
    result = cube.with_name(f"{cube.stem.rpartition('-')[0] or cube.stem}-{peer.slug}.npz")
    why = result.with_suffix(".txt")
    if not result.exists() and not why.exists():
        script = Path(__file__).with_name("peer_programs.py")
        line = [python or sys.executable, script, peer.program, cube, str(group), result]
        line += [*(["--code", code] if code else []), *(["--mended"] if peer.mended else [])]
        threads = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")}
        try:
            done = subprocess.run(line, capture_output=True, text=True, timeout=limit_s, env=os.environ | threads)
            if done.returncode:
                why.write_text((done.stderr.strip().splitlines() or ["no message"])[-1], encoding="utf-8")
        except subprocess.TimeoutExpired:
            why.write_text(f"not finished after {limit_s:.0f} s", encoding="utf-8")
    return why.read_text(encoding="utf-8") if why.exists() else result


def scores(found: Mapping[str, NDArray[Any]], truth: Truth) -> dict[str, float]:
    """Return the scores of what a program has found."""
    numbers = {name: float(found[name]) for name in ("cpu_s", "mib")}
    if "homographies" in found and found["located"].any():
        motion = corner_errors(found["homographies"], truth.homographies, truth.frame_shape, found["located"])
        numbers |= {"mean_px": motion.mean_px, "max_px": motion.max_px, "located": motion.located_share}
    place = to_scene(found["flux"], truth) if "flux" in found else None
    if place is not None:
        numbers |= picture_scores(found["flux"], place, truth)
    return numbers


def to_scene(flux: NDArray[np.float32], truth: Truth) -> NDArray[np.float64] | None:
    """Return the homography of a picture, NaN where it shows nothing, to the scene; None if none is found."""
    assert truth.scene is not None
    found = alignment_of(np.nan_to_num(flux), np.isfinite(flux), truth.scene)
    return None if found is None else found[0]


def picture_scores(flux: NDArray[np.float32], place: NDArray[np.float64], truth: Truth) -> dict[str, float]:
    """Return PSNR and SSIM of a picture, and the share of what the capture saw that it shows."""
    assert truth.scene is not None
    scene, white = truth.scene, white_flux(truth.scene)
    true = true_panorama(scene, Canvas(*flux.shape, np.eye(3)), place)
    both = np.isfinite(flux) & np.isfinite(true)
    first, second = np.minimum(flux[both], np.quantile(flux[both], 0.999)), np.minimum(true[both], white)
    score = image_score(flux * np.float32((first @ second) / (first @ first)), true, both, white)
    seen = np.zeros(scene.shape, np.uint8)
    for outline in transform_points(
        truth.homographies[::10], np.broadcast_to(corners(truth.frame_shape), (len(truth.homographies[::10]), 4, 2))
    ):
        cv2.fillConvexPoly(seen, np.rint(outline).astype(np.int32), (1,))
    shown = cv2.warpPerspective(np.isfinite(flux).astype(np.uint8), place, scene.shape[::-1], flags=cv2.INTER_NEAREST)
    return {"psnr_db": score.psnr_db, "ssim": score.ssim, "shown": float((shown & seen).sum() / seen.sum())}


Results = dict[str, dict[str, dict[str, Any]]]  # of captures, of programs
MOTION, PICTURE, COST = "mean_px", "psnr_db", "cpu_s"
WORDS = {MOTION: "motion", PICTURE: "picture", COST: "time"}


def cell(result: Mapping[str, Any], what: str) -> str:
    """Return what a table says of a result."""
    if "why" in result or what not in result:
        return {"not given": "not given"}.get(result.get("why", ""), "stops" if "why" in result else "none")
    if what == MOTION:
        lost = "" if result["located"] > 0.9995 else f", {100 * result['located']:.0f} % of the frames"
        figure = f"{result['mean_px']:#.2g}"
        return f"{figure.rstrip('.')} px{lost}"
    if what == PICTURE:
        return f"{result['psnr_db']:.1f} dB, {result['ssim']:.2f}, {100 * result['shown']:.0f} %"
    return f"{result['cpu_s']:.0f} s, {result['mib']:.0f} MiB"


def worth(result: Mapping[str, Any], what: str) -> float:
    """Return a figure that is smaller for a better result; infinite for one of a part of the capture."""
    if what not in result or result.get({MOTION: "located", PICTURE: "shown"}.get(what, ""), 1.0) < MIN_SHARE:
        return float("inf")
    return -float(result[what]) if what == PICTURE else float(result[what])


def better(results: Results, what: str) -> list[str]:
    """Return where a program is better than photonpano."""
    said = []
    for peer in PEERS:
        names = [name for name, found in results.items() if worth(found[peer], what) < worth(found["photonpano"], what)]
        if names:
            said.append(f"{peer} ({'all' if len(names) == len(results) > 1 else ', '.join(names)})")
    return said


def tables_of(numbers: Mapping[str, Any]) -> dict[str, list[str]]:
    """Return the tables of the page; the best of each capture is bold."""
    results: Results = numbers["results"]
    tables = {}
    for what in (MOTION, PICTURE, COST):
        rows = []
        for peer in PEERS:
            cells = [peer]
            for found in results.values():
                best = min(worth(each, what) for each in found.values())
                said = cell(found[peer], what)
                cells.append(f"**{said}**" if worth(found[peer], what) == best < float("inf") else said)
            rows.append(cells)
        tables[WORDS[what]] = table(["", *results], rows)
        tables[WORDS[what]] += ["", f"Better than photonpano: {', '.join(better(results, what)) or 'none'}."]
    stopped: dict[str, list[str]] = {}
    for name, found in results.items():
        for peer, each in found.items():
            if each.get("why", "not given") != "not given":
                stopped.setdefault(f"{peer}: `{each['why']}`", []).append(name)
    tables["stops"] = [f"- {why} ({', '.join(names)})" for why, names in stopped.items()] or ["No program stops."]
    tables["machine"] = [f"{numbers['date']}, {numbers['machine']}; {N_FRAMES:,} frames of {SHAPE[0]}x{SHAPE[1]} px."]
    return tables


def panels(pictures: Mapping[str, Mapping[str, Any]]) -> NDArray[np.uint8]:
    """Return the same places of the pictures of all programs side by side, with their names above."""
    names = list(next(iter(pictures.values())))
    height, width = (TIMES * side for side in SHOWN_SHAPE)
    image = np.full((22 + len(pictures) * (height + 6), len(names) * (width + 6)), 255, np.uint8)
    for column, name in enumerate(names):
        left = column * (width + 6)
        cv2.putText(image, name, (left + 2, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (60,), 1, cv2.LINE_AA)
        for row, shown in enumerate(pictures.values()):
            top = 22 + row * (height + 6)
            image[top : top + height, left : left + width] = shown[name]
    return image


def part(
    flux: NDArray[np.float32] | None, place: NDArray[np.float64] | None, middle: tuple[int, int], scene: NDArray[Any]
) -> Any:
    """Return a part of the scene as a picture shows it, as light as the scene; white where it shows nothing."""
    to_panel = np.array(
        [
            [TIMES, 0, TIMES * (SHOWN_SHAPE[1] / 2 - middle[0])],
            [0, TIMES, TIMES * (SHOWN_SHAPE[0] / 2 - middle[1])],
            [0, 0, 1.0],
        ]
    )
    size = (TIMES * SHOWN_SHAPE[1], TIMES * SHOWN_SHAPE[0])
    true = cv2.warpPerspective(scene, to_panel, size, flags=cv2.INTER_CUBIC)
    if flux is None or place is None:
        return np.full(size[::-1], 255, np.uint8)
    options: dict[str, Any] = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": float("nan")}
    shown = cv2.warpPerspective(flux, to_panel @ place, size, flags=cv2.INTER_LINEAR, **options)
    known = np.isfinite(shown)
    factor = np.median(true[known]) / max(float(np.median(shown[known])), 1e-9) if known.any() else 1.0
    return np.where(known, tone_mapped(np.nan_to_num(shown * np.float32(factor)), float(np.quantile(true, 0.995))), 255)


def main(
    page: Path | None,
    quantaodometry: Path | None = None,
    spano: Path | None = None,
    cqbpy: Path | None = None,
    quantaodometry_python: Path | None = None,
    cqbpy_python: Path | None = None,
    folder: Path = Path("runs/peers"),
    only: Sequence[str] = (),
    limit_s: float = 900.0,
) -> None:
    """Measure all programs on all captures, and write the page, its numbers and its picture."""
    folder.mkdir(parents=True, exist_ok=True)
    places = {"quantaodometry": (quantaodometry, quantaodometry_python), "cqbpy": (cqbpy, cqbpy_python), "spano": (spano, None)}
    results: Results = {}
    pictures: dict[str, dict[str, NDArray[np.uint8]]] = {}
    for name in chosen(only, CAPTURES):
        group, changes = CAPTURES[name]
        scene = {"kind": "street", "width": 1024, "height": 683}
        camera = {"flux": 0.3, "frame_shape": list(SHAPE), "n_frames": N_FRAMES, "seed": 1, "scene": scene}
        cube = Study(folder).capture(name, simulator(**(camera | changes)))
        truth = load_truth(truth_path(cube))
        results[name] = {}
        for row, peer in PEERS.items():
            code, python = places.get(peer.program, (None, None))
            if peer.program in GIVEN and code is None:
                results[name][row] = {"why": "not given"}
                continue
            found = result_of(peer, cube, group, code and code.resolve(), python, limit_s)
            if isinstance(found, str):
                results[name][row] = {"why": found}
                continue
            with np.load(found) as arrays:
                content = dict(arrays)
            results[name][row] = scores(content, truth)
            print(name, row, results[name][row], flush=True)
            if name in SHOWN and "flux" in content:
                shown = part(content["flux"], to_scene(content["flux"], truth), SHOWN[name], truth.scene)
                pictures.setdefault(name, {})[row] = shown
        if name in pictures:
            pictures[name]["the true scene"] = part(truth.scene, np.eye(3), SHOWN[name], truth.scene)
    machine = f"{platform.machine()} with {os.cpu_count()} cores"
    numbers = {"date": f"{datetime.datetime.now(datetime.UTC):%Y-%m-%d}", "machine": machine, "results": results}
    tables = tables_of(numbers)
    if page:
        write_tables(page, tables)
        page.with_suffix(".json").write_text(json.dumps(numbers, indent=1) + "\n", encoding="utf-8")
        rows = [
            row for row in [*PEERS, "the true scene"] if any(np.any(each.get(row, 255) != 255) for each in pictures.values())
        ]
        image = panels({name: {row: each.get(row, 255) for row in rows} for name, each in pictures.items()})
        cv2.imwrite(str(IMAGES / "peers.png"), image)


if __name__ == "__main__":
    command(main, "machine", "motion", "picture", "time", "stops")
