"""Measure what light that changes costs, and how often steady light is taken for changing.

    python tests/benchmarks/light.py [--rows drift] [--seeds 3] [--false-alarms 200] [--large] [--picture light.png]

Each row is a kind of light over a pan across the built-in street, with another scene and noise for each seed. The error of
the motion is compared with that of the same capture in steady light with as many photons; the panorama with a merge along the
same motion that knows the gains. Small captures have 128x192 px and 3,000 frames at 20 kHz; large ones 254x496 px and 10,000
frames at 96.8 kHz. With --false-alarms, small steady captures of many kinds are looked at along the motion of level 1.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np

from photonpano import LocationError, evaluate, parse_spec, run, simulate
from photonpano.captures.obstacles import timeline_of
from photonpano.context import Context
from photonpano.corrections import divided_by
from photonpano.evaluation.images import covered, image_score, true_panorama, white_flux
from photonpano.evaluation.trajectory import corner_errors
from photonpano.geometry import Canvas, FrameTrajectory
from photonpano.lighting import LIGHT_DECISION, find_light, in_light, in_light_of
from photonpano.merging.panorama import render
from photonpano.motion.loop import estimate_motion
from photonpano.photometry import linear_to_srgb
from photonpano.pipeline.components import build_levels, open_source
from photonpano.pipeline.estimate import estimate
from photonpano.pipeline.passes import vignette_of
from photonpano.values import Decision, FloatArray, Light

Settings: TypeAlias = dict[str, Any]
SMALL: Settings = {"frame_shape": [128, 192], "n_frames": 3000, "frame_rate_hz": 20_000.0}
LARGE: Settings = {"frame_shape": [254, 496], "n_frames": 10_000, "frame_rate_hz": 96_800.0}
FLUX = 0.2


def flicker(depth: float, phase_deg: float = 0.0, **more: Any) -> Settings:
    """Return a lamp at 100 Hz."""
    return {"frequency_hz": 100.0, "depth": depth, "phase_deg": phase_deg, **more}


PHASES = [flicker(0.9, phase, at=[x, 0.5], radius=0.25) for phase, x in ((0, 0.35), (120, 0.5), (-120, 0.65))]
ROWS: dict[str, Settings] = {
    "drift by 2": {"drift": 0.5},
    "100 Hz, 20 % deep": {"lamps": [flicker(0.2)]},
    "100 Hz, 50 % deep": {"lamps": [flicker(0.5)]},
    "100 Hz, 100 % deep": {"lamps": [flicker(1.0)]},
    "lamps on three phases, 90 % deep": {"lamps": PHASES},
}

FLAWS: dict[str, Settings] = {
    "clean": {},
    "clean again": {},
    "vignette": {},
    "hot pixels": {"sensor": {"hot_fraction": 0.02, "dark_rate": 0.001}},
    "colour filter": {"sensor": {"filters": "rggb"}},
    "uneven gain": {"sensor": {"gain_std": 0.05}},
}
"""What disturbs a steady capture; a third are clean. Vignettes take between 20 and 80 % of the light of the corners."""


def captured(folder: Path, name: str, settings: Settings, seed: int) -> Path:
    """Simulate a capture."""
    width = settings["frame_shape"][1]
    path = {"kind": "pan", "length_px": 1.5 * width, "shake": {"rms_px": 0.5}}
    scene = {"kind": "street", "seed": seed, "width": 4 * width, "height": 4 * settings["frame_shape"][0]}
    keys = {"scene": scene, "path": path, "seed": seed, "flux": FLUX, **settings}
    return simulate(parse_spec({"version": 1, "source": {"use": "simulator", "with": keys}}), folder / f"{name}.npy").path


def source_of(cube: Path, settings: Settings) -> Settings:
    """Return the section `source` that opens a capture."""
    return {"use": "packed-npy", "with": {"path": str(cube), "frame_rate_hz": settings["frame_rate_hz"]}}


def true_light(truth: dict[str, np.ndarray], to_scene: FloatArray) -> Light:
    """Return the light of the simulation.

    Args:
        truth: of the capture.
        to_scene: (3, 3), pixels of the reference plane to pixels of the scene.
    """
    n_frames = len(truth["homographies"])
    gain = truth.get("light", np.ones(n_frames))
    steady = Light.of_frames(gain / gain.mean())
    if "lamps" not in truth:
        return steady
    if len(truth["lamps"]) == 1:
        return Light.of_frames(truth["lamp_light"][0])
    waves = truth["lamp_light"] - 1
    return Light(steady.gain, waves, truth["lamps"], to_scene, 0.0, np.zeros(n_frames))


def measured(name: str, settings: Settings, size: Settings, seed: int) -> tuple[float, float, float, float, str]:
    """Return the mean error, that in steady light, what the panorama lacks in dB, the honest share, and the verdict."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        settings = size | settings
        cube = captured(folder, "changing", settings, seed)
        drift = settings.get("drift", 1.0)
        as_bright = FLUX * float(np.mean(drift ** np.linspace(0, 1, 1000)))
        steady = captured(folder, "steady", size | {"flux": as_bright}, seed)
        errors = []
        for each in (cube, steady):
            done = run(parse_spec({"version": 1, "source": source_of(each, size)}, output=folder / each.stem))
            score = evaluate(done.directory, each.with_suffix(".truth.npz"), oracle=False)
            errors.append((score.trajectory.mean_px, score.honest_share, done.verdict.status))
        with np.load(cube.with_suffix(".truth.npz")) as file:
            truth = dict(file)
        lacks_db = _below_known_gains(folder / "changing", cube, settings, truth)
    return errors[0][0], errors[1][0], lacks_db, errors[0][1], errors[0][2]


