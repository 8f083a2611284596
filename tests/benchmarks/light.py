"""Measure what light that changes costs, and how often steady light is taken for changing.

    python tests/benchmarks/light.py [--rows drift] [--seeds 3] [--false-alarms 200] [--large] [--picture light.png]

Each row is a kind of light over a pan across the built-in street, with another scene and noise for each seed. The error of
the motion is compared with that of the same capture in steady light with as many photons; the panorama with a merge along the
same motion that knows the gains. Small captures have 128x192 px and 3,000 frames at 20 kHz; large ones 254x496 px and 10,000
frames at 96.8 kHz. With --false-alarms, small steady captures of many kinds are looked at along the motion of level 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
from harness import Compared, Study, chosen, command, packed, passing, record_of, rendered, scores_of, simulator, table

from photonpano import LocationError, parse_spec
from photonpano.capture.writing import truth_path
from photonpano.corrections import divided_by
from photonpano.corrections.lighting import find_light, in_light, in_light_of
from photonpano.evaluation.scores import covered, image_score, true_panorama, white_flux
from photonpano.execution.context import Context
from photonpano.motion.locate import LoopSetting
from photonpano.motion.loop import estimate_motion
from photonpano.photometry import linear_to_srgb
from photonpano.pipeline.components import build_levels, open_source
from photonpano.pipeline.estimate import estimate
from photonpano.pipeline.obstacles import timeline_of
from photonpano.pipeline.passes import vignette_of
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

FLAWS: dict[str, Settings] = {
    "clean": {},
    "clean again": {},
    "vignette": {},
    "hot pixels": {"sensor": {"hot_fraction": 0.02, "dark_rate": 0.001}},
    "colour filter": {"sensor": {"filters": "rggb"}},
    "uneven gain": {"sensor": {"gain_std": 0.05}},
}
"""What disturbs a steady capture; a third are clean. Vignettes take between 20 and 80 % of the light of the corners."""


def captured(study: Study, settings: Settings, seed: int) -> Path:
    """Simulate a capture."""
    height, width = settings["frame_shape"]
    path = {"kind": "pan", "length_px": 1.5 * width, "shake": {"rms_px": 0.5}}
    scene = {"kind": "street", "seed": seed, "width": 4 * width, "height": 4 * height}
    return study.capture("light", simulator(**{"scene": scene, "path": path, "seed": seed, "flux": FLUX, **settings}))


def run_of(study: Study, cube: Path, settings: Settings) -> Compared:
    """Run a capture with default settings."""
    return Compared.of(study.run("run", packed(cube, settings["frame_rate_hz"])), cube)


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


def measured(name: str, settings: Settings, size: Settings, seed: int) -> Sequence[str]:
    """Return the cells of a row: errors with that in steady light, what the panorama lacks, the honest share, the verdict."""
    with passing() as study:
        cube = captured(study, size | settings, seed)
        as_bright = FLUX * float(np.mean(settings.get("drift", 1.0) ** np.linspace(0, 1, 1000)))
        run, steady = (run_of(study, each, size) for each in (cube, captured(study, size | {"flux": as_bright}, seed)))
        error, in_steady = run.score.mean_px, steady.score.mean_px
        honest = scores_of(run.folder, cube, oracle=False).honest_share
        figures = f"{error:.3f}", f"{in_steady:.3f}", f"{error / in_steady:.2f}", f"{below_known_gains(run, cube):.2f}"
        return name, str(seed), *figures, f"{honest:.0%}", record_of(run.folder)["verdict"]["status"]


def below_known_gains(run: Compared, cube: Path) -> float:
    """Return how far the panorama of a run is below that of a merge along the same motion that knows the gains, in dB."""
    with np.load(truth_path(cube)) as file:
        truth = dict(file)
    canvas, flux = run.canvas, run.panorama.flux
    with run.source() as source:
        tolerance_px = run.plan.render.tolerance_px
        known = rendered(in_light(source, true_light(truth, run.score.alignment)), run.motion, canvas, tolerance_px)
    scene = truth["scene"] * float(np.mean(truth.get("light", 1.0)))
    image = true_panorama(scene, canvas, run.score.alignment)
    seen = covered(known.weight) & np.isfinite(flux) & np.isfinite(image)
    # Light and scene are known up to a common factor.
    flux = flux * np.float32(known.flux[seen].sum() / flux[seen].sum())
    scores = [image_score(each, image, seen, white_flux(scene)).psnr_db for each in (known.flux, flux)]
    return scores[0] - scores[1]


def save_picture(file: Path) -> None:
    """Draw a part of two panoramas along the same motion: frames counted alike, and in the light that was found."""
    with passing() as study:
        run = run_of(study, captured(study, SMALL | ROWS["100 Hz, 100 % deep"], 0), SMALL)
        with run.source() as source:
            sources, tolerance_px = (source, in_light_of(source, run.folder)), run.plan.render.tolerance_px
            parts = [rendered(each, run.motion, run.canvas, tolerance_px).flux for each in sources]
    width = SMALL["frame_shape"][1]
    white = float(np.nanquantile(parts[1], 0.99))
    rows = [255 * linear_to_srgb(np.clip(np.nan_to_num(part[:, : 2 * width]) / white, 0, 1)) for part in parts]
    cv2.imwrite(str(file), np.uint8(np.concatenate([rows[0], np.full((6, rows[0].shape[1]), 255.0), rows[1]])))


def steady_capture(study: Study, seed: int) -> tuple[str, Settings]:
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
        scene = {"kind": "photo", "file": str(study.folder / "scene.png")}
        cv2.imwrite(scene["file"], bright_borders(seed))
    n_frames = int(rng.integers(1000, 2001))
    flaw = list(FLAWS)[int(rng.integers(len(FLAWS)))]
    disturbed = {"lens": {"vignette": float(rng.uniform(0.2, 0.8))}} if flaw == "vignette" else FLAWS[flaw]
    camera = {"frame_shape": [64, 96], "n_frames": n_frames, "frame_rate_hz": SMALL["frame_rate_hz"], **disturbed}
    cube = study.capture("steady", simulator(scene=scene, path=path, seed=seed, flux=flux, **camera))
    spec = packed(cube, SMALL["frame_rate_hz"], levels=1, refine=[])
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
    with passing() as study:
        name, spec = steady_capture(study, seed)
        plan, context = parse_spec(spec), Context(threads=1)
        with open_source(plan) as source:
            levels, timeline = build_levels(plan, source, []), timeline_of(source, context)
            try:
                setting = LoopSetting(
                    source=source, graph=plan.graph, reference=source.info.n_frames // 2, context=context, timeline=timeline
                )
                first = estimate_motion(setting, levels)[0]
            except LocationError:
                return None
            vignette = vignette_of(plan, source, first.trajectory)
            divided = divided_by(source, vignette) if vignette else source
            if find_light(divided, first.trajectory, context) is None:
                return name, False, False
            state = estimate(plan, source, [], context)
    return name, True, state.light is not None


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


HEAD = (
    "Light", "Seed", "Error, px", "In steady light", "Ratio", "Below known gains, dB", "Within 3 std_px", "Verdict",
)  # fmt: skip


def main(
    rows: Sequence[str] = ("",), seeds: int = 1, false_alarms: int = 0, picture: Path | None = None, large: bool = False
) -> None:
    """Print a row of Markdown for each kind of light; or draw a picture, or look at so many steady captures."""
    if picture:
        save_picture(picture)
    elif false_alarms:
        print_false_alarms(false_alarms)
    else:
        cases = [(name, ROWS[name], LARGE if large else SMALL, seed) for name in chosen(rows, ROWS) for seed in range(seeds)]
        table(HEAD, (measured(*case) for case in cases))


if __name__ == "__main__":
    command(main)
