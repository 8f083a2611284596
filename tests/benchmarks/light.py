"""Measure what light that changes costs, and how often steady light is taken for changing.

    python tests/benchmarks/light.py [--rows drift] [--seeds 3] [--false-alarms 200] [--large]

Each row is a kind of light over a pan across the built-in street, with another scene and noise for each seed. The error of
the motion is compared with that of the same capture in steady light with as many photons; the panorama with a merge along the
same motion that knows the gains. Small captures have 128x192 px and 3,000 frames at 20 kHz; large ones 254x496 px and 10,000
frames at 96.8 kHz. With --false-alarms, steady captures are looked at along a motion that is wrong by 2 px.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from photonpano import evaluate, parse_spec, run, simulate
from photonpano.context import Context
from photonpano.evaluation.images import covered, image_score, true_panorama, white_flux
from photonpano.evaluation.trajectory import corner_errors
from photonpano.geometry import Canvas, FrameTrajectory, inverse, normalised, translation
from photonpano.lighting import find_light, in_light
from photonpano.merging.panorama import render
from photonpano.pipeline.components import open_source
from photonpano.protocols import KnowsTruth
from photonpano.values import FloatArray, Light

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


def false_alarm(seed: int) -> bool:
    """Return whether the light of a steady capture of 64x96 px and 1,000 frames seems to change."""
    rng = np.random.default_rng(seed)
    flux = float(np.exp(rng.uniform(np.log(0.02), np.log(1.5))))
    kind = ["pan", "scan", "loop", "random-spline"][int(rng.integers(4))]
    path: Settings = {"kind": kind, "length_px": float(rng.uniform(20, 200)) + 300 * (kind == "scan")}
    path |= {"row_spacing_px": 30} if kind == "scan" else {}
    path |= {"seed": seed} if kind == "random-spline" else {}
    scene = {"kind": "street", "seed": seed, "width": 800, "height": 600}
    keys = {"scene": scene, "path": path, "seed": seed, "flux": flux, "frame_shape": [64, 96], "n_frames": 1000}
    plan = parse_spec({"version": 1, "source": {"use": "simulator", "with": keys}})
    with open_source(plan) as source:
        assert isinstance(source, KnowsTruth)
        homographies = np.asarray(source.truth()["homographies"], float)
        wrong = np.array([translation(*each) for each in _wander(rng, len(homographies))])
        motion = normalised(inverse(homographies[500]) @ homographies @ wrong)
        return find_light(source, FrameTrajectory(motion), Context(2)) is not None


def _wander(rng: np.random.Generator, n_frames: int) -> FloatArray:
    """Return shifts that change slowly, of 2 px (root mean square): (n_frames, 2)."""
    knots = rng.normal(0, 2, (8, 2))
    at = np.linspace(0, 7, n_frames)
    return np.stack([np.interp(at, np.arange(8), column) for column in knots.T], axis=1)


def main() -> None:
    """Print a row of Markdown for each kind of light."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", nargs="*", default=[""], metavar="WORD", help="words in the names of the rows to measure")
    parser.add_argument("--seeds", type=int, default=1, help="number of seeds of each row")
    parser.add_argument("--false-alarms", type=int, default=0, metavar="N", help="number of steady captures to look at")
    parser.add_argument("--large", action="store_true", help="captures of 254x496 px and 10,000 frames")
    arguments = parser.parse_args()
    if arguments.false_alarms:
        alarms = [seed for seed in range(arguments.false_alarms) if false_alarm(seed)]
        print(f"false alarms: {len(alarms)} of {arguments.false_alarms} {alarms}", flush=True)
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