def _below_known_gains(directory: Path, cube: Path, settings: Settings, truth: dict[str, np.ndarray]) -> float:
    """Return how far the panorama of a run is below that of a merge along the same motion that knows the gains, in dB."""
    import tifffile

    with np.load(directory / "trajectory.npz") as file:
        motion = dict(file)
    alignment = corner_errors(
        motion["homographies"], truth["homographies"], tuple(motion["frame_shape"].tolist()), motion["located"]
    ).alignment
    flux = tifffile.imread(directory / "panorama.tiff")
    canvas = Canvas(*flux.shape, motion["canvas"])
    light = true_light(truth, alignment)
    plan = parse_spec({"version": 1, "source": source_of(cube, settings)})
    with open_source(plan) as source:
        known = render(
            in_light(source, light),
            FrameTrajectory(motion["homographies"]),
            source.info.span,
            canvas,
            plan.render.tolerance_px,
            Context(2),
        )
    scene = truth["scene"] * float(np.mean(truth.get("light", 1.0)))
    image = true_panorama(scene, canvas, alignment)
    seen = covered(known.weight) & np.isfinite(flux) & np.isfinite(image)
    # Light and scene are known up to a common factor.
    flux = flux * np.float32(known.flux[seen].sum() / flux[seen].sum())
    scores = [image_score(each, image, seen, white_flux(scene)).psnr_db for each in (known.flux, flux)]
    return scores[0] - scores[1]


def save_picture(file: Path) -> None:
    """Draw a part of two panoramas along the same motion: frames counted alike, and in the light that was found."""
    with tempfile.TemporaryDirectory() as place:
        settings = SMALL | ROWS["100 Hz, 100 % deep"]
        cube, directory = captured(Path(place), "changing", settings, 0), Path(place) / "run"
        run(parse_spec({"version": 1, "source": source_of(cube, settings)}, output=directory))
        cv2.imwrite(str(file), alike_and_lit(cube, directory, settings))


def alike_and_lit(cube: Path, directory: Path, settings: Settings) -> np.ndarray:
    """Return a part of the panorama of a run below one that counts all frames alike: uint8."""
    with np.load(directory / "trajectory.npz") as file:
        motion = dict(file)
    plan, trajectory = parse_spec({"version": 1, "source": source_of(cube, settings)}), FrameTrajectory(motion["homographies"])
    with open_source(plan) as source:
        shape = image_shape(directory)
        canvas, tolerance_px = Canvas(*shape, motion["canvas"]), plan.render.tolerance_px
        parts = [
            render(each, trajectory, source.info.span, canvas, tolerance_px, Context(2)).flux
            for each in (source, in_light_of(source, directory))
        ]
    width = SMALL["frame_shape"][1]
    white = float(np.nanquantile(parts[1], 0.99))
    rows = [255 * linear_to_srgb(np.clip(np.nan_to_num(part[:, : 2 * width]) / white, 0, 1)) for part in parts]
    return np.uint8(np.concatenate([rows[0], np.full((6, rows[0].shape[1]), 255.0), rows[1]]))


def image_shape(directory: Path) -> tuple[int, int]:
    """Return the height and width of the panorama of a run."""
    image = cv2.imread(str(directory / "panorama.png"), cv2.IMREAD_GRAYSCALE)
    return image.shape[0], image.shape[1]


def steady_capture(folder: Path, seed: int) -> tuple[str, Settings]:
    """Simulate a small steady capture of a kind that the seed chooses.

    Returns:
        A description, and the spec of a run of level 1.
    """
    rng = np.random.default_rng(seed)
    view = ["street", "street", "bordered", "night"][int(rng.integers(4))]
    flux = float(np.exp(rng.uniform(np.log(0.2 if view == "night" else 0.02), np.log(0.5))))
    kind = ["pan", "scan", "loop", "random-spline", "hand-shake"][int(rng.integers(5))]
    path: Settings = {"kind": kind}
    if kind != "hand-shake":
        path["length_px"] = float(rng.uniform(20, 200)) + 200 * (kind == "scan")
        path |= {"row_spacing_px": 30} if kind == "scan" else {}
        path |= {"seed": seed} if kind == "random-spline" else {}
        path |= {"shake": {"rms_px": float(rng.uniform(0.3, 2))}} if rng.random() < 0.5 else {}
    scene: Settings = {"kind": view, "seed": seed, "width": 800, "height": 600}
    if view == "bordered":
        scene = {"kind": "photo", "file": str(folder / "scene.png")}
        cv2.imwrite(scene["file"], bright_borders(seed))
    n_frames = int(rng.integers(1000, 2001))
    flaw = list(FLAWS)[int(rng.integers(len(FLAWS)))]
    disturbed = {"lens": {"vignette": float(rng.uniform(0.2, 0.8))}} if flaw == "vignette" else FLAWS[flaw]
    keys = {
        "scene": scene,
        "path": path,
        "seed": seed,
        "flux": flux,
        "frame_shape": [64, 96],
        "n_frames": n_frames,
        **disturbed,
    }
    simulated = {"version": 1, "source": {"use": "simulator", "with": {**keys, "frame_rate_hz": SMALL["frame_rate_hz"]}}}
    cube = simulate(parse_spec(simulated), folder / "steady.npy").path
    spec = {"version": 1, "source": source_of(cube, SMALL), "levels": 1, "refine": []}
    if flaw == "colour filter":
        spec["corrections"] = [{"colour-filter": {"pattern": "rggb", "keep": "all"}}]
    return f"{view}, {kind}{' with tremor' * ('shake' in path)}, flux {flux:.2f}, {flaw}", spec


def bright_borders(seed: int) -> np.ndarray:
    """Paint dark panels beside a bright wall: uint8."""
    rng = np.random.default_rng(seed)
    image = np.full((600, 800), 40.0)
    for _ in range(150):
        x, y = rng.integers(0, 800), rng.integers(0, 600)
        width, height = rng.integers(5, 80, 2)
        image[y : y + height, x : x + width] = rng.uniform(5, 90)
    wall = int(rng.integers(200, 280))
    image[:, :wall], image[: wall // 2] = 255, 230
    return np.uint8(image)


def false_alarm(seed: int) -> tuple[str, bool, bool] | None:
    """Look for changes of the light in a steady capture along the motion of level 1.

    Returns:
        A description of the capture; whether the light seems to change along the first motion; and whether the run takes it for
        changing. None if the capture cannot be located.
    """
    with tempfile.TemporaryDirectory() as place:
        name, spec = steady_capture(Path(place), seed)
        plan, context = parse_spec(spec), Context(1)
        with open_source(plan) as source:
            levels, timeline = build_levels(plan, source, []), timeline_of(source, context)
            try:
                first = estimate_motion(source, levels, plan.graph, source.info.n_frames // 2, context, timeline=timeline)[0]
            except LocationError:
                return None
            vignette = vignette_of(plan, source, first.trajectory)
            divided = divided_by(source, vignette) if vignette else source
            if find_light(divided, first.trajectory, context) is None:
                return name, False, False
            decisions: list[Decision] = []
            estimate(plan, source, decisions, context)
    return name, True, any(each.what == LIGHT_DECISION for each in decisions)


def print_false_alarms(number: int) -> None:
    """Print how often the light of steady captures seems to change."""
    located = seeming = wrong = 0
    for seed in range(number):
        if (result := false_alarm(seed)) is None:
            continue
        name, seems, found = result
        located, seeming, wrong = located + 1, seeming + seems, wrong + found
        if seems:
            print(f"seed {seed}: {name}{', taken for changing' * found}", flush=True)
    print(f"false alarms: {wrong} of {located}; the light of {seeming} seemed to change along the first motion", flush=True)


def main() -> None:
    """Print a row of Markdown for each kind of light."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", nargs="*", default=[""], metavar="WORD", help="words in the names of the rows to measure")
    parser.add_argument("--seeds", type=int, default=1, help="number of seeds of each row")
    parser.add_argument("--false-alarms", type=int, default=0, metavar="N", help="number of steady captures to look at")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="draw a panorama with and without its light")
    parser.add_argument("--large", action="store_true", help="captures of 254x496 px and 10,000 frames")
    arguments = parser.parse_args()
    if arguments.picture:
        save_picture(arguments.picture)
        return
    if arguments.false_alarms:
        print_false_alarms(arguments.false_alarms)
        return
    print("| Light | Seed | Error, px | In steady light | Ratio | Below known gains, dB | Within 3 std_px | Verdict |")
    print("| --- " * 8 + "|", flush=True)
    for name, settings in ROWS.items():
        if not any(word in name for word in arguments.rows):
            continue
        for seed in range(arguments.seeds):
            error, steady, lacks_db, honest, status = measured(name, settings, LARGE if arguments.large else SMALL, seed)
            numbers = f"{error:.3f} | {steady:.3f} | {error / steady:.2f} | {lacks_db:.2f} | {honest:.0%}"
            print(f"| {name} | {seed} | {numbers} | {status} |", flush=True)


if __name__ == "__main__":
    main()
